# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a row of the fault matrix is, how it is played, in virtual time or with processes, and what is unsafe."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.sim.judge import MAX_DAMPING, MAX_ENERGY, MAX_GAP, MAX_SPEED, Response, measure

REACTION = 0.10  # s from a fault until damping acts on every motor,
PROCESS_REACTION = 0.15  # or where another process must first notice that one has died or frozen
RECOVERY = 6.0  # s in which the launcher brings down an arm that has lost its bridge and its watchdog

Action = Callable[[Any], object]  # on the arm of the case, in virtual time or of processes
Check = Callable[[np.ndarray], str]  # of the truth records since the fault: returns what is wrong, or ''
Parameters = Mapping[str, Any]
ALL_JOINTS = (0, 1, 2, 3)  # of the paper's arm
RAISED = (0.0, 1.3, 0.0, 0.3)  # rad, nearly horizontal
CARRYING = ("active", "ramping in", "proving signs")
OBSERVATION = 3.0  # s for which an arm that may stay carried, or must stay off, is observed
AFTER_EXIT = 3.0  # s after the last motor was switched off in which the arm must not fall
AT_LEAST = 0.5  # s of that also for an arm that rests: then nothing more can happen to it
DESCENT = 30.0  # s until the arm must be down
BEFORE = 0.1  # s before the fault, from which on the torque is known


def in_turn(*actions: Action) -> Action:
    """Do one action after the other."""
    return lambda rig: [action(rig) for action in actions] and None


def pause(seconds: float) -> Action:
    """Let time pass."""
    return lambda rig: rig.run(seconds)


def acting(does: Callable[..., object]) -> Callable[..., Action]:
    """Let `does(rig, ...)` be called without the rig, and return the action."""
    return lambda *args, **kwargs: lambda rig: does(rig, *args, **kwargs)


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm of a file in config, carried in `pose` (n,) rad at `rate` Hz.

    struck: the joint (0..) whose motor is the one that fails; it carries much of the arm's weight.
    can_bridge, compensator, simulator: parameters that are not as in the file.
    assisted: Nm (n,) of an outer loop, none without one.
    """

    base: str = "sim.yaml"
    pose: tuple[float, ...] = RAISED
    struck: int = 1
    rate: float = 250.0
    can_bridge: Parameters = field(default_factory=dict)
    compensator: Parameters = field(default_factory=dict)
    simulator: Parameters = field(default_factory=dict)
    assisted: tuple[float, ...] = ()


PAPER = Arm()


@dataclass(frozen=True)
class FaultCase:
    """One fault. inject(rig) causes it, and may return the time (s on the clock of the records) at which it began.

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
    arm: Arm = PAPER
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

    def failures(self, outcome: str, records: np.ndarray, start: float, response: Response) -> list[str]:
        """Return what was unsafe since `start`, s. outcome: the fault's code, or the state."""
        carried, count = outcome in CARRYING, len(self.arm.pose)
        late = response.reaction is None or (self.limit is not None and response.reaction > self.limit)
        must_react = self.limit is not None and not self.must_stay_off and len(self.unreached) < count
        failures = {
            "empty truth": not len(records),
            "switched on": self.must_stay_off and bool(len(records)) and bool(records["on"].any()),
            "not let down": not carried and response.off is None,
            "stayed carried": carried and self.limit is not None,
            f"{outcome} instead of {' or '.join(self.outcomes)}": bool(self.outcomes) and outcome not in self.outcomes,
            "too late": must_react and late,
            "too fast": response.top_speed > self.speed_limit,
            "moved by a motor": not carried and response.driven > self.driven_limit,
            "torque step": response.excess > 0.0,
            "driven by a motor": not carried and response.energy > self.energy_limit,
            "damped too hard": response.damping > self.damping_limit,
            "switched on again": response.re_enabled,
            f"truth stops for {response.gap:.1f} s": response.gap > MAX_GAP,
        }
        wrong = [failure for failure, failed in failures.items() if failed]
        if len(records) and (problem := self.check(records[records["time"] >= start])):
            wrong.append(problem)
        return wrong


class Played(NamedTuple):
    """What became of a row. unsafe: '' or what was wrong."""

    outcome: str
    response: Response
    unsafe: str


def play(case: FaultCase, rig: Any) -> Played:
    """Strike the arm of `rig`, which is at the case's stage, and judge it by its true motion."""
    start = rig.now
    injected = case.inject(rig)
    start = injected if isinstance(injected, float) else start
    _observe(case, rig)
    case.clear(rig)
    if rig.are_off():  # the last state of a killed bridge stands until the launcher has ended
        rig.run_until(lambda: rig.outcome not in CARRYING, DESCENT)
    if rig.outcome not in CARRYING and not case.must_stay_off:
        rig.run_until(rig.are_off, DESCENT)
        rig.run(AT_LEAST)
        rig.run_until(rig.rests, AFTER_EXIT - AT_LEAST)
    outcome, records, response = rig.outcome, rig.motion(start - BEFORE), Response()
    if len(records):
        given = case.unreached, case.unpowered, case.steps_from, [motor.spec for motor in rig.joint_motors]
        response = measure(records, start, 1.0 / case.arm.rate, *given)
    failures = [*case.failures(outcome, records, start, response), *rig.trouble(start)]
    if not failures:
        try:
            case.afterwards(rig)
        except AssertionError as error:
            failures.append(f"afterwards: {str(error).splitlines()[0]}")
    return Played(outcome, response, ", ".join(failures))


def _observe(case: FaultCase, rig: Any) -> None:
    """Wait until the arm is let down, or for OBSERVATION if it may stay as it is."""
    if case.limit is None or case.must_stay_off:
        rig.run_until(lambda: rig.state == "fault", OBSERVATION)
        if rig.state not in ("letting down", "fault"):
            return
    # A bridge that has given up a motor that it cannot reach is in `fault`, and that motor still on.
    rig.run_until(lambda: rig.state == "fault" or rig.are_off(), DESCENT)
