# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Held poses -> the arm's moments, the torque scale of each motor, and what the poses do not show.

The commanded effort that holds the arm in a pose is, without friction, which averages out over both directions,

    effort = (torque(moments + load) + spring theta) / scale + offset

where torque is the arm's regressor (moment_model.py) times its moments; `solve` fits all of it at once. A spring across
a joint stays where it stands out of its error, and a slope of its scale over the motor's temperature where the arm was
seen cold and warm.

The places of the joints are unknowns, too, as small turns: about a joint's axis, which is an error of its encoder's
zero, and across it, which is an axis askew. A turn shows where the joints beyond turn about another axis. The zero of
the last joint does not, nor that of one whose next axis is parallel: they look like a moment across the link. A turn of
the first joint is one of the whole arm: with an IMU it is part of its mounting. A parameter file takes over the zeros,
and the axes of an arm from a URDF; the closed forms of the paper's arm have fixed axes. `held` finds the moments that
make up for what a file does not take over, and what that may cost.

A pose that does not fit the others (a hand on the arm, a slipping joint) is left out. A result that no arm can have is
refused, with the pose that is missing. Held poses do not show a common factor of all scales and moments without a known
weight; nor can they tell a moment across link 3 or 4 from an error of that joint's zero.

Over its speed, a joint's friction is Coulomb, viscous and Stribeck:

    F(v) = coulomb + viscous v + stribeck exp(-(v / v_s)^2)          B. Armstrong-Helouvry et al., Automatica 30 (1994)

and a share of the torque that the gear carries. For a given Stribeck speed v_s this is linear in the others, so v_s is
searched on a grid.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.springs import MAX_REST, MAX_STIFFNESS
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.held import held, new_poses
from exo_gravity.lab.calibration.moment_model import TURNS, MomentModel
from exo_gravity.lab.calibration.pose_fit import (
    DISTURBED,
    EXACT,
    FIT,
    FitLayout,
    Places,
    columns,
    known_of,
    layout_of,
    rows_at,
    temperatures,
    with_springs,
    without_outliers,
)
from exo_gravity.lab.calibration.poses import missing_pose, shown_by
from exo_gravity.lab.calibration.tracking import Observation


@dataclass(frozen=True)
class Acceptance:
    """What a result must keep within."""

    scales: tuple[float, float] = (0.3, 3.0)  #: true torque per commanded torque; users report 0.75
    misfit: float = 0.1  #: of the peak effort
    least_misfit: float = 0.1  #: Nm
    slope: float = 0.005  #: 1/K; magnets lose 0.001 to 0.002
    turn: float = 6.0  #: deg of a zero or an axis; more is no error of what was measured or drawn
    least_torque: float = 0.3  #: Nm, root mean square of a joint in any pose, from which it is compared with the URDF's


ACCEPTED = Acceptance()


STRIBECK_SPEEDS = np.geomspace(0.01, 0.1, 20)  # rad/s; a slower fall is not told from viscous friction below 0.3 rad/s


@dataclass(frozen=True)
class FrictionFit:
    """How friction is fitted over the speed."""

    least_ratio: float = 2.0  #: of the fastest to the slowest speed
    least_load: float = 0.5  #: Nm between the least and the most that a gear carried, from which its part can show
    resolution: float = 0.003  #: Nm: least standard error of a friction that was measured once


FRICTION = FrictionFit()


