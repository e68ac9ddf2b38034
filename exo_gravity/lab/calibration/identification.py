# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Held poses -> the arm's moments, the torque scale of each motor, and what the poses do not show.

The commanded effort that holds the arm in a pose is, without friction, which averages out over both directions,

    effort = (torque(moments + load) + spring theta) / scale + offset

where torque is the arm's regressor (moment_model.py) times its moments, in kg m. One weighted least squares (`solve`)
fits all of it: moments, the logarithm of the scales, offsets in Nm, the rotation of gravity's direction from the
measured to the true one (an IMU is mounted to no better than a degree), a spring across each joint in Nm/rad (where it
is slack is part of the offset), the slope of each scale over the motor's temperature, and small turns of the joints'
places.

Each unknown is known before, with a standard error: the moments as the file has them, the others as 0. What the poses
do not show of it stays within that, and is part of the errors. A slope is fitted where the arm was seen cold and warm.
Errors are larger in some joints than the observations state (gear friction is not the same in every pose), so each
joint gets a factor of its own, estimated from its residuals and pooled with the others where poses are few. A pose in
which somebody touched the arm widens them: the result names the one that is farthest off what the others predict.

A turn about a joint's axis is an error of its encoder's zero, one across it an axis askew. It shows where the joints
beyond turn about another axis. The zero of the last joint does not, nor that of one whose next axis is parallel: they
look like a moment across the link. A turn of the first joint is one of the whole arm: with an IMU it is part of its
mounting. The paper's arm has fixed axes in its closed forms, so none that are askew are fitted: what a file cannot hold
is not part of its fit, but for the offsets of joints without a spring.

With the Jacobian J of the torque, and the covariance C of the unknowns, the error in a new pose has the variance
J C J^T, and the squares of what the file does not hold and of what no pose shows. A common factor of moments and torque
scales is in C, however large, and cancels in J: it holds the arm all the same.

No pose shows that friction differs between the two directions, whose mean counts as gravity's torque. A gear that loses
more while it drives its load than while it is driven makes a share of that torque look like more torque or less. How
friction grows with the torque is measured; `UNEQUAL` of it, as a standard error, is in the band. It was chosen on 28
devices of another make (3, 4 and 7 joints), where 95 % bands contained 74 to 100 % by joint, and without it 62 to
100 %. On 28 others they contained 86 to 100 %, and without it 70 to 99 %. Unequal Coulomb friction shows as an
offset.

A result that no arm can have is refused, with the pose that is missing. Held poses do not show a common factor of all
scales and moments without a known weight; nor can they tell a moment across link 3 or 4 from an error of that joint's
zero.

Over its speed, a joint's friction is Coulomb, viscous and Stribeck:

    F(v) = coulomb + viscous v + stribeck exp(-(v / v_s)^2)         B. Armstrong-Helouvry et al., Automatica 30 (1994)

and a share of the torque that the gear carries. With v_s = 0.05 rad/s this is linear; the last two parts stay where
they stand out of their errors.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from exo_gravity.core.arm.springs import MAX_REST, MAX_STIFFNESS
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.moment_model import TURN, MomentModel
from exo_gravity.lab.calibration.tracking import Observation


@dataclass(frozen=True)
class Fit:
    """The errors that the fit expects."""

    least_spread: float = 0.003  #: Nm; about half a code of an AK motor's 12-bit torque
    share: float = 0.4  #: of a moment: masses and torque scales that are each off by 30 %
    moment: float = 0.02  #: kg m, in addition: off-axis moments of which the file knows nothing
    scale: float = 0.3  #: of a torque scale; users report 0.75
    offset: float = 0.3  #: Nm
    #: rad about each axis, of gravity's measured direction: an IMU's mounting, mostly its heading
    tilt: float = 0.05
    spring: float = 0.09  #: Nm/rad: cables of up to 0.15
    slope: float = 0.001  #: 1/K: magnets lose 0.001 to 0.002, and the file's slope is corrected
    least_warming: float = 5.0  #: K between the coldest and the warmest pose, from which a slope can show
    zero: float = 0.015  #: rad, of an encoder's zero in a file: at most 1.5 degrees, over sqrt(3)
    #: rad, of a joint's axis in each direction across it: it is at most 1.5 degrees askew, as on printed and welded
    #: brackets, over sqrt(6)
    axis: float = 0.0107
    pooling: float = 2.0  #: degrees of freedom with which all joints together inform the error of each
    least_factor: float = 1e-4  #: of a variance, where poses agree by chance
    hidden: float = 0.7  #: part of the variance before, from which on an unknown is not known
    common: float = 0.5  #: part of the error before, from which on a weight shows no common factor of the scales


