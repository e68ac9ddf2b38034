# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Held poses -> the arm's moments, the torque scale of each motor, and what the poses do not show.

The commanded effort that holds the arm in a pose is, without friction, which averages out over both directions,

    effort = (torque(moments + load) + spring theta) / scale + offset

where torque is `core.arm.gravity.regressor` times the moments. A spring across a joint, and a slope of its scale over
the motor's temperature, are identified only where the poses ask for them (`pose_fit.asked_for`).

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

from exo_gravity.core.arm.arm import STANDARD_GRAVITY
from exo_gravity.core.arm.gravity import MOMENTS
from exo_gravity.core.arm.joint_spring import MAX_REST, MAX_STIFFNESS
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import JOINT_COUNT, Vector
from exo_gravity.lab.calibration.pose_fit import (
    ANGLE,
    COUNT,
    DISTURBED,
    EXTRAS,
    FIT,
    MOMENT,
    OFFSET,
    SCALE,
    SLOPE,
    SPRING,
    START,
    TILT,
    asked_for,
    bounded,
    final,
    possible_extras,
    robust,
    rows_of,
    temperatures,
    without_each_pose,
    without_outliers,
)
from exo_gravity.lab.calibration.poses import missing_pose


@dataclass(frozen=True)
class Acceptance:
    """What a result must keep within."""

    scales: tuple[float, float] = (0.3, 3.0)  #: true torque per commanded torque; users report 0.75
    misfit: float = 0.1  #: of the peak effort
    least_misfit: float = 0.1  #: Nm
    least_zero_error: float = 0.5  #: deg worth a sentence
    slope: float = 0.005  #: 1/K; magnets lose 0.001 to 0.002


ACCEPTED = Acceptance()


STRIBECK_SPEEDS = np.geomspace(0.01, 0.1, 20)  # rad/s; a slower fall is not told from viscous friction below 0.3 rad/s


@dataclass(frozen=True)
class FrictionFit:
    """How friction is fitted over the speed."""

    least_ratio: float = 2.0  #: of the fastest to the slowest speed
    least_load: float = 0.5  #: Nm between the least and the most that a gear carried, from which its part can show
    resolution: float = 0.003  #: Nm: least standard error of a friction that was measured once


FRICTION = FrictionFit()


