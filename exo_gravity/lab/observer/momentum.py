"""The wearer's torque, by the generalized-momentum observer on the compensator's own model.

A. De Luca and R. Mattone, ICRA 2005. With the momentum p = M v, the motors' torque tau and friction f,

    p' = tau + f + C^T v - g + wearer        residual r = p's share that tau + f + C^T v - g does not explain,

behind a low-pass of BANDWIDTH: no acceleration is needed. M, C, g are those of the robot plus the wearer's whole
passive arm, so the residual is what his muscles (and the passive tissue of his joints) add; without a wearer in the
settings his arm's weight is part of it. One low-pass h lags; the estimate is 2 r - h r, which a torque that changes
steadily passes without lag.

The standard deviation is the root of the summed squares of all known errors. Not all of them are random: an error of
the model stays the same for as long as a pose is held.
"""

import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE, Torque, exact_torque
from exo_gravity.core.arm.kinematics import ROTORS, LinkInertia, links_of
from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.tilt import AXES, Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.catalogue import sliding
from exo_gravity.core.numbers import COVER

BANDWIDTH = 15.0  # rad/s of each of the two low-passes
MAX_GAP = 0.2  # s between two samples, after which the observer starts anew
# Nm, of a joint whose friction was not identified: typical of backdrivable planetary gears
TYPICAL_COULOMB = (0.2, 0.4, 0.2, 0.2)
FRICTION_SHARE = 0.15  # of a sliding joint's friction: it differs by as much from pose to pose
STICKING_SHARE = 0.58  # of Coulomb friction: that of a standing joint is anywhere between both signs, 1 / sqrt(3)
VELOCITY_CODE = 0.024 / math.sqrt(12.0)  # rad/s, standard deviation of rounding to 12 bits
INERTIA_SHARE = 0.15  # of the torque that accelerates the arm
LAG_SHARE = 0.4  # of the difference between the two low-passes
MOTION_SHARE = 0.3  # of what the trunk feels beyond its low-passed mean: samples are late, and taken elsewhere
REFERENCE = (0.0, 0.7, 0.6, 0.8)  # rad, a usual pose: its inertia weighs the velocity codes
# Contact: the torque changes faster than a person's does, as at a table's edge.
FOLLOWED_TIME = 0.1  # s, time constant of what a person's torque follows,
LEAST = (3.0, 5.0, 3.0, 1.5)  # Nm beyond that: 1.3 times the most that `make wearer-study` saw of reaching wearers
PAUSE = 1.0  # s without another one, after which a contact is a new one


class WearerEstimate(NamedTuple):
    """What the wearer's joints add, each (4,) in Nm."""

    torque: Torque
    deviation: Torque  #: one standard deviation
    weight: Torque  #: that carries the wearer's arm against gravity, 0 without a wearer in the settings

    @property
    def distinguishable(self) -> tuple[bool, ...]:
        """Whether each torque (4,) differs from zero by more than its 95 % band."""
        pairs = zip(self.torque, self.deviation, strict=True)
        return tuple([abs(torque) > COVER * deviation for torque, deviation in pairs])