FIT = Fit()


class Places(NamedTuple):
    """How exactly the places of an arm's joints are known before a tour, as standard errors in rad."""

    zero: float = FIT.zero  #: of the encoders' zeros
    axis: float = FIT.axis  #: of the axes, in each direction across them


AS_USUAL = Places()

DISTURBED = "Was it touched, does a joint slip or touch a stop?"
EXACT = 1e-5  # error of a value that is held


class Unknowns(NamedTuple):
    """The unknowns of an arm of n joints and k moments, or their standard errors: views of one vector (count,)."""

    moment: np.ndarray  #: (k,) kg m
    scale: np.ndarray  #: (n,), logarithms
    offset: np.ndarray  #: (n,) Nm
    tilt: np.ndarray  #: (3,) rad, the rotation vector of gravity in the base frame
    spring: np.ndarray  #: (n,) Nm/rad
    slope: np.ndarray  #: (n,) 1/K, of the torque scale over the motor's temperature
    #: (n, t) rad, of the joints' places: about each joint's axis, its zero, and about two directions across it
    turn: np.ndarray

    @classmethod
    def of(cls, vector: np.ndarray, model: MomentModel) -> "Unknowns":
        """Return the parts of a vector (count,)."""
        n = model.count
        *parts, turn = np.split(vector, np.cumsum((len(model.names), n, n, 3, n, n)))
        return cls._make((*parts, turn.reshape(n, -1)))


class Known(NamedTuple):
    """What is known of the unknowns before."""

    start: np.ndarray  #: (count,)
    error: np.ndarray  #: (count,), standard errors
    least: np.ndarray  #: (count,), lowest possible values
    product: np.ndarray  #: (c, count), linear combinations of the change from `start` that are 0, by their errors


def known_of(model: MomentModel, places: Places | None, is_relative: bool) -> Known:
    """Return what is known of an arm.

    places: how exactly those of its joints are known; None where these are not fitted.
    is_relative: without a weight a common factor does not show, which is then 1.
    """
    count = len(model.names) + (4 + model.fitted_turns * bool(places)) * model.count + 3
    start, least, error, product = np.zeros(count), np.full(count, -np.inf), np.zeros(count), np.zeros((1, count))
    errors = Unknowns.of(error, model)
    start[: len(model.names)] = model.moments
    Unknowns.of(least, model).spring[:] = least[list(model.at_least_0)] = 0.0
    errors.moment[:] = FIT.share * np.abs(model.moments) + FIT.moment
    errors.scale[:], errors.offset[:] = FIT.scale, FIT.offset
    errors.tilt[:], errors.spring[:], errors.slope[:] = FIT.tilt, FIT.spring, FIT.slope
    errors.turn[:, :1], errors.turn[:, 1:] = places or AS_USUAL
    # The whole arm turns with its first joint, which is the same as gravity turned.
    (errors.turn[0] if model.keeps_tilt else errors.tilt)[:] = 0.0
    Unknowns.of(product[0], model).scale[model.compared] = is_relative / EXACT
    return Known(start, np.maximum(error, EXACT), least, product)


