# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rules by which a joint that its own feed-forward drives may be braked; they are compared on the same cases.

Each is a `Barrier` with another `brake`. There are four kinds: by the joint's speed, by the power of the feed-forward,
by the work that it has done, and by the torque that a momentum observer does not explain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.barrier import BARRIER, Barrier
from exo_gravity.core.safety.limits import DAMPING, Limits
from exo_gravity.lab.observer.momentum import MomentumObserver

from .cases import COG, MASS, PEAK, ROBOT

FIRST = 1.5  # rad/s, where the brake begins by every rule that knows one


def share(value: float, start: float, span: float = BARRIER.span) -> float:
    """Return 0 up to `start`, 1 from `span` beyond it on, and between them what lies on the line."""
    return max(0.0, min(1.0, (value - start) / span))


def along(value: float, direction: float) -> float:
    """Return what of `value`, a speed or torque, points the way of `direction`; negative if it points against it."""
    return math.copysign(value, value * direction) if direction else 0.0


class Nothing(Barrier):
    """No brake."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return no damping."""
        return [0.0] * len(effort)


class FullDamping(Barrier):
    """Speed: all damping that there is."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        pairs = zip(joints, effort, strict=True)
        return [DAMPING * share(along(joint.velocity, tau), FIRST) for joint, tau in pairs]


class NewestSpeed(Barrier):
    """Speed: as the barrier, without lead and hold."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        full = FIRST + BARRIER.span
        pairs = zip(joints, effort, strict=True)
        return [abs(tau) / full * share(along(joint.velocity, tau), FIRST) for joint, tau in pairs]


class Power(Barrier):
    """Power: as `NewestSpeed` where the feed-forward is at its largest; with less torque, at more speed."""

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        full = FIRST + BARRIER.span
        columns = zip(joints, effort, self._limits.max_effort, strict=True)
        return [abs(tau) / full * share(tau * joint.velocity / most, FIRST) for joint, tau, most in columns]


class Tank(Barrier):
    """Work: a tank for each joint, which feed-forward fills, and which loses 0.5 W per Nm of it.

    It cannot tell a lift from a throw: the feed-forward is the derivative of the load's potential energy, whether the
    load is still there or gone.
    """

    levels: Sequence[float] = NO_TORQUE  # J

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        columns = list(zip(self.levels, joints, effort, strict=True))
        gains = [max(0.0, tau * joint.velocity) - 0.5 * abs(tau) for _, joint, tau in columns]
        self.levels = [max(0.0, level + dt * gain) for (level, _, _), gain in zip(columns, gains, strict=True)]
        return [
            abs(tau) * share(level, 0.3, 0.6) / max(0.5, abs(joint.velocity)) if tau * joint.velocity > 0.0 else 0.0
            for level, (_, joint, tau) in zip(self.levels, columns, strict=True)
        ]


class Observed(Barrier):
    """Observer: as the barrier, but only where more than 1 Nm that the model does not explain speeds the joint up."""

    def __init__(self, limits: Limits, peak_damping: Sequence[float]) -> None:
        super().__init__(limits, peak_damping)
        settings = Settings(
            "right", ROBOT, mode="zero_g", support=1.0, wearer_mass=MASS, wearer_cog=COG, max_effort=PEAK
        )
        self._observer = MomentumObserver(settings)

    def brake(self, dt: float, joints: Sequence[JointSample], effort: Sequence[float]) -> Sequence[float]:
        """Return the damping (n,) Nm s/rad."""
        brakes = super().brake(dt, joints, effort)
        position, velocity, torque, _, _, times, *_ = zip(*joints, strict=True)
        estimate = self._observer.update(min(times), (position, velocity, torque), Tilt.of("right", 0.0, 0.0))
        columns = zip(brakes, estimate.torque, velocity, strict=True)
        return [kd * share(along(unexplained, speed), 1.0) for kd, unexplained, speed in columns]


Make = Callable[[Limits, Sequence[float]], Barrier]
RULES: dict[str, Make] = {
    "none": Nothing,
    "the barrier": Barrier,
    "the barrier from 2 rad/s": lambda limits, peak: Barrier(replace(limits, driven_speed=2.0), peak),
    "newest speed": NewestSpeed,
    "full damping": FullDamping,
    "power": Power,
    "work": Tank,
    "observer": Observed,
}
