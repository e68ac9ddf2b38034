# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's torque, by the generalized-momentum observer on the compensator's own model.

A. De Luca and R. Mattone, ICRA 2005. With the momentum p = M v, the motors' torque tau and friction f,

    p' = tau + f + C^T v - g + wearer        residual r = p's share that tau + f + C^T v - g does not explain,

behind a low-pass of `bandwidth`: no acceleration is needed. f is friction and the device's own springs. M, C, g are
those of the robot plus the wearer's whole passive arm, g with the tissue of their relaxed joints as far as it is known:
so the residual is what their muscles add. Without a wearer in the settings the weight of their arm is part of it. One
low-pass h lags; the estimate is 2 r - h r, which a torque that changes steadily passes without lag.

Behind an elastic joint v is the motor's: its light rotor vibrates, and the observer would take that for momentum of the
links. No link follows so fast. So v passes the same 2 v - h v, where joints are said to be elastic. Where nothing is
said, such swings of a motor's speed widen the band.

The standard deviation is the root of the summed squares of all known errors. Not all of them are random: an error of
the model stays the same for as long as a pose is held.
"""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.springs import link_angles
from exo_gravity.core.arm.tilt import AXES, Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.catalogue import sliding
from exo_gravity.core.numbers import COVER, Torque, for_joints


@dataclass(frozen=True)
class ObserverTuning:
    """How fast the estimate is, and the errors that are no parameters; another arm's joints all get the most."""

    bandwidth: float = 15.0  #: rad/s of each of the two low-passes
    max_gap: float = 0.2  #: s between two samples, after which the observer starts anew
    #: Nm, (n,), of a joint whose friction was not identified: typical of backdrivable planetary gears
    typical_coulomb: Sequence[float] = (0.2, 0.4, 0.2, 0.2)
    friction_share: float = 0.15  #: of a sliding joint's friction: it differs by as much from pose to pose
    #: of Coulomb friction: that of a standing joint is anywhere between both signs, 1 / sqrt(3)
    sticking_share: float = 0.58
    velocity_code: float = 0.024 / math.sqrt(12.0)  #: rad/s, standard deviation of rounding to 12 bits
    inertia_share: float = 0.15  #: of the torque that accelerates the arm
    lag_share: float = 0.4  #: of the difference between the two low-passes
    #: of what the trunk feels beyond its low-passed mean: samples are late, and taken elsewhere
    motion_share: float = 0.3
    #: rad/s of each of two low-passes: links do not swing faster (100 Nm/rad and a worn arm: 18 rad/s), rotors do
    smooth: float = 20.0
    least_swing: float = 0.02  #: rad/s off the low-passed speed; three steps of its codes are no vibration
    swing_time: float = 0.3  #: s, time constant of the mean square of a swing
    #: of the links' momentum, if they swung as their motors do: what the low-passes leave of it, and without them
    swing_share: tuple[float, float] = (1.0, 2.0)
    reference: Sequence[float] = (0.0, 0.7, 0.6, 0.8)  #: rad, a usual pose: its inertia weighs the velocity codes


OBSERVER = ObserverTuning()


class WearerEstimate(NamedTuple):
    """What the wearer's joints add, each (n,) in Nm."""

    torque: Torque
    deviation: Torque  #: one standard deviation
    #: that carries the wearer's arm against gravity alone, also while the trunk shakes it; 0 without a wearer
    weight: Torque
    #: the part of the deviation in which one joint's error says nothing of another's: all but the error of the weight
    independent: Torque

    @property
    def distinguishable(self) -> tuple[bool, ...]:
        """Whether each torque (n,) differs from zero by more than its 95 % band."""
        pairs = zip(self.torque, self.deviation, strict=True)
        return tuple([abs(torque) > COVER * deviation for torque, deviation in pairs])