class Rows(NamedTuple):
    """The regressor in m poses of an arm with n joints and k moments."""

    model: MomentModel
    along: np.ndarray  #: (m, n, k, 3) Nm per kg m, the torque with gravity along each axis of the base frame
    turned: np.ndarray  #: (m, n, k, 3, t) Nm per kg m and rad, its derivative by the turns that are fitted
    theta: np.ndarray  #: (m, n) rad
    warmth: np.ndarray  #: (m, n) K of the motors, beyond the mean of their poses; 0 where it is not known
    direction: np.ndarray  #: (m, 3), gravity's unit vector in the base frame, as measured
    load: np.ndarray  #: (m, k) kg m, moments of the weight

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the commanded effort (m, n) in Nm."""
        _, _, torque, given = self._parts(unknowns)
        return np.asarray(torque * given + Unknowns.of(unknowns, self.model).offset)

    def jacobian(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivative of `predicted` by the unknowns, (m, n, count)."""
        value, (rows, moments, torque, given) = Unknowns.of(unknowns, self.model), self._parts(unknowns)
        own = np.eye(self.theta.shape[1])[None]  # what belongs to a joint changes that joint's effort alone
        effort = torque * given
        turns = np.einsum("mi,ita->mta", self.direction, TURN)
        tilted = np.einsum("mnka,mta,mk->mnt", self.along, turns, moments, optimize=True)
        by_turns = np.einsum("mnkat,ma,mk->mnt", self.turned, self.direction, moments, optimize=True)
        parts = (
            rows * given[..., None],
            -own * effort[..., None],
            np.broadcast_to(own, (*effort.shape, own.shape[-1])),
            tilted * given[..., None],
            own * (self.theta * given)[..., None],
            -own * (effort * self.warmth / (1.0 + value.slope * self.warmth))[..., None],
            by_turns * given[..., None],
        )
        return np.concatenate(parts, axis=-1)

    def _parts(self, unknowns: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the regressor (m, n, k), moments of arm and weight (m, k), the torque of gravity and springs (m, n).

        And (m, n), what a command is of that torque.
        """
        value = Unknowns.of(unknowns, self.model)
        direction = self.direction + self.direction @ (value.tilt @ TURN)
        rows = np.einsum("mnka,ma->mnk", self.along + self.turned @ value.turn.ravel(), direction)
        moments = value.moment + self.load
        torque = np.einsum("mnk,mk->mn", rows, moments) + value.spring * self.theta
        return rows, moments, torque, np.exp(-value.scale) / (1.0 + value.slope * self.warmth)


def rows_at(model: MomentModel, theta: np.ndarray, direction: Vector, turned: np.ndarray | None = None) -> Rows:
    """Return the regressor at `theta` (m, n) rad, without a weight, with motors of one temperature.

    direction: (3,) or (m, 3). turned: (m, n, k, 3, t), the derivative by turns, without which none is fitted.
    """
    load, down = np.zeros((len(theta), len(model.names))), np.broadcast_to(direction, (len(theta), 3))
    turned = np.zeros((*theta.shape, len(model.names), 3, 0)) if turned is None else turned
    return Rows(model, model.along_axes(theta), turned, theta, 0.0 * theta, down, load)


class Solution(NamedTuple):
    """A fit."""

    unknowns: np.ndarray  #: (count,)
    covariance: np.ndarray  #: (count, count)
    error: np.ndarray  #: (count,), standard errors, infinite where the poses do not show an unknown
    residual: np.ndarray  #: (m, n) Nm
    held_out: np.ndarray  #: (m, n) Nm, of a prediction from the other poses
    sigma: np.ndarray  #: (m, n) Nm, standard error of the effort as the residuals show it


def columns(observations: Sequence[Observation]) -> list[np.ndarray]:
    """Return theta (m, n) rad, direction (m, 3), effort and spread (m, n) Nm. Raises DataError if one is not finite."""
    if not observations:
        raise DataError("no pose was observed")
    names = "theta", "direction", "effort", "spread"
    found = [np.array([getattr(one, name) for one in observations], dtype=float) for name in names]
    for name, values in zip(names, found, strict=True):
        for index in np.flatnonzero(~np.isfinite(values).all(axis=1))[:1]:
            raise DataError(f"pose {index + 1}: {name} = {values[index].tolist()}: must be finite numbers")
    return found


def temperatures(observations: Sequence[Observation]) -> np.ndarray:
    """Return the motors' temperatures (m, n) in degC, NaN where one is not known."""
    unknown = np.full(len(observations[0].theta), np.nan)
    given = [one.temperature if len(one.temperature) else unknown for one in observations]
    return np.array(given, dtype=float)


def solve(rows: Rows, known: Known, effort: np.ndarray, spread: np.ndarray, passes: int = 3) -> Solution:
    """Return what explains the effort (m, n) in Nm; spread: (m, n) Nm, its standard error as the poses state it.

    passes: the residuals of each show the joints' errors to the next; with one, the stated errors count as they are.
    """
    unknowns, sigma = known.start, spread
    anchor = np.vstack((np.diag(1.0 / known.error), known.product))

    def off(values: np.ndarray) -> np.ndarray:
        return np.append((rows.predicted(values) - effort) / sigma, anchor @ (values - known.start))

    def by_unknowns(values: np.ndarray) -> np.ndarray:
        return np.vstack(((rows.jacobian(values) / sigma[..., None]).reshape(effort.size, -1), anchor))

    for _ in range(passes):
        bounds = known.least, np.inf
        fit = least_squares(off, unknowns, by_unknowns, bounds, x_scale=known.error)
        unknowns, scaled = fit.x, fit.jac * known.error
        covariance = known.error[:, None] * np.linalg.inv(scaled.T @ scaled) * known.error
        poses, residual = rows.jacobian(unknowns) / sigma[..., None], effort - rows.predicted(unknowns)
        left = np.eye(effort.shape[1]) - poses @ covariance @ np.swapaxes(poses, 1, 2)  # (m, n, n)
        held_out = sigma * np.linalg.solve(left, (residual / sigma)[..., None])[..., 0]
        freedom, squares = np.einsum("mjj->j", left), ((residual / spread) ** 2).sum(axis=0)
        common = FIT.pooling * squares.sum() / freedom.sum()
        sigma = spread * np.sqrt(np.maximum((squares + common) / (freedom + FIT.pooling), FIT.least_factor))
    hidden = np.diag(covariance) > FIT.hidden * known.error**2
    # Student's distribution: for few poses two standard errors would cover less than 95 %.
    covariance *= (1.0 + 1.25 / (freedom.min() + 6.0)) ** 2
    unknowns = np.where(known.error > EXACT, unknowns, known.start)
    error = np.where(hidden, np.inf, np.sqrt(np.diag(covariance)))
    return Solution(unknowns, covariance, error, residual, held_out, sigma)


@dataclass(frozen=True)
class Information:
    """What counts as known, where poses are compared by what they show."""

    moment: float = 0.1  #: kg m, standard error of any moment before,
    other: float = 0.3  #: and of torque scales and offsets, in their units
    noise: float = 0.03  #: Nm in any pose
    noise_share: float = 0.02  #: of the torque


SHOWS = Information()


def next_pose(
    taken: Sequence[Vector] | np.ndarray, candidates: np.ndarray, direction: Vector, moments: Vector, model: MomentModel
) -> int:
    """Return the index of the candidate that adds the most information to the poses `taken`, by D-optimality.

    Of equal ones the first, on every computer: in an upright stand the angle of joint 1 changes nothing.

    taken: (n,) rad each, none at the start.
    candidates: (m, n) rad.
    direction: (3,), gravity's unit vector in the base frame.
    moments: (k,) kg m, a guess.
    """
    k, n = len(model.names), model.count
    error = np.repeat((SHOWS.moment, SHOWS.other), (k, 2 * n))
    rows = rows_at(model, np.vstack((candidates, *taken)), direction)
    unknowns = np.append(moments, np.zeros(4 * n + 3))
    noise = np.hypot(SHOWS.noise, SHOWS.noise_share * rows.predicted(unknowns))
    shown = rows.jacobian(unknowns)[..., : k + 2 * n] * error / noise[..., None]
    new, seen = shown[: len(candidates)], shown[len(candidates) :].reshape(-1, k + 2 * n)
    added = np.eye(n) + new @ np.linalg.inv(np.eye(k + 2 * n) + seen.T @ seen) @ new.transpose(0, 2, 1)
    return int(np.argmax(np.linalg.slogdet(added)[1].round(6)))


POSES = 100  # new ones, at random
LEAN = 0.15  # rad, standard deviation of the trunk's pitch and roll in these
UNEQUAL = 0.25  # of the friction that grows with the torque: by how much it differs between both directions
LEAST_GROWTH = 0.005  # of the torque, by which friction grows at least: no tour shows less


def held_offset(value: Unknowns, scale: np.ndarray) -> np.ndarray:
    """Return which part of the offsets, (n,) Nm as commanded, is the torque of a spring that is slack elsewhere."""
    most = value.spring * MAX_REST / scale
    return np.clip(value.offset, -most, most)


def torque_error(new: Rows, solution: Solution, unexplained: np.ndarray) -> np.ndarray:
    """Return the standard error (n,) in Nm of the file's torque in the poses `new`.

    unexplained: (n,) or (m, n) Nm as commanded, what no unknown explains.
    """
    value, jacobian = Unknowns.of(solution.unknowns, new.model), new.jacobian(solution.unknowns)
    variance = np.einsum("qnt,tu,qnu->qn", jacobian, solution.covariance, jacobian, optimize=True)
    left = value.offset - held_offset(value, np.exp(value.scale))
    return np.asarray(np.exp(value.scale) * np.sqrt((variance + left**2 + unexplained**2).mean(axis=0)))


def new_poses(model: MomentModel) -> Rows:
    """Return poses at random without a weight, under tilts of the trunk if an IMU measures them."""
    random = np.random.default_rng(2)
    theta = random.choice(model.suggested, POSES)
    leans = random.normal(0.0, LEAN * model.keeps_tilt, (POSES, 2)).tolist()
    down = np.array([model.down(Tilt.of(SIDES[0], *lean)) for lean in leans])
    return rows_at(model, theta, down, model.turned(theta))


@dataclass(frozen=True)
class Acceptance:
    """What a result must keep within."""

    scales: tuple[float, float] = (0.3, 3.0)  #: true torque per commanded torque; users report 0.75
    misfit: float = 0.1  #: of the peak effort
    least_misfit: float = 0.1  #: Nm
    slope: float = 0.005  #: 1/K; magnets lose 0.001 to 0.002
    turn: float = 6.0  #: deg of a zero or an axis; more is no error of what was measured or drawn
    least_torque: float = 0.3  #: Nm, root mean square of a joint in any pose, from which it is compared with the file's


ACCEPTED = Acceptance()


@dataclass(frozen=True)
class FrictionFit:
    """How friction is fitted over the speed."""

    least_ratio: float = 2.0  #: of the fastest to the slowest speed
    least_load: float = 0.5  #: Nm between the least and the most that a gear carried, from which its part can show
    resolution: float = 0.003  #: Nm: least standard error of a friction that was measured once
    stribeck_speed: float = 0.05  #: rad/s
    asked: float = 4.0  #: standard errors, beyond which there is Stribeck friction, or some that grows with the torque


FRICTION = FrictionFit()


TO_THE_SIDE = "lean the stand by 10 to 14 degrees to the arm's side, where the arm still hangs close to its home"


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of `identify` from m observations of n joints. Two standard errors cover 95 %, also for few poses."""

    value: Unknowns  #: with the true torque per commanded torque as its scale, and moments as a parameter file has them
    error: Unknowns  #: their standard errors, infinite where the poses do not show one
    #: (3, 3) rad^2, covariance of the tilt; one lean of the stand does not show the turn about gravity, two do
    tilt_covariance: np.ndarray
    temperature: np.ndarray  #: (n,) degC, mean of the motors, at which `scale` is true; NaN where not known
    friction: np.ndarray  #: (n,) Nm as commanded
    held_out: np.ndarray  #: (m, n) Nm, effort minus its prediction from the other poses
    unknown: tuple[str, ...]  #: sentences on what the poses do not show, and what would
    #: No weight was hung: the product of the compared scales is taken as 1, moments are in commanded torque.
    relative: bool
    torque_error: np.ndarray  #: (n,) Nm, standard error of the file's torque in other poses


def identify(observations: Sequence[Observation], model: MomentModel, places: Places = AS_USUAL) -> Identified:
    """Return what the observations show of an arm.

    places: how exactly its zeros and axes are known.

    Raises DataError if the result would be unphysical, naming the missing pose, and if an observation is impossible.
    """
    theta, down, effort, spread = columns(observations)
    load = np.array([model.load(one.load_mass, one.load_lever) for one in observations])
    temperature, is_relative = temperatures(observations), not np.any(load)
    warmth = np.nan_to_num(temperature - temperature.mean(axis=0))
    rows = rows_at(model, theta, down, model.turned(theta))._replace(warmth=warmth, load=load)
    known = known_of(model, places, is_relative)
    before = Unknowns.of(known.error, model)
    before.slope[np.ptp(warmth, axis=0) < FIT.least_warming] = EXACT
    spread = np.hypot(spread, FIT.least_spread)
    solution = solve(rows, known, effort, spread)
    typical, peak = np.median(np.abs(solution.residual), axis=0), np.abs(effort).max(axis=0)
    for joint in np.flatnonzero(typical > np.maximum(ACCEPTED.misfit * peak, ACCEPTED.least_misfit)):
        misfit = f"joint {joint + 1} is {typical[joint]:.2f} Nm off in half of the poses"
        raise DataError(f"the poses do not fit one arm: {misfit}. {DISTURBED}")
    value, error = (Unknowns.of(part, model) for part in (solution.unknowns, solution.error))
    joints = model.compared
    unseen = FIT.common * before.scale[joints] / math.sqrt(max(1, len(joints)))
    if not is_relative and np.all(error.scale[joints] > unseen):
        raise DataError("the weight shows no common factor: hang a heavier one, or hold it with a horizontal forearm")
    hidden = np.isinf(np.concatenate(error[:3]))
    _check_known(hidden, theta, model)
    value = value._replace(scale=np.exp(value.scale))
    _check_scales(value, down[-1], model)
    _check_joints(value)
    friction = np.array([observation.friction for observation in observations])
    carried = np.abs(effort) - np.abs(effort).mean(axis=0)
    grows = np.maximum((carried * friction).sum(axis=0) / np.maximum((carried**2).sum(axis=0), EXACT), LEAST_GROWTH)
    new = new_poses(model)
    unequal = UNEQUAL * grows * new.predicted(solution.unknowns)
    tilt = slice(sum(map(len, value[:3])), sum(map(len, value[:4])))
    return Identified(
        value,
        error._replace(scale=value.scale * error.scale),
        solution.covariance[tilt, tilt],
        temperature.mean(axis=0),
        np.median(friction, axis=0),
        solution.held_out,
        tuple(_unknown(value.moment, hidden, is_relative, model)),
        is_relative,
        torque_error(new, solution, unequal),
    )


def _names(model: MomentModel) -> tuple[str, ...]:
    """Return the names of moments, scales and offsets."""
    joints = range(1, model.count + 1)
    return (*model.names, *(f"{what} {n}" for what in ("torque scale", "offset") for n in joints))


def _check_known(hidden: np.ndarray, taken: np.ndarray, model: MomentModel) -> None:
    """Raise DataError that names what the poses `taken` (m, n) do not show, `hidden` (k + 2 n,), and others would."""
    upright = model.upright  # what shows only while the base leans needs no pose
    shown = np.concatenate((upright.any(axis=0), upright.any(axis=1), np.ones(model.count)))
    if missing := [name for name, is_missing in zip(_names(model), hidden * shown, strict=True) if is_missing]:
        down, poses = model.down(Tilt.of(SIDES[0])), model.suggested
        best = np.degrees(poses[next_pose(taken, poses, down, model.moments, model)])
        pose = f"[{', '.join(f'{angle:.0f}' for angle in best)}] degrees"
        raise DataError(f"{len(taken)} poses do not show {', '.join(missing)}: add the pose {pose}")


def _check_joints(value: Unknowns) -> None:
    """Raise DataError unless a device can have these zeros, axes, springs and slopes."""
    zero, across = np.degrees(value.turn[:, 0]), np.degrees(np.linalg.norm(value.turn[:, 1:], axis=1))
    stiff, changed = "does a spring carry the arm, or does it touch a stop?", "was the arm changed between the tours?"
    for what, found, most, advice in (
        ("its zero is {:+.1f} degrees off", zero, ACCEPTED.turn, "set it by a jig or a stop, or check the URDF"),
        ("its axis is {:+.1f} degrees off", across, ACCEPTED.turn, "check the URDF"),
        ("a spring of {:.2f} Nm/rad", value.spring, MAX_STIFFNESS, stiff),
        ("torque scale changes by {:+.4f} per K", value.slope, ACCEPTED.slope, changed),
    ):
        for joint in np.flatnonzero(np.abs(found) > most):
            raise DataError(f"joint {joint + 1}: {what.format(found[joint])}: must be within {most:g}: {advice}")


def _check_scales(value: Unknowns, direction: Vector, model: MomentModel) -> None:
    """Raise DataError unless motors can have the scales, and each joint needs about the torque of the file's arm."""
    low, high = ACCEPTED.scales
    for joint in np.flatnonzero((value.scale < low) | (value.scale > high)):
        expected = f"from {low:g} to {high:g}: is joint {joint + 1}'s direction or motor type wrong, or did it slip?"
        raise DataError(f"torque scale {joint + 1} = {value.scale[joint]:.3g}: must be {expected}")
    rows = model.rows(model.suggested, np.asarray(direction))
    found, given = rows @ value.moment, rows @ model.moments
    size = (given**2).sum(axis=0)
    for joint in np.flatnonzero(np.sqrt(size / len(rows)) > ACCEPTED.least_torque):
        share = float((found[:, joint] * given[:, joint]).sum() / size[joint])
        if not low <= share <= high:
            expected = f"from {low:g} to {high:g}: are its direction, its zero and the file's masses right?"
            raise DataError(f"joint {joint + 1} needs {share:.2g} times the torque of the file: must be {expected}")


def _unknown(moments: np.ndarray, hidden: np.ndarray, relative: bool, model: MomentModel) -> Iterator[str]:
    """Yield what the poses do not show, and what would, in sentences; moments: (k,) kg m, hidden: (k + 2 n,)."""
    if relative:
        yield f"A common factor of all torque scales and moments: hang a known weight on link {model.count}."
    names = ", ".join(name for name, is_hidden in zip(_names(model), hidden, strict=True) if is_hidden)
    idle = ", ".join(f"joint {n + 1}" for n in np.flatnonzero(~model.upright.any(axis=1)))
    if names and idle:
        yield f"{names}: {idle} carries nothing while its axis is vertical: {TO_THE_SIDE}."
    elif names:
        yield f"{names}: no pose shows them while the base stands as it does; the file's values are kept."
    for across, along in model.across:
        angle = math.degrees(math.atan2(moments[across], moments[along]))
        looks = f"it looks like one of {angle:+.1f} degrees; check the zero with a level or at a stop."
        yield f"{model.names[across]} of link {along + 1} from an error of joint {along + 1}'s zero: {looks}"


class FrictionCurve(NamedTuple):
    """Friction of a joint over its speed, and over the torque that its gear carries."""

    speed: np.ndarray  #: (n,) rad/s
    torque: np.ndarray  #: (n,) Nm, measured
    carried: np.ndarray  #: (n,) Nm that the gear carried
    fitted: np.ndarray  #: (n,) Nm
    coulomb: float  #: Nm
    viscous: float  #: Nm s/rad
    stribeck: float  #: Nm, 0 if the data show none
    load: float  #: share of what is carried, 0 if the data show none
    error: tuple[float, ...]  #: (4,), standard errors of coulomb, viscous, stribeck and load


def fit_friction(speed: np.ndarray, torque: np.ndarray, error: np.ndarray, carried: np.ndarray) -> FrictionCurve:
    """Return the friction that fits `torque` (n,) in Nm at `speed` (n,) rad/s, with standard errors `error` (n,) in Nm.

    carried: (n,) Nm that the gear carried meanwhile.

    A Stribeck part, and one that grows with what is carried, stay where they stand out of their errors.

    Raises DataError for fewer than 3 speeds, or less than a factor of 2 between them.
    """
    speeds, ratio, carried = len(np.unique(speed)), speed.max() / speed.min(), np.abs(carried)
    if speeds < 3 or ratio < FRICTION.least_ratio:
        measured = f"at {speeds} speeds, the fastest {ratio:.1f} times the slowest"
        raise DataError(f"friction was measured {measured}: must be at least 3, and {FRICTION.least_ratio:g} times")
    falling = np.exp(-((speed / FRICTION.stribeck_speed) ** 2))
    matrix = np.stack((np.ones_like(speed), speed, falling, carried), axis=1)
    matrix[:, 2:] *= speeds > 3, np.ptp(carried) > FRICTION.least_load
    noise = math.hypot(float(np.sqrt(np.mean(np.square(error)))), FRICTION.resolution)
    for _ in range(3):  # of a column of zeros the inverse gives 0
        inverse = np.linalg.pinv(matrix)
        values = inverse @ torque
        freedom = max(1, len(speed) - np.linalg.matrix_rank(matrix))
        scatter = np.linalg.norm(torque - matrix @ values) / math.sqrt(freedom)
        errors = max(noise, scatter) * np.linalg.norm(inverse, axis=1)
        matrix[:, 2:] *= values[2:] > FRICTION.asked * errors[2:]
    fitted = matrix @ values
    coulomb, viscous, stribeck, load = values.tolist()
    return FrictionCurve(speed, torque, carried, fitted, coulomb, viscous, stribeck, load, tuple(errors.tolist()))