class MomentumObserver:
    """The observer of one arm. `update` takes 0.06 ms of arithmetic; any rate from 50 Hz on does."""

    def __init__(self, settings: Settings) -> None:
        s = settings
        self._error = s.model_error
        self._whole = s.loaded.with_wearer(s.wearer_mass, s.wearer_cog)
        self._wearer = ArmModel(s.loaded.length, s.wearer_cog, s.wearer_mass, s.loaded.gain, s.loaded.gravity)
        own, worn = links_of(s.loaded), links_of(self._wearer)
        rows = zip(own.weights, worn.weights, strict=True)
        self._links = LinkInertia(tuple([tuple(map(operator.add, *row)) for row in rows]), ROTORS)
        friction = s.terms.friction
        self._is_known = any(friction.coulomb)
        self._coulomb = tuple(friction.coulomb) if self._is_known else TYPICAL_COULOMB
        self._viscous = tuple(friction.viscous)
        matrix = self._links.matrix(REFERENCE)
        self._code = [2.0 * BANDWIDTH * VELOCITY_CODE * math.hypot(*row) for row in matrix.tolist()]
        self._time = -math.inf
        self._felt: tuple[float, ...] = ZERO
        self._momentum = self._input = self._inner = self._outer = self._slow = NO_TORQUE

    def update(
        self, now: float, joints: Sequence[Sequence[float]], tilt: Tilt, turning: Floats3 = ZERO
    ) -> WearerEstimate:
        """Return the estimate at `now` (s, monotonic), when the joints were read.

        joints: angles rad, velocities rad/s, and the motors' efforts Nm from now on, (4,) each. tilt: of what the trunk
        feels as gravity, with its magnitude. turning: the trunk's angular velocity in the arm's base frame, (3,) rad/s.
        """
        theta, velocity, effort = joints
        columns = [exact_torque(self._whole, theta, axis) for axis in AXES]
        felt = tuple([tilt.magnitude * component for component in tilt.direction])
        gravity = [sum(map(operator.mul, felt, column)) for column in zip(*columns, strict=True)]
        rubbing, friction = self._friction(velocity)
        momentum, coriolis = self._links.momentum(theta, velocity, turning)
        unexplained = [tau + rub + c - g for tau, rub, c, g in zip(effort, rubbing, coriolis, gravity, strict=True)]
        dt, self._time = now - self._time, now
        if 0.0 < dt <= MAX_GAP:
            # The input since the last sample, with the momentum's mean.
            share = 1.0 - math.exp(-BANDWIDTH * dt)
            self._inner = tuple([
                z + share * (u + 0.5 * BANDWIDTH * (p + q) - z)
                for z, u, p, q in zip(self._inner, self._input, self._momentum, momentum, strict=True)
            ])  # fmt: skip
            once = [BANDWIDTH * p - z for p, z in zip(momentum, self._inner, strict=True)]
            self._outer = _followed(self._outer, once, share)
            self._slow = _followed(self._slow, momentum, share)
            self._felt = _followed(self._felt, felt, share)
        else:  # as if the arm did not accelerate
            once = [-u for u in unexplained]
            self._inner = tuple([BANDWIDTH * p - r for p, r in zip(momentum, once, strict=True)])
            self._outer, self._slow, self._felt = tuple(once), momentum, felt
        self._input, self._momentum = tuple(unexplained), momentum
        lag = list(map(operator.sub, once, self._outer))
        worn = exact_torque(self._wearer, theta, tilt)
        shaken = MOTION_SHARE * math.dist(felt, self._felt)
        largest = [math.hypot(*column) for column in zip(*columns, strict=True)]  # gravity in any direction
        deviation = [
            math.hypot(
                self._error.torque[n],
                self._error.scale[n] * effort[n],
                self._error.wearer * worn[n],
                self._error.tilt * math.sqrt(max(0.0, (tilt.magnitude * largest[n]) ** 2 - gravity[n] ** 2)),
                shaken * largest[n],
                friction[n],
                self._code[n],
                INERTIA_SHARE * BANDWIDTH * (momentum[n] - self._slow[n]),
                LAG_SHARE * lag[n],
            )
            for n in range(len(lag))
        ]
        return WearerEstimate(tuple(map(operator.add, once, lag)), tuple(deviation), worn)

    def _friction(self, velocity: Sequence[float]) -> tuple[list[float], list[float]]:
        """Return the joints' friction (4,) in Nm, against the motion, and its standard deviation."""
        torque, deviation = [], []
        for v, coulomb, viscous in zip(velocity, self._coulomb, self._viscous, strict=True):
            moving = sliding(v)
            whole = moving * (coulomb + viscous * abs(v))
            torque.append(-math.copysign(whole, v) if self._is_known else 0.0)
            unsure = FRICTION_SHARE * whole if self._is_known else whole
            deviation.append(math.hypot(unsure, (1.0 - moving) * STICKING_SHARE * coulomb))
        return torque, deviation


class ContactWatch:
    """Counts the contacts of one arm. last: time in s, joint (0..3) and Nm of the newest, None before the first."""

    def __init__(self) -> None:
        self.count = 0
        self.last: tuple[float, int, float] | None = None
        self._slow = NO_TORQUE
        self._time = self._touched = -math.inf  # s

    def update(self, now: float, estimate: WearerEstimate) -> None:
        """Take the estimate at `now` s."""
        dt, self._time = now - self._time, now
        if not 0.0 <= dt <= FOLLOWED_TIME:
            self._slow, dt = estimate.torque, 0.0
        self._slow = _followed(self._slow, estimate.torque, dt / FOLLOWED_TIME)
        jumps = list(map(operator.sub, estimate.torque, self._slow))
        columns = zip(jumps, LEAST, estimate.distinguishable, strict=True)
        sizes = [abs(jump) / least if shown else 0.0 for jump, least, shown in columns]
        joint = max(range(len(sizes)), key=sizes.__getitem__)
        if sizes[joint] > 1.0:
            if now - self._touched > PAUSE:
                self.count, self.last = self.count + 1, (now, joint, jumps[joint])
            self._touched = now


def _followed(value: Torque, target: Sequence[float], share: float) -> Torque:
    return tuple([old + share * (new - old) for old, new in zip(value, target, strict=True)])
