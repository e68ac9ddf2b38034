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

import itertools
import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.springs import link_angles
from exo_gravity.core.arm.tilt import AXES, Tilt, turning_in_base
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.support import REQUEST
from exo_gravity.core.compensation.terms.catalogue import sliding
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import COVER, for_joints
from exo_gravity.core.vocabulary import NONE, UNKNOWN, Source
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.inputs.arms import recorded_of, settings_from
from exo_gravity.lab.trial.analysis import Recording
from exo_gravity.lab.vocabulary import Adapts


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

    torque: np.ndarray
    deviation: np.ndarray  #: one standard deviation
    #: that carries the wearer's arm against gravity alone, also while the trunk shakes it; 0 without a wearer
    weight: np.ndarray
    #: the part of the deviation in which one joint's error says nothing of another's: all but the error of the weight
    independent: np.ndarray


class MomentumObserver:
    """The observer of one arm. `update` takes 0.1 ms of arithmetic; any rate from 50 Hz on does."""

    def __init__(self, settings: Settings) -> None:
        s, count = settings, len(settings.loaded.scale)
        self._error = s.model_error
        self._whole = s.worn(s.loaded)
        self._gain = np.array(s.loaded.gain)
        self._wearer, self._tissue = s.worn(s.robot.massless(s.loaded.gravity)), s.tissue
        self._links = s.loaded.worn_links(s.wearer_mass, s.wearer_cog)
        self._spring, self._joint_stiffness = s.joint_spring, s.joint_stiffness
        friction = s.terms.friction
        self._is_known = any(friction.coulomb)
        coulomb = friction.coulomb if self._is_known else for_joints(OBSERVER.typical_coulomb, count, max)
        columns = coulomb, for_joints(friction.viscous, count), for_joints(friction.load, count)
        self._coulomb, self._viscous, self._load = map(np.array, columns)
        self._inertia = self._links.matrix(for_joints(OBSERVER.reference, count, max))
        code = 2.0 * OBSERVER.bandwidth * OBSERVER.velocity_code * np.linalg.norm(self._inertia, axis=1)
        self._constant = np.linalg.norm((self._error.torque, self._error.wearer_torque, code), axis=0)  # Nm
        deflection = np.array(for_joints(self._error.deflection, count, max))
        self._bent = np.diag(deflection)[deflection > 0.0]  # rad by which links are off, one link a row
        self._is_elastic = (np.array(s.joint_stiffness) > 0.0) | (deflection > 0.0)
        self._time = -math.inf
        self._felt = np.zeros(3)
        self._momentum = self._input = self._inner = self._outer = self._slow = np.zeros(count)
        self._passed = self._passed_twice = self._swing = np.zeros(count)

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
        theta = link_angles(joints[0], joints[2], self._joint_stiffness)
        effort, bandwidth = np.array(joints[2]), OBSERVER.bandwidth
        columns = np.array([self._whole.torque(theta, axis) for axis in AXES])
        felt = tilt.magnitude * np.array(tilt.direction)
        gravity = felt @ columns
        dt, self._time = now - self._time, now
        dt = dt if 0.0 < dt <= OBSERVER.max_gap else math.inf  # of the first sample
        rubbing, friction = self._friction(np.array(joints[1]), effort)
        velocity, swing = self._of_links(dt, np.array(joints[1]))
        momentum, coriolis = map(np.array, self._links.momentum(theta, velocity.tolist(), turning))
        held = gravity + self._spring.torque(theta) + self._tissue.torque(theta)
        once, lag = self._residual(dt, momentum, effort + rubbing + coriolis - held)
        still = (gravity_tilt or tilt)._replace(magnitude=1.0)
        worn = self._gain * self._wearer.torque(theta, still)
        self._felt = low_passed(self._felt, felt, 1.0 - math.exp(-bandwidth * dt))
        shaken = OBSERVER.motion_share * math.dist(felt, self._felt)
        largest = np.sqrt(np.square(columns).sum(axis=0))  # gravity in any direction
        leaning = np.maximum(0.0, (tilt.magnitude * largest) ** 2 - gravity**2)
        parts = (
            self._constant,
            self._error.scale * effort,
            self._error.tilt * np.sqrt(leaning),
            *(np.subtract(self._whole.torque((theta + off).tolist(), tilt), gravity) for off in self._bent),
            shaken * largest,
            friction,
            swing,
            OBSERVER.inertia_share * bandwidth * (momentum - self._slow),
            OBSERVER.lag_share * lag,
        )
        independent = np.sqrt(np.square(parts).sum(axis=0))
        return WearerEstimate(once + lag, np.hypot(independent, self._error.wearer * worn), worn, independent)

    def _residual(self, dt: float, momentum: np.ndarray, unexplained: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the low-passed residual (n,) in Nm, and by how much one more low-pass lags.

        dt: s since the last sample; infinite: as if the arm did not accelerate. unexplained: (n,) Nm from now on.
        """
        bandwidth = OBSERVER.bandwidth
        share = 1.0 - math.exp(-bandwidth * dt)
        if math.isinf(dt):
            self._momentum, self._input = momentum, unexplained
        # The input since the last sample, with the momentum's mean.
        driven = self._input + 0.5 * bandwidth * (self._momentum + momentum)
        self._inner = low_passed(self._inner, driven, share)
        once = bandwidth * momentum - self._inner
        self._outer, self._slow = low_passed(self._outer, once, share), low_passed(self._slow, momentum, share)
        self._input, self._momentum = unexplained, momentum
        return once, once - self._outer

    def _of_links(self, dt: float, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the links' velocities (n,) in rad/s, and the standard deviation (n,) in Nm by motors that vibrate.

        dt: s since the last sample, infinite for the first. velocity: (n,) rad/s, of the motors.
        """
        share = 1.0 - math.exp(-OBSERVER.smooth * dt)
        self._passed = low_passed(self._passed, velocity, share)
        self._passed_twice = low_passed(self._passed_twice, self._passed, share)
        smooth = 2.0 * self._passed - self._passed_twice
        off = np.maximum(0.0, (velocity - smooth) ** 2 - OBSERVER.least_swing**2)
        self._swing = low_passed(self._swing, off, 1.0 - math.exp(-dt / OBSERVER.swing_time))
        size = np.where(self._is_elastic, *OBSERVER.swing_share) * np.sqrt(self._swing)
        error = OBSERVER.bandwidth * np.sqrt(np.square(self._inertia * size).sum(axis=1))
        return np.where(self._is_elastic, smooth, velocity), error

    def _friction(self, velocity: np.ndarray, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the joints' friction (n,) in Nm, against the motion, and its standard deviation."""
        moving, coulomb = np.array([*map(sliding, velocity)]), self._coulomb + self._load * np.abs(effort)
        whole = moving * (coulomb + self._viscous * np.abs(velocity))
        unsure = OBSERVER.friction_share * whole if self._is_known else whole
        deviation = np.hypot(unsure, (1.0 - moving) * OBSERVER.sticking_share * coulomb)
        return -self._is_known * np.copysign(whole, velocity), deviation


def low_passed(value: np.ndarray, target: np.ndarray, share: float) -> np.ndarray:
    """Return `value` (n,) moved towards `target` (n,) by `share` of their difference."""
    return value + share * (target - value)


PERIOD = 0.01  # s between two samples


@dataclass(frozen=True)
class ShareTuning:
    """Over which time the share is taken, and of what."""

    window: float = 1.0  #: s of the sliding share
    least_weight: float = 0.5  #: Nm, root mean square over time of w's length: below, there is nothing to carry
    least_of_joint: float = 0.3  #: Nm, the same of one joint


SHARE = ShareTuning()


class WearerCurve(NamedTuple):
    """The wearer's torque over time: what `MomentumObserver` estimates, n times."""

    time: np.ndarray  #: (n,) s
    torque: np.ndarray  #: (n, m) Nm
    deviation: np.ndarray  #: (n, m) Nm, one standard deviation
    weight: np.ndarray  #: (n, m) Nm that carry the wearer's arm
    independent: np.ndarray  #: (n, m) Nm, the part of the deviation that is each joint's own


class Share(NamedTuple):
    """The wearer's share, and its standard deviation; NaN where there is nothing to carry. Numbers, or arrays (n,).

    With their torque tau and the torque w that carries their arm against gravity alone, both (n,), over any span of
    time

        share = sum tau . w / sum w . w                of joint j: sum tau_j w_j / sum w_j^2

    The whole share is the mean of the joints', weighted by sum w_j^2: a joint that carries little hardly changes it.
    What accelerates the arm and overcomes friction cancels out of the sum over a movement there and back. The errors of
    one joint are taken to be the same over the whole span, as those of a model are: a longer span has no narrower band.
    An error of the weight itself is the same share of it in every joint.
    """

    value: np.ndarray
    deviation: np.ndarray


class Shares(NamedTuple):
    """The wearer's share of what carries their arm."""

    whole: Share
    joints: Share  #: (m,)


def observed(
    settings: Settings,
    time: np.ndarray,
    joints: tuple[np.ndarray, np.ndarray, np.ndarray],
    trunk_at: Callable[[float], tuple[Tilt, Floats3, Tilt]],
) -> WearerCurve:
    """Return what the observer makes of a recording.

    time: (n,) s, in ascending order. joints: position rad, velocity rad/s and measured effort Nm, (n, m) each; samples
    with NaN are left out. trunk_at: tilt of what the trunk feels, its angular velocity, and tilt of gravity alone at a
    time in s, as `MomentumObserver.update` takes them.
    """
    observer, rows, last = MomentumObserver(settings), [], -math.inf
    for now, *row in zip(time.tolist(), *(values.tolist() for values in joints), strict=True):
        if now - last > 0.9 * PERIOD and all(map(math.isfinite, itertools.chain(*row))):
            last = now
            rows.append((now, *observer.update(now, row, *trunk_at(now))))
    times, *parts = zip(*rows, strict=True) if rows else ((),) * 5
    return WearerCurve(np.array(times), *(np.reshape(part, (-1, len(settings.robot.scale))) for part in parts))


def while_between(curve: WearerCurve, spans: Iterable[tuple[float, float]]) -> WearerCurve:
    """Return the parts of the curve within `spans`, each from and to a time in s."""
    within = [(curve.time >= start) & (curve.time <= end) for start, end in spans]
    keep = np.any(within, axis=0) if within else np.zeros(len(curve.time), bool)
    return WearerCurve(*(part[keep] for part in curve))


def shares_of(curve: WearerCurve, window: float = math.inf) -> Shares:
    """Return the wearer's shares over the last `window` s at each time, or over the whole curve."""
    products = _products(*curve[1:])
    if math.isinf(window):
        return _shares(products.sum(axis=1), len(curve.time))
    total = np.pad(products.cumsum(axis=1), ((0, 0), (1, 0), (0, 0)))
    first = np.searchsorted(curve.time, curve.time - window)
    return _shares(total[:, 1:] - total[:, first], np.arange(len(first)) + 1 - first)


class WearerPart(NamedTuple):
    """What the wearer of one arm did while it was carried.

    By the same observer that runs in the node `wearer`. It needs the compensator's parameters and, if that used an IMU,
    `/imu/data`; without `/imu/pitch_yaw`, the weight of the wearer's arm is taken along what the trunk feels.
    Parameters that were changed during the recording are those of its start.
    """

    curve: WearerCurve
    sliding: Share  #: over the last second, at each time of the curve
    whole: Share  #: over the recording
    joints: Share  #: of each joint (n,) over the recording


def wearer_of(bag: Bag, recording: Recording) -> WearerPart | None:
    """Return what the wearer of an arm did, None if no wearer is set or the arm was never carried.

    Raises ParameterError or DataError that says why it is not known.
    """
    values = recorded_of(bag.parameters, recording.name, "compensator")
    why = ": the URDF came from a topic, which is not recorded"
    settings = settings_from({**values, "law": "exact"}, why) if values else None
    if settings is None or not any(settings.wearer_mass):
        return None  # without a wearer in the model, the weight of their arm would count as their torque
    times, rows = bag.trunk[:, 0].tolist(), bag.trunk[:, 1:].tolist()
    tilted_at, angles = bag.tilt[:, 0].tolist(), bag.tilt[:, 1:].tolist()
    if settings.use_imu and not times:
        raise DataError("the recording has no /imu/data")

    def trunk_at(now: float) -> tuple[Tilt, Floats3, Tilt]:
        upright = Tilt.of(settings.side)
        if not settings.use_imu:
            return upright, ZERO, upright
        row = rows[min(bisect_left(times, now), len(rows) - 1)]
        felt = gravity = Tilt.of_felt(settings.side, row[3:])
        if angles:
            gravity = Tilt.of(settings.side, *angles[min(bisect_left(tilted_at, now), len(angles) - 1)])
        return felt, turning_in_base(settings.side, row[:3]), gravity

    curve = observed(settings, recording.time, (recording.position, recording.velocity, recording.effort), trunk_at)
    curve = while_between(curve, recording.while_carried(-np.inf, np.inf))
    if not len(curve.time):
        return None
    return WearerPart(curve, shares_of(curve, SHARE.window).whole, *shares_of(curve))


def wearer_sentences(part: WearerPart, source: Source, names: Sequence[str]) -> Iterator[str]:
    """Yield the share over the recording, and that of each joint, with their 95 % bands. names: of the joints (n,)."""
    share = part.whole
    where = "In the simulation, the" if source is Source.SIMULATED else "The"
    if np.isfinite(share.value):
        band = COVER * float(share.deviation)
        value = f"{100.0 * float(share.value):.0f} % of their arm's weight (95 % band ±{100.0 * band:.0f})"
        caveat = "" if abs(share.value) > band else ": not distinguishable from zero"
        yield f"{where} wearer carried {value}{caveat}."
    else:
        yield f"{where} wearer's arm hung all the time: there was nothing to carry."
    known = [
        f"{name} {100.0 * value:.0f} % (±{100.0 * COVER * deviation:.0f})"
        for name, value, deviation in zip(names, *part.joints, strict=True)
        if np.isfinite(value)
    ]
    yield f"Of each joint's own weight: {', '.join(known) or 'no joint had any'}."


def _products(torque: np.ndarray, deviation: np.ndarray, weight: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """Return what is summed, (4, ..., m) in Nm^2, of an estimate or a curve, (..., m) in Nm each.

    These are the two parts of the share, and of its deviation the joints' own and the common part.
    """
    size, common = np.abs(weight), np.sqrt(np.maximum(0.0, deviation**2 - independent**2))
    return np.array((torque * weight, weight**2, independent * size, common * size))


def _shares(sums: np.ndarray, count: np.ndarray | float) -> Shares:
    """Return the shares of the sums of `count` products, (4, ..., m) in Nm^2."""
    given, carried, own, common = sums
    total = carried.sum(axis=-1)
    total = np.where(total > SHARE.least_weight**2 * count, total, np.nan)
    of_joint = np.where(carried > SHARE.least_of_joint**2 * np.expand_dims(count, -1), carried, np.nan)
    error = np.hypot(np.linalg.norm(own, axis=-1), common.sum(axis=-1))
    whole = Share(given.sum(axis=-1) / total, error / total)
    return Shares(whole, Share(given / of_joint, np.hypot(own, common) / of_joint))


@dataclass(frozen=True)
class AdaptationTuning:
    """How fast the support rises and is forgotten, and what counts as sinking."""

    mean: float = 1.0  #: s, time constant of the speed
    rise: float = 0.04  #: of the wearer's arm per s, while it sinks as fast as `full`, or faster
    full: float = 0.01  #: rad/s
    lift: float = 0.5  #: of `rise` at most, while the arm is lifted
    memory: float = 60.0  #: s, time constant with which a raised support is forgotten
    reach: float = 0.2  #: rad/s of any joint: faster is a movement
    #: of the wearer's arm: half the width of the share's 95 % band beyond which it says nothing
    #: (as much of it as `calibrate wearer` cannot know, 0.23, fits in; that of the body-mass table, 0.29, does not)
    widest: float = 0.28


ADAPTATION = AdaptationTuning()


class SupportAdaptation:
    """How much of the wearer's arm is to be carried, from one estimate of their torque to the next.

    With w (n,) Nm, the torque that carries the wearer's arm,

        speed = sum w . theta' / |w|                   rad/s, upwards, from the joints' angles, low-passed by `mean`
        support' = - rise * speed / full - (support - set support) / memory

    within the set support and 1; the first term stays within -lift * rise and rise. So lifting takes back part of what
    sinking gave: at a support of at most 1, only a person can lift the arm. If the set support is lowered, so is this.
    A motion faster than `reach` is a movement, not sinking. Sinking counts only while the wearer's share lies between 0
    and what is left to them. That excludes a hand that presses the arm down, and motors that are off. While the share
    is unknown, the support falls to the set one, by `rise` per second.

    Assistance as needed with forgetting: Wolbrecht, Chan, Reinkensmeyer and Bobrow, IEEE TNSRE 2008.

    support: 0..1, at present. requested: 0..1, the same as the compensator is asked for it, in steps that leave it time
    for a guided change; None while nothing adapts. problem: why the support cannot rise, or ''. shares: the wearer's,
    None if nothing is estimated; known without an adaptation, too.
    """

    def __init__(self) -> None:
        self.support = 0.0
        self.requested: float | None = None
        self.problem = ""
        self.shares: Shares | None = None
        # (4, m) Nm^2, see `_products`, of the last SHARE.window s: an older estimate weighs exponentially less
        self._means: np.ndarray | float = 0.0
        self._time = self._due = -math.inf  # s
        self._theta: Sequence[float] | None = None
        self._speed = 0.0  # rad/s, upwards
        self._set = 0.0  # 0..1, the set support of the last update

    def update(
        self,
        now: float,
        joints: Sequence[Sequence[float]] | None,
        estimate: WearerEstimate | None,
        settings: Settings,
        is_carried: bool = True,
    ) -> None:
        """Take an estimate at `now` s.

        joints: angles (n,) rad and velocities (n,) rad/s, None if they are not known.
        estimate: None if there is none.
        settings: the compensator's parameters.
        is_carried: whether the motors carry the arm: one that is let down sinks, too.
        """
        dt, self._time = now - self._time, now
        is_running = 0.0 < dt <= OBSERVER.max_gap
        if is_running and joints and estimate:
            self._means = self._means + dt / (SHARE.window + dt) * (_products(*estimate) - self._means)
            self.shares = _shares(self._means, 1.0)
        else:
            self._means, self.shares = 0.0, None
        if not (self.shares and is_carried and settings.is_adaptive):
            self._theta, self._speed = None, 0.0
        if not settings.is_adaptive or dt > REQUEST.expires:
            self.requested = None
        self._set, lowered = settings.support, min(0.0, settings.support - self._set)
        self.support += lowered
        in_force = max(settings.support, (self.requested or 0.0) + lowered)
        if not settings.is_adaptive or not is_running:
            self.support, self.problem = in_force, ""
            return
        sunk = 0.0
        if joints and estimate and is_carried:
            sunk = self._sunk(dt, joints, estimate.weight, 1.0 - in_force)
        else:
            self.problem = "the wearer's torque is not known" if is_carried else "the arm is not carried"
        rise = ADAPTATION.rise
        fall = rise if self.problem else (self.support - settings.support) / ADAPTATION.memory
        self.support = max(settings.support, min(1.0, self.support + dt * (rise * sunk - fall)))
        self.requested = in_force
        if now >= self._due and abs(self.support - in_force) >= REQUEST.least_change:
            self.requested, self._due = self.support, now + REQUEST.pause

    def _sunk(self, dt: float, joints: Sequence[Sequence[float]], weight: np.ndarray, asked: float) -> float:
        """Return how fast the arm sinks as a share of `full`, at most 1, and at least -`lift` while it is lifted.

        asked: share of their arm that is left to the wearer.
        """
        theta, velocity = joints
        moved = np.subtract(theta, self._theta or theta)
        self._theta, part = theta, dt / (ADAPTATION.mean + dt)
        rise = float(weight @ moved) / max(math.hypot(*weight), SHARE.least_weight)
        is_moved = max(map(abs, velocity)) > ADAPTATION.reach
        self._speed = 0.0 if is_moved else self._speed + part * (rise / dt - self._speed)
        self.problem = ""
        share, deviation = self.shares.whole if self.shares else (math.nan, math.nan)
        if math.isnan(share):  # the arm hangs
            return 0.0
        band = COVER * float(deviation)
        if band > ADAPTATION.widest:
            self.problem = f"the wearer's share is known to +-{100.0 * band:.0f} % only"
        sunk = max(-ADAPTATION.lift, min(1.0, -self._speed / ADAPTATION.full))
        return sunk if sunk < 0.0 or (not self.problem and -band < share < asked + band) else 0.0


OLD = 1.0  # s after which an estimate is no longer shown


@dataclass(frozen=True)
class ContactTuning:
    """What counts as a contact.

    A contact is a torque that comes faster than a person's does, as at a table's edge.
    """

    followed: float = 0.1  #: s, time constant of what a person's torque follows
    #: Nm beyond that, (n,): 1.3 times the most that `make study NAME=wearer` saw of reaching wearers
    least: Sequence[float] = (3.0, 5.0, 3.0, 1.5)
    pause: float = 1.0  #: s without another one, after which a contact is a new one


CONTACT = ContactTuning()


class ContactWatch:
    """Counts the contacts of one arm. last: time in s, joint and Nm of the newest, None before the first."""

    def __init__(self) -> None:
        self.count = 0
        self.last: tuple[float, int, float] | None = None
        self._slow = np.zeros(0)
        self._time = self._touched = -math.inf  # s

    def update(self, now: float, estimate: WearerEstimate) -> None:
        """Take the estimate at `now` s."""
        dt, self._time = now - self._time, now
        if not 0.0 <= dt <= CONTACT.followed:
            self._slow, dt = estimate.torque, 0.0
        self._slow = low_passed(self._slow, estimate.torque, dt / CONTACT.followed)
        jumps = estimate.torque - self._slow
        least = for_joints(CONTACT.least, len(jumps), max)
        is_shown = np.abs(estimate.torque) > COVER * estimate.deviation
        sizes = is_shown * np.abs(jumps) / least
        joint = int(np.argmax(sizes))
        if sizes[joint] > 1.0:
            if now - self._touched > CONTACT.pause:
                self.count, self.last = self.count + 1, (now, joint, float(jumps[joint]))
            self._touched = now


class WearerWatch:
    """The estimates of one arm. names: of the joints (n,). adaptation: of the support."""

    def __init__(self, names: Sequence[str], settings: Settings) -> None:
        self.adaptation = SupportAdaptation()
        self._names = names
        self._contact = ContactWatch()
        self._settings, self._observer = settings, MomentumObserver(settings)
        self._estimate: WearerEstimate | None = None
        self._time = -math.inf  # s, of the newest sample

    def apply(self, settings: Settings) -> None:
        """Use the compensator's new settings. The observer starts anew only if what it depends on has changed."""
        last, self._settings = self._settings, settings
        if _known_of(settings) != _known_of(last):
            self._observer = MomentumObserver(settings)

    def update(
        self,
        now: float,
        joints: Sequence[Sequence[float]] | None,
        trunk: tuple[Tilt, Floats3, Tilt] | None,
        is_carried: bool = True,
    ) -> WearerEstimate | None:
        """Process the sample taken at `now` s; return the estimate, or None if there is none.

        joints: angles rad, velocities rad/s and the motors' efforts Nm, (n,) each; None if one is missing.
        trunk: tilt of what it feels as gravity, its angular velocity (3,) rad/s in the arm's base frame, and tilt of
        gravity alone; None if it is not known.
        is_carried: as for `SupportAdaptation.update`.
        """
        self._time, self._estimate = now, None
        if joints is not None and trunk is not None:
            self._estimate = self._observer.update(now, joints, *trunk)
            self._contact.update(now, self._estimate)
        self.adaptation.update(now, joints and joints[:2], self._estimate, self._settings, is_carried)
        return self._estimate

    def values(self, now: float) -> dict[str, str]:
        """Return torques and share with their 95 % bands, the newest contact, and the support, for /diagnostics."""
        estimate = self._estimate if now - self._time <= OLD else None
        requested, problem, contact = self.adaptation.requested, self.adaptation.problem, self._contact
        values = values_of(self._names, estimate, self.adaptation.shares if estimate else None) | {
            "support adapts": (Adapts.HELD if problem else Adapts.ON) if self._settings.is_adaptive else Adapts.OFF,
            "support adapts text": problem,
            "support asked for": NONE if requested is None else f"{requested:.3f}",
            "contacts": str(contact.count),
        }
        if contact.last is None:
            return values | dict.fromkeys(("contact joint", "contact torque (Nm)", "contact age (s)"), NONE)
        at, joint, jump = contact.last
        return values | {
            "contact joint": self._names[joint],
            "contact torque (Nm)": f"{jump:.1f}",
            "contact age (s)": f"{now - at:.0f}",
        }


def values_of(names: Sequence[str], estimate: WearerEstimate | None, shares: Shares | None) -> dict[str, str]:
    """Return torques and shares with half their 95 % bands, for /diagnostics.

    names: of the joints (n,). estimate, shares: None if there are none.
    """
    unknown = (math.nan,) * len(names)
    (share, band), (of_joints, bands) = shares or ((math.nan, math.nan), (unknown, unknown))
    torques, deviations = (estimate.torque, estimate.deviation) if estimate else (unknown, unknown)
    values = {"share of the wearer (%)": _text(100.0 * share, 0), "share band (%)": _text(100.0 * COVER * band, 0)}
    columns = zip(names, of_joints, bands, torques, deviations, strict=True)
    for name, of_joint, its_band, torque, deviation in columns:
        values[f"{name} share (%)"] = _text(100.0 * of_joint, 0)
        values[f"{name} share band (%)"] = _text(100.0 * COVER * its_band, 0)
        values[f"{name} wearer (Nm)"] = _text(torque, 1)
        values[f"{name} wearer band (Nm)"] = _text(COVER * deviation, 1)
    return values


def _text(value: float | np.ndarray, digits: int) -> str:
    return UNKNOWN if math.isnan(value) else f"{round(float(value), digits) + 0.0:.{digits}f}"


def _known_of(s: Settings) -> object:
    """Return what the observer depends on."""
    load = *s.wearer_mass, *s.wearer_cog, s.payload
    worn = s.wearer_moments, s.tissue
    return s.robot, load, worn, s.joint_spring, s.joint_stiffness, s.terms.friction, s.model_error
