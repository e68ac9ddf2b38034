# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a row of the fault matrix is, and what of its outcome is unsafe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from exo_gravity.core.motors.frames import MotorSpec
from exo_gravity.sim.judge import MAX_DAMPING, MAX_ENERGY, MAX_GAP, MAX_SPEED, Response, measure

REACTION = 0.10  # s from a fault until damping acts on every motor,
PROCESS_REACTION = 0.15  # or where another process must first notice that one has died or frozen
RECOVERY = 6.0  # s in which the launcher brings down an arm that has lost its bridge and its watchdog

Action = Callable[[Any], object]  # on a rig of the case's type
Check = Callable[[np.ndarray], str]  # of the truth records since the fault: returns what is wrong, or ''
ALL_JOINTS = (0, 1, 2, 3)  # of the paper's arm
CARRYING = ("active", "ramping in", "proving signs")
TOO_LATE = "too late"
OBSERVATION = 3.0  # s for which an arm that may stay carried, or must stay off, is observed
AFTER_EXIT = 3.0  # s after the last motor was switched off in which the arm must not fall
DESCENT = 30.0  # s until the arm must be down
BEFORE = 0.1  # s before the fault, from which on the torque is known


def in_turn(*actions: Action) -> Action:
    """Do one action after the other."""
    return lambda rig: [action(rig) for action in actions] and None


@dataclass(frozen=True)
class FaultCase:
    """One fault. inject(rig) causes it, and may return the time (s on the clock of the records) at which it began.

    rig: the type of rig with real processes (rigs.py), by default `Rig`; or the arm in virtual time (virtual.py).

    clear(rig) ends the fault where the rig is used again.
    afterwards(rig) checks, once the arm is down, what happens next: it raises AssertionError.
    stage: the bridge's state in which the fault occurs, or "started".
    limit: s until the arm must be let down, None where it may stay carried, because the fault is refused or ignored.
    unreached: joints (0..) whose motors no frame can reach.
    unpowered: joints that fall, because a motor has no power, so that nothing can brake them.
    steps_from: s after the fault from which on torque steps count, where the fault itself is a step.
    speed_limit, driven_limit: rad/s of any joint.
    energy_limit: J of any motor in one stretch.
    damping_limit: of any motor's damping by itself, as a multiple of its rated torque.
    check: of the arm's true motion.
    ends_rig: whether the rig is spent although its nodes run on.
    """

    name: str
    inject: Action
    rig: Any = None
    limit: float | None = REACTION
    stage: str = "active"
    clear: Action = lambda rig: None
    afterwards: Action = lambda rig: None
    outcomes: tuple[str, ...] = ()
    unreached: tuple[int, ...] = ()
    unpowered: tuple[int, ...] = ()
    steps_from: float = 0.0
    speed_limit: float = MAX_SPEED
    driven_limit: float = MAX_SPEED
    energy_limit: float = MAX_ENERGY
    damping_limit: float = MAX_DAMPING
    check: Check = lambda records: ""
    ends_rig: bool = False

    @property
    def must_stay_off(self) -> bool:
        """Whether the fault occurs before the motors are switched on."""
        return self.stage == "checking"

    def response(self, records: np.ndarray, fault_time: float, period: float, motors: Sequence[MotorSpec]) -> Response:
        """Return what the arm did since the fault at `fault_time` s; arguments as those of `measure`."""
        if not len(records):
            return Response()
        return measure(records, fault_time, period, self.unreached, self.unpowered, self.steps_from, motors)

    def failures(
        self, outcome: str, records: np.ndarray, fault_time: float, response: Response, count: int
    ) -> list[str]:
        """Return what was unsafe. outcome: the fault's code, or the state. count: of joints."""
        carried = outcome in CARRYING
        late = response.reaction is None or (self.limit is not None and response.reaction > self.limit)
        must_react = self.limit is not None and not self.must_stay_off and len(self.unreached) < count
        failures = {
            "empty truth": not len(records),
            "switched on": self.must_stay_off and bool(len(records)) and bool(records["on"].any()),
            "not let down": not carried and response.off is None,
            "stayed carried": carried and self.limit is not None,
            f"{outcome} instead of {' or '.join(self.outcomes)}": bool(self.outcomes) and outcome not in self.outcomes,
            TOO_LATE: must_react and late,
            "too fast": response.top_speed > self.speed_limit,
            "moved by a motor": not carried and response.driven > self.driven_limit,
            "torque step": response.excess > 0.0,
            "driven by a motor": not carried and response.energy > self.energy_limit,
            "damped too hard": response.damping > self.damping_limit,
            "switched on again": response.re_enabled,
            f"truth stops for {response.gap:.1f} s": response.gap > MAX_GAP,
        }
        wrong = [failure for failure, failed in failures.items() if failed]
        if len(records) and (problem := self.check(records[records["time"] >= fault_time])):
            wrong.append(problem)
        return wrong