# Unknowns of joint 1, which carries nothing while its axis is vertical.
FIRST_JOINT = (0, MOMENTS.index("W"), SCALE.start, OFFSET.start)
NAMES = (*MOMENTS, *(f"{what} {n + 1}" for what in ("torque scale", "offset") for n in range(JOINT_COUNT)))
LEAN = "lean the stand by 10 to 14 degrees to the arm's side, where the arm still hangs close to its home"


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of `identify` from n observations. Two standard errors cover 95 %, also for few poses."""

    moments: np.ndarray  #: (8,) kg m in the order of `MOMENTS`
    error: np.ndarray  #: (8,) kg m, their standard errors, infinite where the poses do not show a moment, which is 0
    scale: np.ndarray  #: (4,), true torque per commanded torque
    scale_error: np.ndarray  #: (4,), standard errors, infinite where not known
    offset: np.ndarray  #: (4,) Nm as commanded
    friction: np.ndarray  #: (4,) Nm as commanded
    residual: np.ndarray  #: (n, 4) Nm, effort minus prediction
    held_out: np.ndarray  #: (n, 4) Nm, the same predicted without that pose, NaN where the others do not suffice
    singular_values: np.ndarray  #: of the information in the poses, the largest first; below 1: not known
    unknown: tuple[str, ...]  #: sentences on what the poses do not show, and what would
    rejected: tuple[tuple[int, str], ...]  #: index and reason of each observation that is not used
    #: No weight was hung: the product of the scales of joints 2 to 4 is taken as 1, moments are in commanded torque.
    relative: bool
    tilt: np.ndarray  #: (3,) rad in the base frame, rotation of gravity from the measured to the true direction
    tilt_covariance: np.ndarray  #: (3, 3); one lean of the stand does not show the turn about gravity, two do
    stiffness: np.ndarray  #: (4,) Nm/rad of the springs across the joints, 0 where the poses ask for none
    stiffness_error: np.ndarray  #: (4,), standard errors, 0 where there is none
    rest: np.ndarray  #: (4,) rad, where they are slack: a joint with a spring has its offset in it
    slope: np.ndarray  #: (4,) 1/K of the scales over the motors' temperatures, 0 where the poses ask for none
    slope_error: np.ndarray  #: (4,), standard errors, 0 where there is none
    temperature: np.ndarray  #: (4,) degC, mean of the motors, at which `scale` is true; NaN where not known

    @property
    def left_offset(self) -> np.ndarray:
        """The part of the offset that no spring carries, (4,) Nm as commanded."""
        return self.offset + self.stiffness * self.rest / self.scale


def identify(observations: Sequence[Observation], length: Vector, gravity: float = STANDARD_GRAVITY) -> Identified:
    """Return what the observations show of an arm with links of `length` (4,) m.

    Raises DataError if the result would be unphysical, naming the missing pose, and if an observation is impossible.
    """
    plain = rows_of(observations, length, gravity)
    extras = asked_for(plain, possible_extras(plain), robust)
    while True:
        rows = plain.with_extras(extras)
        keep, rejected = without_outliers(rows)
        fewer = asked_for(plain.only(keep), extras, final)  # an outlier may have looked like a spring
        if fewer == extras:
            break
        extras = fewer
    used, solution = bounded(rows.only(keep))
    typical, peak = np.median(np.abs(solution.residual), axis=0), np.abs(used.effort).max(axis=0)
    for joint in np.flatnonzero(typical > np.maximum(ACCEPTED.misfit * peak, ACCEPTED.least_misfit)):
        misfit = f"joint {joint + 1} is {typical[joint]:.2f} Nm off in half of the poses"
        raise DataError(f"the poses do not fit one arm: {misfit}. {DISTURBED}")
    direction, is_relative = observations[-1].direction, not np.any(used.load)
    hidden = solution.hidden > FIT.hidden
    _check_known(hidden, len(observations), direction, gravity, is_relative)
    unknowns = np.where(hidden, START, solution.unknowns)
    unknowns[[index for index in EXTRAS if index not in extras]] = 0.0  # exactly
    # Student's distribution: for few poses two standard errors would cover less than 95 %.
    covariance = solution.covariance * (1.0 + 1.25 / (solution.freedom.min() + 6.0)) ** 2
    error = np.where(hidden, np.inf, np.sqrt(np.diag(covariance)))
    moments, scale = unknowns[MOMENT], np.exp(unknowns[SCALE])
    check_physical(moments, error[MOMENT], scale, direction, gravity)
    stiffness, slope = unknowns[SPRING], unknowns[SLOPE]
    _check_extras(stiffness, slope)
    slack = -unknowns[OFFSET] * scale / np.where(stiffness > 0.0, stiffness, np.inf)
    residual = rows.effort - rows.predicted(solution.unknowns)
    held_out = residual.copy()
    held_out[keep], _ = without_each_pose(solution, used.sigma)
    friction = np.median([observation.friction for observation in observations], axis=0)
    return Identified(
        moments, error[MOMENT], scale, scale * error[SCALE], unknowns[OFFSET], friction, residual, held_out,
        solution.singular_values, tuple(_unknown(unknowns, covariance, hidden, is_relative)), rejected, is_relative,
        unknowns[TILT], covariance[TILT, TILT], stiffness, error[SPRING] * (stiffness > 0.0),
        np.clip(slack, -MAX_REST, MAX_REST), slope, error[SLOPE] * (slope != 0.0),
        temperatures(observations).mean(axis=0),
    )  # fmt: skip


def _check_known(hidden: np.ndarray, count: int, direction: Vector, gravity: float, is_relative: bool) -> None:
    """Raise DataError that names what is missing if `count` poses do not show `hidden` (COUNT,) of joints 2 to 4."""
    missing = hidden.copy()
    missing[list(FIRST_JOINT)] = False
    if np.all(missing[SCALE][1:]) and not is_relative:
        raise DataError("the weight shows no common factor: hang a heavier one, or hold it with a horizontal forearm")
    if np.any(missing):
        names = ", ".join(NAMES[index] for index in np.flatnonzero(missing))
        pose = missing_pose(missing, direction, gravity)
        raise DataError(f"{count} poses do not show {names}: add the pose {pose}")


def _check_extras(stiffness: np.ndarray, slope: np.ndarray) -> None:
    """Raise DataError unless a device can have springs of `stiffness` (4,) Nm/rad and these slopes (4,) in 1/K."""
    for joint in np.flatnonzero(stiffness > MAX_STIFFNESS):
        most = f"must be at most {MAX_STIFFNESS:g}: does a spring carry the arm, or does the joint touch a stop?"
        raise DataError(f"joint {joint + 1}: a spring of {stiffness[joint]:.2f} Nm/rad: {most}")
    for joint in np.flatnonzero(np.abs(slope) > ACCEPTED.slope):
        most = f"must be within {ACCEPTED.slope:g}: was the arm changed between the tours?"
        raise DataError(f"joint {joint + 1}: torque scale changes by {slope[joint]:+.4f} per K: {most}")


def check_physical(
    moments: np.ndarray, error: np.ndarray, scale: np.ndarray, direction: Vector, gravity: float
) -> None:
    """Raise DataError unless an arm can have the moments (8,) kg m and scales (4,), and their `error` (8,) is small."""
    low, high = ACCEPTED.scales
    for joint in np.flatnonzero((scale < low) | (scale > high)):
        expected = f"from {low:g} to {high:g}: is joint {joint + 1}'s direction or motor type wrong, or did it slip?"
        raise DataError(f"torque scale {joint + 1} = {scale[joint]:.3g}: must be {expected}")
    for index in (1, 2, 3):
        moment, uncertain = f"{MOMENTS[index]} = {moments[index]:.3f} kg m", error[index]
        if uncertain > abs(moments[index]):
            pose = missing_pose(np.arange(COUNT) == index, direction, gravity)
            raise DataError(f"{moment} is not known better than {uncertain:.3f}: add the pose {pose}")
        if moments[index] <= 0.0:
            raise DataError(f"{moment}: must be positive: check direction and zero of joint {index + 1}")
    for across, along in ((6, 2), (7, 3)):
        if abs(moments[across]) > moments[along]:
            angle = math.degrees(math.atan2(moments[across], moments[along]))
            seems = f"the zero of joint {along + 1} seems {angle:.0f} degrees off"
            raise DataError(f"{MOMENTS[across]} = {moments[across]:.3f} kg m exceeds {MOMENTS[along]}: {seems}")


def _unknown(unknowns: np.ndarray, covariance: np.ndarray, hidden: np.ndarray, relative: bool) -> Iterator[str]:
    """Yield what the poses do not show, and what would, in sentences; unknowns and `hidden`: (COUNT,)."""
    if relative:
        yield "A common factor of all torque scales and moments: hang a known weight on link 4."
    if names := ", ".join(NAMES[index] for index in np.flatnonzero(hidden[: ANGLE.start])):
        yield f"{names}: joint 1 carries nothing while its axis is vertical: {LEAN}."
    for joint, along, across in ((4, 3, 7), (3, 2, 6)):
        angle = math.degrees(math.atan2(unknowns[across], unknowns[along]))
        looks = f"it looks like one of {angle:+.1f} degrees; check the zero with a level or at a stop."
        yield f"{MOMENTS[across]} of link {joint} from an error of joint {joint}'s zero: {looks}"
    elbow, elbow_error = math.degrees(unknowns[ANGLE][0]), math.degrees(math.sqrt(covariance[ANGLE, ANGLE][0, 0]))
    if elbow and abs(elbow) > max(3.0 * elbow_error, ACCEPTED.least_zero_error):
        yield f"The weight shows joint 3's zero {elbow:+.1f} +- {elbow_error:.1f} degrees off."


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
