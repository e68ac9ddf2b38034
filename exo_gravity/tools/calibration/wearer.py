"""calibrate wearer: the weight of the wearer's relaxed arm, from supported poses.

The robot is calibrated already: what it needs beyond its own moments is the wearer's. Two masses explain them, one on
link 3 and one on link 4, at the centres of gravity of the body-mass table: torque shows only mass times distance.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.calibration.identification import Observation, columns
from exo_gravity.core.compensation.params import wearer_of
from exo_gravity.core.errors import DataError
from exo_gravity.core.model.moments import moments_of, regressor
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.tools.calibration import live
from exo_gravity.tools.calibration.live import Say, is_simulated, tour_parameters
from exo_gravity.tools.calibration.recorded import observations_of
from exo_gravity.tools.calibration.result import CalibrationResult, Change
from exo_gravity.tools.inputs.arms import ConfiguredArm

POSES = 4  # the hanging arm and three others
BREATHING = 0.1  # Nm: standard deviation by which a relaxed, breathing person differs from pose to pose
TYPICAL_BODY_MASS = 70.0  # kg
# rad: a comfortable part of the joints' ranges.
COMFORTABLE = ((-0.4, -0.17, -0.5, -0.17), (0.6, 1.2, 1.3, 1.7))
LARGEST_ERROR = 0.25  # of a mass, as a standard error
MOST = 15.0  # kg of a person's arm
TABLE_RATIO = (0.6, 1.6)  # measured to tabled moments that are plausible


class WornArm(NamedTuple):
    """The masses that explain the torque beyond the robot's."""

    mass: np.ndarray  #: (2,) kg on links 3 and 4
    error: np.ndarray  #: (2,) kg, standard errors
    remainder: np.ndarray  #: (n, 4) Nm of each pose


