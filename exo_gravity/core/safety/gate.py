"""The start gate: what must hold before the motors of an arm are switched on, and before they carry it.

`StartGate` waits until, for CALM seconds, every motor has replied without a fault, at rest and within its limits, and
fresh efforts have arrived. `Proving` then checks that the motors are on, and that their signs are right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.safety.delivery import SwitchOnCheck
from exo_gravity.core.safety.faults import Fault, FaultCode
from exo_gravity.core.safety.limits import JointSample, Limits
from exo_gravity.core.safety.sign_check import SignCheck

AT_REST = 0.1  # rad/s; two to four codes of the 12-bit velocity
CALM = 1.0  # s without a fault before the motors are switched on: middleware and machine stutter while nodes start
# The gate waits for these to pass; other faults refuse the start.
WAITED_OUT = frozenset({FaultCode.MOTOR_SILENT, FaultCode.OVER_SPEED})


class StartGate:
    """Waits for the conditions of a start. waiting_for: the condition that is not met; passed: whether all were."""

    def __init__(self, limits: Limits, now: float) -> None:
        self.waiting_for = "the first replies of the motors"
        self.passed = False
        self._limits = limits
        self._calm_since = now

    def step(
        self,
        now: float,
        joints: Sequence[JointSample],
        before: Sequence[JointSample],
        efforts_are_fresh: bool,
        zeros_are_trusted: bool,
    ) -> Fault | None:
        """Check the newest readings and those `before` them at `now` (s); return a fault that refuses the start."""
        limits = self._limits
        outside = self._outside(joints)
        fault = limits.find_fault(now, joints, before, overshoot=math.inf)
        if not fault and not outside and not zeros_are_trusted:
            fault = limits.find_wrong_zero(joints)
        if fault and fault.code not in WAITED_OUT:
            return fault
        if fault:
            self.waiting_for = fault.reason
        elif outside:
            self.waiting_for = outside
        elif any(abs(joint.velocity) > AT_REST for joint in joints):
            self.waiting_for = "the arm to be at rest"
        elif not efforts_are_fresh:
            self.waiting_for = "effort commands"
        else:
            self.waiting_for = f"{CALM:g} s without a fault"
            self.passed = now - self._calm_since >= CALM
            return None
        self._calm_since = now
        return None

    def _outside(self, joints: Sequence[JointSample]) -> str:
        """Return which joint must be moved, how far and which way to be within its limits, or ''."""
        limits = self._limits
        columns = (limits.joint_names, joints, limits.position_min, limits.position_max)
        for name, joint, low, high in zip(*columns, strict=True):
            excess = joint.position - max(low, min(high, joint.position))
            if excess:
                return f"{name} to be moved by {-excess:+.2f} rad, within its limits {low:g} to {high:g}"
        return ""


class Proving:
    """The checks with the motors on: each one must show that it is on, and if `signs` is true, its sign is checked.

    effort: (4,) Nm to apply now. done: whether all joints have passed. hint: what the wearer should do, or ''.
    """

    def __init__(self, limits: Limits, signs: bool) -> None:
        push = [min(limits.sign_check_torque, most) if signs else 0.0 for most in limits.max_effort]
        self._switch_on = SwitchOnCheck(limits)
        self._signs = SignCheck(limits.joint_names, push, limits.max_effort_rate)

    @property
    def effort(self) -> tuple[float, ...]:
        """Torque (4,) in Nm to apply now."""
        return tuple((self._signs if self._switch_on.done else self._switch_on).effort)

    @property
    def switched_on(self) -> bool:
        """Whether all motors have shown that they are on."""
        return self._switch_on.done

    @property
    def done(self) -> bool:
        """Whether all joints have passed."""
        return self._switch_on.done and self._signs.done

    @property
    def hint(self) -> str:
        """What the wearer should do, or ''."""
        return self._signs.hint

    def step(self, dt: float, joints: Sequence[JointSample], damping: Sequence[float]) -> Fault | None:
        """Advance by `dt` s with the newest readings, and the damping (4,) in Nm s/rad that the motors apply.

        Returns the fault that they show, if any.
        """
        if self._switch_on.done:
            return self._signs.step(dt, joints)
        return self._switch_on.step(dt, joints, damping)
