# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A safety machine that a test drives through time, with the readings and efforts that the test sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.command import Efforts, Send, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine

from .simulated_device import OFF

PERIOD = 0.008  # s, half as many cycles as a real bus has show the same
LIMITS = Limits(
    joint_names=("a", "b", "c", "d"),
    position_min=(-1.6, -0.2, -0.8, -0.2),
    position_max=(1.6, 3.1, 2.5, 3.1),
    max_velocity=(5.0, 0.0, 5.0, 6.0),  # 0: the usual one
    max_effort=(3.0, 9.0, 3.0, 3.0),
    sign_check_torque=0.0,
    start_pose="hanging",
)
EFFORT = (0.5, -4.0, 2.0, 1.0)  # Nm


def reading(**changes: Any) -> JointSample:
    """Return the reading of a joint at rest at home, with `changes`."""
    return JointSample(**{"position": 0.0, "velocity": 0.0, "effort": 0.0, "temperature": 30, "error": 0, **changes})


class SafetyRun:
    """A machine, its inputs, and the motors that it drives.

    changes: of each joint's reading. silent: the joints whose motors do not reply. off: those whose motors have been
    switched off behind the machine's back. effort: Nm, with `effort_age` in s; damped: as while the load changes; held:
    as of a late tilt. command: the machine's last output. applied: (4,) Nm, what the motors truly apply; a silent motor
    keeps its torque. steps: its largest step per cycle. while_hanging: Nm, asked for in place of `effort` while the
    start is checked. period: s of a cycle.
    """

    def __init__(self, period: float = PERIOD, **limits: Any) -> None:
        self.period = period
        self.machine = SafetyMachine(replace(LIMITS, **limits), period)
        self.now = 100.0
        self.changes: list[dict[str, Any]] = [{} for _ in range(4)]
        self.effort: Sequence[float] | None = EFFORT
        self.while_hanging: Sequence[float] = NO_TORQUE
        self.effort_age = 0.002
        self.damped = self.held = False
        self.joints = [UNKNOWN] * 4
        self.silent, self.off = set[int](), set[int]()
        self.command = OFF
        self.applied = [0.0] * 4
        self.steps: list[float] = []

    def cycle(self, seconds: float = PERIOD) -> SafetyRun:
        """Run the machine for `seconds`, at least one cycle."""
        for _ in range(max(1, round(seconds / self.period))):
            self.now += self.period
            for i, change in enumerate(self.changes):
                if i not in self.silent:
                    damped = self.applied[i] - self.command.damping[i] * change.get("velocity", 0.0)
                    most = LIMITS.max_effort[i]
                    torque = 0.0 if i in self.off else max(-most, min(most, damped))
                    self.joints[i] = reading(**{"time": self.now - 0.001, "effort": torque, **change})
            before = list(self.applied)
            hangs = self.effort is not None and self.machine.state is State.CHECKING
            effort = self.while_hanging if hangs else self.effort
            efforts = Efforts(effort, self.now - self.effort_age, self.damped, self.held)
            self.command = self.machine.step(self.now, tuple(self.joints), efforts)
            for i in {0, 1, 2, 3} - self.silent:
                self.applied[i] = 0.0 if i in self.off else self.command.effort[i]
            self.off -= {i for i in self.off if self.command.send[i] is Send.ENTER}
            own = {0, 1, 2, 3} - self.off
            self.steps.append(max((abs(self.applied[i] - before[i]) for i in own), default=0.0))
        return self

    def until(self, state: State, limit: float = 10.0) -> SafetyRun:
        """Run the machine until it is in `state`, in `limit` s at most."""
        end = self.now + limit
        while self.machine.state is not state:
            assert self.now < end, (self.machine.state, self.machine.fault)
            self.cycle()
        return self

    def until_active(self) -> SafetyRun:
        """Enable the machine and run it until the arm is carried."""
        self.machine.enable(self.now)
        return self.until(State.ACTIVE).cycle(0.1)

    @property
    def fault_code(self) -> str | None:
        """The code of the latched fault."""
        return self.machine.fault.code if self.machine.fault else None