def calibrate_wearer(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the wearer's relaxed arm, or take it from `options.bag`. Raises ParameterError."""
    if options.bag:
        return wearer_from(arm, observations_of(options.bag, arm))
    if not is_simulated(options.params, arm):
        options.ask("Wear the arm, sit upright and relax: it will be moved slowly. Pull to stop it")
    # Few poses, in a comfortable range, with the weight that the table expects.
    low, high = np.maximum(arm.low, COMFORTABLE[0]), np.minimum(arm.high, COMFORTABLE[1])
    changes = {"tour.poses": POSES, "position_min": low.tolist(), "position_max": high.tolist()}
    mass, cog = wearer_of(arm.compensator)
    if not any(mass):
        mass, cog = wearer_of({**arm.compensator, "wearer.body_mass": TYPICAL_BODY_MASS})
    moments = moments_of(arm.robot.with_wearer(mass, cog))
    tour = live.run_tour(options, tour_parameters(options.params, arm, changes, moments), say)
    return wearer_from(arm, tour.measured, tour.refusals(options.record))


def wearer_from(
    arm: ConfiguredArm, observations: Sequence[Observation], refusals: tuple[str, ...] = ()
) -> CalibrationResult:
    """Return the wearer's masses that `observations` show; refusals: why they are incomplete."""
    observations = tuple(observations)
    cog = _cog(arm)
    try:
        worn = worn_arm(arm, observations, cog)
    except DataError as error:
        return CalibrationResult(refusals=(*refusals, str(error)), arm=arm, observations=observations)
    node = f"{arm.namespace}/compensator"
    mass = [0.0, 0.0, *np.round(worn.mass, 3).tolist()]
    note = f"kg, +-{worn.error[0]:.2f} and {worn.error[1]:.2f}"
    changes = (
        Change(node, "wearer.mass", mass, note),
        Change(node, "wearer.cog", [0.0, 0.0, *np.round(cog, 4).tolist()], "m, of the body-mass table"),
    )
    lines = (
        f"upper arm: {worn.mass[0]:.2f} +- {worn.error[0]:.2f} kg, M3 {_moment(arm, worn.mass, cog)[0]:.3f} kg m",
        f"forearm and hand: {worn.mass[1]:.2f} +- {worn.error[1]:.2f} kg, M4 {worn.mass[1] * cog[1]:.3f} kg m",
        f"largest remainder of a pose: {np.abs(worn.remainder).max():.2f} Nm",
    )
    comparison, implausible = _compared(arm, worn.mass, cog)
    return CalibrationResult(changes, (*lines, comparison), refusals + implausible, arm, observations)


def worn_arm(arm: ConfiguredArm, observations: Sequence[Observation], cog: np.ndarray) -> WornArm:
    """Return the masses on links 3 and 4, at `cog` (2,) m, that explain what the robot alone does not.

    Raises DataError if the poses do not show them.
    """
    if len(observations) < 3:
        raise DataError(f"{len(observations)} poses were measured, must be at least 3")
    theta, direction, effort, spread = columns(observations)
    rows = regressor(theta, direction, arm.robot.gravity)
    length = arm.robot.length
    per_mass = np.zeros((8, 2))
    per_mass[:3, 0] = length[0], length[1], cog[0]
    per_mass[:4, 1] = *length[:3], cog[1]
    extra = effort - rows @ moments_of(arm.robot)
    weight = 1.0 / np.hypot(spread, BREATHING).ravel()
    matrix = (rows @ per_mass).reshape(-1, 2) * weight[:, None]
    covariance = np.linalg.pinv(matrix.T @ matrix)
    mass = covariance @ matrix.T @ (extra.ravel() * weight)
    remainder = extra - rows @ per_mass @ mass
    chi = float(np.sum((remainder.ravel() * weight) ** 2)) / (remainder.size - 2)
    error = np.sqrt(np.diag(covariance) * max(1.0, chi))
    for name, own, deviation in zip(("upper arm", "forearm and hand"), mass, error, strict=True):
        if not 0.0 < own < MOST:
            raise DataError(
                f"{name}: {own:.2f} kg: must be from 0 to {MOST:g}: is the arm relaxed, the robot calibrated?"
            )
        if deviation > LARGEST_ERROR * own:
            raise DataError(f"{name}: {own:.2f} +- {deviation:.2f} kg: add a pose with the arm further forward")
    return WornArm(mass, error, remainder)


def _cog(arm: ConfiguredArm) -> np.ndarray:
    """Return the centres of gravity (2,) in m on links 3 and 4: those of the file's wearer, or of a typical one."""
    mass, cog = wearer_of(arm.compensator)
    if mass[2] and mass[3]:
        return np.array(cog[2:], dtype=float)
    return Wearer(TYPICAL_BODY_MASS).on_links(arm.robot.length).cog[2:]


def _moment(arm: ConfiguredArm, mass: np.ndarray, cog: np.ndarray) -> tuple[float, float]:
    """Return M3 and M4 in kg m of masses (2,) on links 3 and 4."""
    return float(mass[0] * cog[0] + mass[1] * arm.robot.length[2]), float(mass[1] * cog[1])


def _compared(arm: ConfiguredArm, mass: np.ndarray, cog: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """Return how the masses compare with the body-mass table, and why they would be implausible."""
    given, body_mass = arm.compensator, arm.compensator["wearer.body_mass"]
    person = Wearer(body_mass or TYPICAL_BODY_MASS, given["wearer.sex"], segment_length=given["wearer.segment_length"])
    load = person.on_links(arm.robot.length)
    tabled = np.array(_moment(arm, load.mass[2:], load.cog[2:]))
    ratio = np.array(_moment(arm, mass, cog)) / tabled
    if not body_mass:
        return f"a person of {TYPICAL_BODY_MASS * ratio[0]:.0f} kg has this M3 by the table {person.table}", ()
    sentence = f"{ratio[0]:.0%} of M3 and {ratio[1]:.0%} of M4 by the table {person.table} for {body_mass:g} kg"
    low, high = TABLE_RATIO
    is_plausible = np.all((ratio >= low) & (ratio <= high))
    return sentence, () if is_plausible else (f"implausible: {sentence}: must be from {low:.0%} to {high:.0%}",)
