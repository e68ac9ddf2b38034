"""Rules by which a joint that its own feed-forward drives may be damped; they are compared on the same cases.

Each is a `Barrier` with another `brake`. Four kinds: the joint's speed; the power of the feed-forward; the work that it
has done in excess of what gravity has taken back; the torque that a momentum observer does not explain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.barrier import Barrier
from exo_gravity.core.safety.limits import DAMPING, Limits
from exo_gravity.lab.observer.momentum import MomentumObserver

from .cases import COG, MASS, PEAK, ROBOT


def share(value: float, start: float, full: float) -> float:
    """Return 0 up to `start`, 1 from `full` on, and between them what lies on the line."""
    return max(0.0, min(1.0, (value - start) / (full - start)))


def along(velocity: float, effort: float) -> float:
    """Return the speed in rad/s with which `effort` drives a joint; negative where the joint moves against it."""
    return math.copysign(velocity, velocity * effort) if effort else 0.0


class Nothing(Barrier):
    """No barrier."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return no damping."""
        return [0.0] * len(effort)


class FullDamping(Barrier):
    """(a) Damping rises to its most from 1.5 to 2.5 rad/s."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        pairs = zip(joints, effort, strict=True)
        return [DAMPING * share(along(joint.velocity, tau), 1.5, 2.5) for joint, tau in pairs]


class Power(Barrier):
    """(b) The feed-forward is cancelled from 1.5 to 2.5 rad/s at its largest torque; at less torque, at more speed."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        brakes = []
        for joint, tau, most in zip(joints, effort, self._limits.max_effort, strict=True):
            power = max(0.0, tau * joint.velocity)
            cancelled = share(power, 1.5 * most, 2.5 * most) * abs(tau)
            brakes.append(cancelled / abs(joint.velocity) if cancelled else 0.0)
        return brakes


class Tank(Barrier):
    """(c) A tank of energy for each joint: the feed-forward fills it, 0.5 W per Nm of its torque empties it.

    What it did within the carried load's potential energy cannot be told from what it did to an arm that is gone: the
    feed-forward is that potential's derivative.
    """

    levels = (0.0,) * len(PEAK)

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        brakes, levels = [], []
        for level, joint, tau in zip(self.levels, joints, effort, strict=True):
            filled = max(0.0, level + dt * (max(0.0, tau * joint.velocity) - 0.5 * abs(tau)))
            levels.append(filled)
            cancelled = share(filled, 0.3, 0.9) * abs(tau) if tau * joint.velocity > 0.0 else 0.0
            brakes.append(cancelled / max(0.5, abs(joint.velocity)))
        self.levels = tuple(levels)
        return brakes


def speed(start: float, full: float, lead: float) -> type[Barrier]:
    """Return (a): from `start` to `full` rad/s the feed-forward is cancelled, at the speed `lead` s from now."""

    class Cancelled(Barrier):
        last: Sequence[JointSample] = ()
        gains = (0.0,) * len(PEAK)

        def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
            brakes, gains = [], []
            for i, (joint, tau) in enumerate(zip(joints, effort, strict=True)):
                gained = self.gains[i]
                if self.last and joint.time > self.last[i].time:
                    gained = (joint.velocity - self.last[i].velocity) / (joint.time - self.last[i].time)
                gains.append(gained)
                driven = max(along(joint.velocity, tau), along(joint.velocity + lead * gained, tau))
                cancelled = share(driven, start, full) * abs(tau)
                brakes.append(cancelled / full)
            self.last, self.gains = tuple(joints), tuple(gains)
            return brakes

    return Cancelled


class Observer(speed(1.5, 2.5, 0.012)):  # type: ignore[misc]
    """(d) As the speed's rule with a lead, where the momentum observer sees more than 1 Nm that speeds the joint up."""

    def __init__(self, limits: Limits, peak_damping: Sequence[float]) -> None:
        super().__init__(limits, peak_damping)
        settings = Settings("right", ROBOT, mode="zero_g", wearer_mass=MASS, wearer_cog=COG, max_effort=PEAK)
        self._observer = MomentumObserver(settings)

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        brakes = super().brake(dt, joints, effort)
        position, velocity, torque, _, _, times = zip(*joints, strict=True)
        upright = Tilt.of("right", 0.0, 0.0)
        estimate = self._observer.update(min(times), (position, velocity, torque), upright)
        unexplained = estimate.torque if estimate else np.zeros(len(effort))
        columns = zip(brakes, unexplained, joints, strict=True)
        return [kd * share(math.copysign(1.0, joint.velocity) * tau, 1.0, 2.0) for kd, tau, joint in columns]


Make = Callable[[Limits, Sequence[float]], Barrier]
RULES: dict[str, Make] = {
    "none": Nothing,
    "speed, full damping": FullDamping,
    "1.5 to 2.5": speed(1.5, 2.5, 0.0),
    "1.5 to 2.5, lead 6 ms": speed(1.5, 2.5, 0.006),
    "1.5 to 2.5, lead 12 ms": speed(1.5, 2.5, 0.012),
    "2 to 2.5, lead 6 ms": speed(2.0, 2.5, 0.006),
    "2 to 2.5, lead 12 ms": speed(2.0, 2.5, 0.012),
    "power": Power,
    "tank": Tank,
    "observer": Observer,
}