class MomentumObserver:
    """The observer of one arm. `update` takes 0.06 ms of arithmetic; any rate from 50 Hz on does."""

    def __init__(self, settings: Settings, tuning: ObserverTuning = OBSERVER) -> None:
        s, self._tuning = settings, tuning
        self._error = s.model_error
        self._whole = s.worn(s.loaded)
        self._gain, count = s.loaded.gain.tolist(), len(s.loaded.scale)
        self._wearer, self._tissue = s.worn(s.robot.massless(s.loaded.gravity)), s.tissue
        self._links = s.loaded.worn_links(s.wearer_mass, s.wearer_cog)
        self._spring, self._joint_stiffness = s.joint_spring, s.joint_stiffness
        friction = s.terms.friction
        self._is_known = any(friction.coulomb)
        self._coulomb = tuple(friction.coulomb) if self._is_known else for_joints(tuning.typical_coulomb, count, max)
        self._viscous, self._load = for_joints(friction.viscous, count), for_joints(friction.load, count)
        matrix = self._links.matrix(for_joints(tuning.reference, count, max))
        self._inertia: list[list[float]] = matrix.tolist()
        self._code = [2.0 * tuning.bandwidth * tuning.velocity_code * math.hypot(*row) for row in self._inertia]
        self._deflection = for_joints(self._error.deflection, count, max)
        self._is_elastic = [k > 0.0 or off > 0.0 for k, off in zip(s.joint_stiffness, self._deflection, strict=True)]
        self._time = -math.inf
        self._felt: tuple[float, ...] = ZERO
        self._momentum = self._input = self._inner = self._outer = self._slow = (0.0,) * count
        self._passed = self._passed_twice = self._swing = (0.0,) * count

    def update(
        self,
        now: float,
        joints: Sequence[Sequence[float]],
        tilt: Tilt,
        turning: Floats3 = ZERO,
        gravity_tilt: Tilt | None = None,
    ) -> WearerEstimate:
        """Return the estimate at `now` (s, monotonic), when the joints were read.

        joints: angles rad, velocities rad/s, and the motors' efforts Nm from now on, (n,) each.
        tilt: of what the trunk feels as gravity, with its magnitude.
        turning: the trunk's angular velocity in the arm's base frame, (3,) rad/s.
        gravity_tilt: of gravity alone, for the weight; None: `tilt`, as if the trunk were not shaken.
        """
        theta, velocity, effort = joints
        theta = link_angles(theta, effort, self._joint_stiffness)
        tuning, bandwidth = self._tuning, self._tuning.bandwidth
        columns = [self._whole.torque(theta, axis) for axis in AXES]
        felt = tuple([tilt.magnitude * component for component in tilt.direction])
        gravity = [sum(map(operator.mul, felt, column)) for column in zip(*columns, strict=True)]
        dt, self._time = now - self._time, now
        is_running = 0.0 < dt <= tuning.max_gap
        rubbing, friction = self._friction(velocity, effort)
        velocity, swing = self._of_links(dt if is_running else math.inf, velocity)
        momentum, coriolis = self._links.momentum(theta, velocity, turning)
        held = tuple(map(operator.add, gravity, self._spring.torque(theta))) if self._spring.on else gravity
        if self._tissue.on:
            held = tuple(map(operator.add, held, self._tissue.torque(theta)))
        unexplained = [tau + rub + c - h for tau, rub, c, h in zip(effort, rubbing, coriolis, held, strict=True)]
        if is_running:
            # The input since the last sample, with the momentum's mean.
            share = 1.0 - math.exp(-bandwidth * dt)
            self._inner = tuple([
                z + share * (u + 0.5 * bandwidth * (p + q) - z)
                for z, u, p, q in zip(self._inner, self._input, self._momentum, momentum, strict=True)
            ])  # fmt: skip
            once = [bandwidth * p - z for p, z in zip(momentum, self._inner, strict=True)]
            self._outer = low_passed(self._outer, once, share)
            self._slow = low_passed(self._slow, momentum, share)
            self._felt = low_passed(self._felt, felt, share)
        else:  # as if the arm did not accelerate
            once = [-u for u in unexplained]
            self._inner = tuple([bandwidth * p - r for p, r in zip(momentum, once, strict=True)])
            self._outer, self._slow, self._felt = tuple(once), momentum, felt
        self._input, self._momentum = tuple(unexplained), momentum
        lag = list(map(operator.sub, once, self._outer))
        still = (gravity_tilt or tilt)._replace(magnitude=1.0)
        worn = tuple(map(operator.mul, self._gain, self._wearer.torque(theta, still)))
        shaken = tuning.motion_share * math.dist(felt, self._felt)
        largest = [math.hypot(*column) for column in zip(*columns, strict=True)]  # gravity in any direction
        bent = self._bent(theta, tilt, gravity)
        independent = [
            math.hypot(
                self._error.torque[n],
                self._error.scale[n] * effort[n],
                self._error.wearer_torque[n],
                self._error.tilt * math.sqrt(max(0.0, (tilt.magnitude * largest[n]) ** 2 - gravity[n] ** 2)),
                bent[n],
                shaken * largest[n],
                friction[n],
                self._code[n],
                swing[n],
                tuning.inertia_share * bandwidth * (momentum[n] - self._slow[n]),
                tuning.lag_share * lag[n],
            )
            for n in range(len(lag))
        ]
        deviation = [math.hypot(own, self._error.wearer * w) for own, w in zip(independent, worn, strict=True)]
        return WearerEstimate(tuple(map(operator.add, once, lag)), tuple(deviation), worn, tuple(independent))

    def _bent(self, theta: Sequence[float], tilt: Tilt, gravity: Sequence[float]) -> list[float]:
        """Return the standard deviation (n,) in Nm of `gravity` (n,), for links that may lie off `theta` (n,) rad."""
        error = [0.0] * len(gravity)
        for joint, off in enumerate(self._deflection):
            if off:
                turned = [angle + off * (n == joint) for n, angle in enumerate(theta)]
                changes = map(operator.sub, self._whole.torque(turned, tilt), gravity)
                error = list(map(math.hypot, error, changes))
        return error

    def _of_links(self, dt: float, velocity: Sequence[float]) -> tuple[Sequence[float], list[float]]:
        """Return the links' velocities (n,) in rad/s, and the standard deviation (n,) in Nm by motors that vibrate.

        dt: s since the last sample, infinite for the first. velocity: (n,) rad/s, of the motors.
        """
        tuning = self._tuning
        share = 1.0 - math.exp(-tuning.smooth * dt)
        self._passed = low_passed(self._passed, velocity, share)
        self._passed_twice = low_passed(self._passed_twice, self._passed, share)
        smooth = [2.0 * once - twice for once, twice in zip(self._passed, self._passed_twice, strict=True)]
        off = [max(0.0, (v - slow) ** 2 - tuning.least_swing**2) for v, slow in zip(velocity, smooth, strict=True)]
        self._swing = low_passed(self._swing, off, 1.0 - math.exp(-dt / tuning.swing_time))
        left, whole = tuning.swing_share
        swings = zip(self._swing, self._is_elastic, strict=True)
        size = [(left if is_elastic else whole) * math.sqrt(square) for square, is_elastic in swings]
        error = [tuning.bandwidth * math.hypot(*map(operator.mul, row, size)) for row in self._inertia]
        columns = zip(velocity, smooth, self._is_elastic, strict=True)
        return [slow if is_elastic else v for v, slow, is_elastic in columns], error

    def _friction(self, velocity: Sequence[float], effort: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return the joints' friction (n,) in Nm, against the motion, and its standard deviation."""
        torque, deviation = [], []
        columns = zip(velocity, effort, self._coulomb, self._viscous, self._load, strict=True)
        for v, carried, constant, viscous, load in columns:
            moving, coulomb = sliding(v), constant + load * abs(carried)
            whole = moving * (coulomb + viscous * abs(v))
            torque.append(-math.copysign(whole, v) if self._is_known else 0.0)
            unsure = self._tuning.friction_share * whole if self._is_known else whole
            deviation.append(math.hypot(unsure, (1.0 - moving) * self._tuning.sticking_share * coulomb))
        return torque, deviation


def low_passed(value: Torque, target: Sequence[float], share: float) -> Torque:
    """Return `value` (n,) moved towards `target` (n,) by `share` of their difference."""
    return tuple([old + share * (new - old) for old, new in zip(value, target, strict=True)])