LEAN = "lean the stand by 10 to 14 degrees to the arm's side, where the arm still hangs close to its home"


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of `identify` from m observations of n joints. Two standard errors cover 95 %, also for few poses."""

    moments: np.ndarray  #: (k,) kg m in the order of the model's names
    #: (k,) kg m, their standard errors, infinite where the poses do not show a moment, which is then the file's
    error: np.ndarray
    scale: np.ndarray  #: (n,), true torque per commanded torque
    scale_error: np.ndarray  #: (n,), standard errors, infinite where not known
    offset: np.ndarray  #: (n,) Nm as commanded
    friction: np.ndarray  #: (n,) Nm as commanded
    residual: np.ndarray  #: (m, n) Nm, effort minus prediction
    held_out: np.ndarray  #: (m, n) Nm, the same predicted without that pose
    unknown: tuple[str, ...]  #: sentences on what the poses do not show, and what would
    rejected: tuple[tuple[int, str], ...]  #: index and reason of each observation that is not used
    #: No weight was hung: the product of the compared scales is taken as 1, moments are in commanded torque.
    relative: bool
    tilt: np.ndarray  #: (3,) rad in the base frame, rotation of gravity from the measured to the true direction
    tilt_covariance: np.ndarray  #: (3, 3); one lean of the stand does not show the turn about gravity, two do
    stiffness: np.ndarray  #: (n,) Nm/rad of the springs across the joints, 0 where the poses ask for none
    stiffness_error: np.ndarray  #: (n,), standard errors, 0 where no spring was fitted
    #: (n,) rad, where they are slack as the encoders say: a joint with a spring has its offset in it
    rest: np.ndarray
    slope: np.ndarray  #: (n,) 1/K of the scales over the motors' temperatures, 0 where the poses ask for none
    slope_error: np.ndarray  #: (n,), standard errors, 0 where no slope was fitted
    temperature: np.ndarray  #: (n,) degC, mean of the motors, at which `scale` is true; NaN where not known
    #: (n, 3) rad by which the joints' places are turned: about the axis, by which a joint is farther than its encoder
    #: says, and about two directions across it; (0, 3) if they are not identified
    turn: np.ndarray
    turn_error: np.ndarray  #: likewise, standard errors
    in_file: np.ndarray  #: (k,) kg m, the moments with which a parameter file holds the arm best
    remainder: np.ndarray  #: (m, n) Nm, effort minus the prediction of that file
    torque_error: np.ndarray  #: (n,) Nm, standard error of that file's torque in other poses


def identify(observations: Sequence[Observation], model: MomentModel, places: Places | None = None) -> Identified:
    """Return what the observations show of an arm.

    places: how exactly its zeros and axes are known; by default as usual.

    Raises DataError if the result would be unphysical, naming the missing pose, and if an observation is impossible.
    """
    at, (theta, down, effort, spread) = layout_of(model), columns(observations)
    weights = [(one.load_mass, one.load_lever) for one in observations]
    load, beside = (np.array([of(*weight) for weight in weights]) for of in (model.load, model.load_beside))
    temperature, is_relative = temperatures(observations), not np.any(load)
    warmth = np.nan_to_num(temperature - temperature.mean(axis=0))
    rows = rows_at(model, theta, down, model.turned(theta))._replace(warmth=warmth, load=load, beside=beside)
    known = known_of(model, places or Places(), is_relative)
    known.error[at.slope][np.ptp(warmth, axis=0) < FIT.least_warming] = EXACT
    spread = np.hypot(spread, FIT.least_spread)
    keep, rejected = without_outliers(rows, known, effort, spread)
    used, seen, spread = rows.only(keep), effort[keep], spread[keep]
    solution = with_springs(used, known, seen, spread)
    typical, peak = np.median(np.abs(solution.residual), axis=0), np.abs(seen).max(axis=0)
    for joint in np.flatnonzero(typical > np.maximum(ACCEPTED.misfit * peak, ACCEPTED.least_misfit)):
        misfit = f"joint {joint + 1} is {typical[joint]:.2f} Nm off in half of the poses"
        raise DataError(f"the poses do not fit one arm: {misfit}. {DISTURBED}")
    joints = model.compared
    unseen = FIT.common * known.error[at.scale][joints] / math.sqrt(max(1, len(joints)))
    if not is_relative and np.all(solution.error[at.scale][joints] > unseen):
        raise DataError("the weight shows no common factor: hang a heavier one, or hold it with a horizontal forearm")
    _check_known(solution.hidden, len(observations), down[-1], model)
    unknowns, error = solution.unknowns, solution.error
    moments, scale = unknowns[at.moment], np.exp(unknowns[at.scale])
    check_physical(moments, error[at.moment], scale, down[-1], model)
    _check_joints(unknowns, at)
    stiffness, slope = unknowns[at.spring], unknowns[at.slope]
    slack = -unknowns[at.offset] * scale / np.where(stiffness > 0.0, stiffness, np.inf)
    beyond_noise = np.maximum(solution.sigma**2 - spread**2, 0.0)
    friction = np.array([observation.friction for observation in observations])
    carried = np.abs(effort) - np.abs(effort).mean(axis=0)
    grows = np.maximum((carried * friction).sum(axis=0) / np.maximum((carried**2).sum(axis=0), 1e-12), 0.0)
    file = held(model, new_poses(model), solution, np.sqrt(beyond_noise.mean(axis=0)), grows)
    residual = effort - rows.predicted(unknowns)
    held_out = residual.copy()
    held_out[keep] = solution.held_out
    return Identified(
        moments, error[at.moment], scale, scale * error[at.scale], unknowns[at.offset],
        np.median(friction, axis=0), residual, held_out,
        tuple(_unknown(unknowns, solution.hidden, is_relative, model)), rejected,
        is_relative, unknowns[at.tilt], solution.covariance[at.tilt, at.tilt], stiffness,
        error[at.spring] * (stiffness > 0.0), np.clip(slack, -MAX_REST, MAX_REST), slope,
        error[at.slope] * (slope != 0.0),
        temperature.mean(axis=0),
        unknowns[at.turn].reshape(-1, TURNS), error[at.turn].reshape(-1, TURNS),
        file.unknowns[at.moment], effort - rows.predicted(file.unknowns), file.error,
    )  # fmt: skip


def _check_known(hidden: np.ndarray, count: int, direction: Vector, model: MomentModel) -> None:
    """Raise DataError that names what is missing if `count` poses do not show `hidden` (count,) that others would."""
    at = layout_of(model)
    shown = model.upright  # what shows while the base leans needs no pose
    needed = np.concatenate((shown.any(axis=0), *(shown.any(axis=1),) * 2))
    missing = hidden[: at.offset.stop] & shown_by(model, model.suggested, direction) & needed
    if np.any(missing):
        names = ", ".join(name for name, is_missing in zip(_names(model), missing, strict=False) if is_missing)
        pose = missing_pose(missing, direction, model)
        raise DataError(f"{count} poses do not show {names}: add the pose {pose}")


def _names(model: MomentModel) -> tuple[str, ...]:
    """Return the names of moments, scales and offsets."""
    joints = range(1, model.count + 1)
    return (*model.names, *(f"{what} {n}" for what in ("torque scale", "offset") for n in joints))


def _check_joints(unknowns: np.ndarray, at: FitLayout) -> None:
    """Raise DataError unless a device can have the zeros, axes, springs and slopes of these unknowns (count,)."""
    zero, *across = np.degrees(unknowns[at.turn]).reshape(-1, TURNS).T
    stiff, changed = "does a spring carry the arm, or does it touch a stop?", "was the arm changed between the tours?"
    for what, found, most, advice in (
        ("its zero is {:+.1f} degrees off", zero, ACCEPTED.turn, "set it by a jig or a stop, or check the URDF"),
        ("its axis is {:+.1f} degrees off", np.hypot(*across), ACCEPTED.turn, "check the URDF"),
        ("a spring of {:.2f} Nm/rad", unknowns[at.spring], MAX_STIFFNESS, stiff),
        ("torque scale changes by {:+.4f} per K", unknowns[at.slope], ACCEPTED.slope, changed),
    ):
        for joint in np.flatnonzero(np.abs(found) > most):
            raise DataError(f"joint {joint + 1}: {what.format(found[joint])}: must be within {most:g}: {advice}")


def check_physical(
    moments: np.ndarray, error: np.ndarray, scale: np.ndarray, direction: Vector, model: MomentModel
) -> None:
    """Raise DataError unless an arm can have the moments (k,) kg m and scales (n,), and their `error` (k,) is small."""
    low, high = ACCEPTED.scales
    for joint in np.flatnonzero((scale < low) | (scale > high)):
        expected = f"from {low:g} to {high:g}: is joint {joint + 1}'s direction or motor type wrong, or did it slip?"
        raise DataError(f"torque scale {joint + 1} = {scale[joint]:.3g}: must be {expected}")
    for index in model.above_0:
        moment, uncertain = f"{model.names[index]} = {moments[index]:.3f} kg m", error[index]
        if uncertain > abs(moments[index]):
            pose = missing_pose(np.arange(layout_of(model).total) == index, direction, model)
            raise DataError(f"{moment} is not known better than {uncertain:.3f}: add the pose {pose}")
        if moments[index] <= 0.0:
            raise DataError(f"{moment}: must be positive: check direction and zero of joint {index + 1}")
    for across, along in model.across:
        if abs(moments[across]) > moments[along]:
            beside = f"{model.names[across]} = {moments[across]:.3f} kg m exceeds {model.names[along]}"
            angle = math.degrees(math.atan2(moments[across], moments[along]))
            raise DataError(f"{beside}: the zero of joint {along + 1} seems {angle:.0f} degrees off")
    if model.is_described:
        _check_like(moments, direction, model)


def _check_like(moments: np.ndarray, direction: Vector, model: MomentModel) -> None:
    """Raise DataError unless each joint needs about the torque that it needs by the description of the arm."""
    rows = model.rows(model.suggested, np.asarray(direction))
    found, given = rows @ moments, rows @ model.moments
    size = (given**2).sum(axis=0)
    low, high = ACCEPTED.scales
    for joint in np.flatnonzero(np.sqrt(size / len(rows)) > ACCEPTED.least_torque):
        share = float((found[:, joint] * given[:, joint]).sum() / size[joint])
        if not low <= share <= high:
            expected = f"from {low:g} to {high:g}: are its direction, its zero and the URDF's masses right?"
            raise DataError(f"joint {joint + 1} needs {share:.2g} times the torque of the URDF: must be {expected}")


def _unknown(unknowns: np.ndarray, hidden: np.ndarray, relative: bool, model: MomentModel) -> Iterator[str]:
    """Yield what the poses do not show, and what would, in sentences; unknowns and `hidden`: (count,)."""
    if relative:
        yield f"A common factor of all torque scales and moments: hang a known weight on link {model.count}."
    names = ", ".join(name for name, is_hidden in zip(_names(model), hidden, strict=False) if is_hidden)
    idle = ", ".join(f"joint {n + 1}" for n in np.flatnonzero(~model.upright.any(axis=1)))
    if names and idle:
        yield f"{names}: {idle} carries nothing while its axis is vertical: {LEAN}."
    elif names:
        yield f"{names}: no pose shows them while the base stands as it does; the file's values are kept."
    for across, along in model.across:
        angle = math.degrees(math.atan2(unknowns[across], unknowns[along]))
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
    stribeck_speed: float  #: rad/s, 0 without Stribeck friction
    error: tuple[float, ...]  #: (4,), standard errors of coulomb, viscous, stribeck and load, with that of the choice


def fit_friction(speed: np.ndarray, torque: np.ndarray, error: np.ndarray, carried: np.ndarray) -> FrictionCurve:
    """Return the friction that fits `torque` (n,) in Nm at `speed` (n,) rad/s, with standard errors `error` (n,) in Nm.

    carried: (n,) Nm that the gear carried meanwhile.

    A Stribeck part, and one that grows with what is carried, are kept if they lower the sum of squares by more than the
    extended criterion of J. Chen and Z. Chen, Biometrika 95 (2008), permits for their parameters and the fits that were
    tried. None is kept that is negative, or leaves no Coulomb friction. The errors include the choice: every fit counts
    with its weight by the criterion (S. Buckland et al., Biometrics 53 (1997)).

    Raises DataError for fewer than 3 speeds, or less than a factor of 2 between them.
    """
    speeds = len(np.unique(speed))
    if speeds < 3:
        raise DataError(f"friction was measured at {speeds} speeds, must be at least 3")
    if speed.max() < FRICTION.least_ratio * speed.min():
        measured = f"from {speed.min():.2f} to {speed.max():.2f} rad/s"
        raise DataError(
            f"friction was measured {measured}, the fastest must be {FRICTION.least_ratio:g} times the slowest"
        )
    falls = [0.0, *(STRIBECK_SPEEDS.tolist() if speeds > 3 else ())]
    loads = [np.zeros_like(speed), *([np.abs(carried)] if np.ptp(np.abs(carried)) > FRICTION.least_load else ())]
    fits = [_fit(speed, torque, fall, load) for load in loads for fall in falls]
    # A Stribeck part has two parameters.
    extra = np.array([2 * bool(fit.stribeck_speed) + bool(fit.carried.any()) for fit in fits])
    values = np.array([(fit.coulomb, fit.viscous, fit.stribeck, fit.load) for fit in fits])
    squares = np.array([np.sum((fit.fitted - torque) ** 2) for fit in fits])
    scatter = float(np.min(squares / np.maximum(1, len(speed) - 2 - extra)))
    noise = max(float(np.mean(np.square(error))), FRICTION.resolution**2, scatter)
    criterion = squares / noise + extra * math.log(len(speed)) + 2.0 * math.log(len(fits)) * (extra > 0)
    criterion[(extra > 0) & (values[:, [0, 2, 3]] < 0.0).any(axis=1)] = np.inf
    weight, best = np.exp((criterion.min() - criterion) / 2.0), int(np.argmin(criterion))
    variance = noise * np.square([fit.error for fit in fits]) + (values - values[best]) ** 2
    errors = np.sqrt(weight @ variance / weight.sum())
    return fits[best]._replace(carried=np.abs(carried), error=tuple(errors.tolist()))


def _fit(speed: np.ndarray, torque: np.ndarray, stribeck_speed: float, load: np.ndarray) -> FrictionCurve:
    """Return the fit with this Stribeck speed and `load`, 0 for one without it; errors for noise of 1 Nm."""
    falling = np.exp(-((speed / stribeck_speed) ** 2)) if stribeck_speed else np.zeros_like(speed)
    matrix = np.stack((np.ones_like(speed), speed, falling, load), axis=1)
    inverse = np.linalg.pinv(matrix)
    is_used = matrix.any(axis=0)
    values, errors = is_used * (inverse @ torque), is_used * np.sqrt(np.square(inverse).sum(axis=1))
    coulomb, viscous, stribeck, share = values.tolist()
    found = coulomb, viscous, stribeck, share, stribeck_speed, tuple(errors.tolist())
    return FrictionCurve(speed, torque, load, matrix @ values, *found)
