"""What an identification refuses, with the pose that is missing, and what it cannot tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from exo_gravity.core.calibration.pose_choice import TYPICAL_MOMENTS, missing_pose
from exo_gravity.core.calibration.pose_fit import ANGLE, COUNT, DISTURBED, FACTOR, OFFSET, SCALE, TILT
from exo_gravity.core.errors import DataError
from exo_gravity.core.model.moments import MOMENTS
from exo_gravity.core.numbers import JOINT_COUNT

if TYPE_CHECKING:
    from exo_gravity.core.calibration.identification import Observation

SCALES = (0.3, 3.0)  # true torque per commanded torque; users report 0.75
SILENT = 0.01  # Nm by which the effort must differ between poses where gravity's torque differs by `EXPECTED`
EXPECTED = 0.3  # Nm
MISFIT = 0.1  # of the peak effort
LEAST_MISFIT = 0.1  # Nm
LEAST_ZERO_ERROR = 0.5  # deg worth a sentence
LEAST_TILT = 1.0  # deg worth a sentence
# Unknowns of joint 1, which carries nothing while its axis is vertical.
FIRST_JOINT = (0, MOMENTS.index("W"), SCALE.start, OFFSET.start)
PER_JOINT = tuple(f"{what} {n + 1}" for what in ("torque scale", "offset") for n in range(JOINT_COUNT))
NAMES = (*MOMENTS, *PER_JOINT)
LEAN = "lean the stand by 10 to 14 degrees to the arm's side, where the arm still hangs close to its home"


def checked(
    observations: Sequence[Observation],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[tuple[float, float]]]:
    """Return theta (n, 4), direction (n, 3), effort (n, 4), spread (n, 4), and mass and lever of each weight.

    Raises DataError that names the observation.
    """
    if not observations:
        raise DataError("no pose was observed")
    for index, observation in enumerate(observations):
        for name, count in (("theta", 4), ("direction", 3), ("effort", 4), ("friction", 4), ("spread", 4)):
            values = np.asarray(getattr(observation, name), dtype=float)
            if values.shape != (count,) or not np.all(np.isfinite(values)):
                raise DataError(f"pose {index + 1}: {name} = {values.tolist()}: must be {count} finite numbers")
        if np.min(observation.spread) < 0.0:
            raise DataError(f"pose {index + 1}: spread = {list(observation.spread)}: must be at least 0 Nm")
    theta, direction, effort, spread = (
        np.array([getattr(observation, name) for observation in observations], dtype=float)
        for name in ("theta", "direction", "effort", "spread")
    )
    return theta, direction, effort, spread, [(o.load_mass, o.load_lever) for o in observations]


def check_motors(effort: np.ndarray, typical: np.ndarray) -> None:
    """Raise DataError if a motor's effort (n, 4) in Nm stays the same where gravity's `typical` torque does not."""
    for joint in range(JOINT_COUNT):
        if np.ptp(typical[:, joint]) > EXPECTED and np.ptp(effort[:, joint]) < SILENT:
            raise DataError(
                f"joint {joint + 1}: the effort is {effort[0, joint] + 0.0:.2f} Nm in every pose: a silent motor"
            )


def check_fit(residual: np.ndarray, effort: np.ndarray) -> None:
    """Raise DataError if half of the residuals (n, 4) in Nm of a joint are large compared with its efforts (n, 4)."""
    typical, peak = np.median(np.abs(residual), axis=0), np.abs(effort).max(axis=0)
    for joint in np.flatnonzero(typical > np.maximum(MISFIT * peak, LEAST_MISFIT)):
        said = f"joint {joint + 1} is {typical[joint]:.2f} Nm off in half of the poses"
        raise DataError(f"the poses do not fit one arm: {said}. {DISTURBED}")


def check_told(hidden: np.ndarray, count: int, direction: np.ndarray, gravity: float) -> None:
    """Raise DataError that names the missing pose if `count` poses do not tell `hidden` (23,) of joints 2 to 4."""
    missing = hidden.copy()
    missing[list(FIRST_JOINT)] = False
    if missing[FACTOR]:
        raise DataError("the weight tells no common factor: hang a heavier one, or hold it with a horizontal forearm")
    if np.any(missing):
        names = ", ".join(NAMES[index] for index in np.flatnonzero(missing))
        pose = missing_pose(missing, direction, np.array(TYPICAL_MOMENTS), gravity)
        raise DataError(f"{count} poses do not tell {names}: add the pose {pose}")


def check_physical(
    moments: np.ndarray, error: np.ndarray, scale: np.ndarray, direction: np.ndarray, gravity: float
) -> None:
    """Raise DataError unless an arm can have the moments (8,) kg m and scales (4,), and their `error` (8,) is small."""
    low, high = SCALES
    for joint in np.flatnonzero((scale < low) | (scale > high)):
        expected = f"from {low:g} to {high:g}: is joint {joint + 1}'s direction or motor type wrong, or did it slip?"
        raise DataError(f"torque scale {joint + 1} = {scale[joint]:.3g}: must be {expected}")
    for index in (1, 2, 3):
        name, value, uncertain = MOMENTS[index], moments[index], error[index]
        if uncertain > abs(value):
            lone = np.arange(COUNT) == index
            pose = missing_pose(lone, direction, np.array(TYPICAL_MOMENTS), gravity)
            raise DataError(f"{name} = {value:.3f} kg m is not known better than {uncertain:.3f}: add the pose {pose}")
        if value <= 0.0:
            raise DataError(
                f"{name} = {value:.3f} kg m: must be positive: check direction and zero of joint {index + 1}"
            )
    for across, along in ((6, 2), (7, 3)):
        if abs(moments[across]) > moments[along]:
            angle = math.degrees(math.atan2(moments[across], moments[along]))
            raise DataError(
                f"{MOMENTS[across]} = {moments[across]:.3f} kg m exceeds {MOMENTS[along]}: "
                f"the zero of joint {along + 1} seems {angle:.0f} degrees off"
            )


def untold(unknowns: np.ndarray, covariance: np.ndarray, hidden: np.ndarray, relative: bool) -> tuple[str, ...]:
    """Return what the poses do not tell, and what would, in sentences; unknowns and `hidden`: (23,)."""
    said = []
    if relative:
        said.append("A common factor of all torque scales and moments: hang a known weight on link 4.")
    if np.any(hidden[:FACTOR]):
        names = ", ".join(NAMES[index] for index in np.flatnonzero(hidden[:FACTOR]))
        said.append(f"{names}: joint 1 carries nothing while its axis is vertical: {LEAN}.")
    for joint, along, across in ((4, 3, 7), (3, 2, 6)):
        angle = math.degrees(math.atan2(unknowns[across], unknowns[along]))
        said.append(
            f"{MOMENTS[across]} of link {joint} from an error of joint {joint}'s zero: it looks like one of "
            f"{angle:+.1f} degrees; check the zero with a level or at a stop."
        )
    elbow, elbow_error = math.degrees(unknowns[ANGLE][0]), math.degrees(math.sqrt(covariance[ANGLE, ANGLE][0, 0]))
    if elbow and abs(elbow) > max(3.0 * elbow_error, LEAST_ZERO_ERROR):
        said.append(
            f"The weight at the elbow speaks for joint 3's zero being {elbow:+.1f} +- {elbow_error:.1f} degrees off."
        )
    square, axes = np.linalg.eigh(covariance[TILT, TILT])  # the least known turn, the last, is the one about gravity
    tilt = math.degrees(float(np.linalg.norm(unknowns[TILT] @ axes[:, :2])))
    tilt_error = math.degrees(math.sqrt(max(0.0, float(square[:2].sum()))))
    if tilt > max(3.0 * tilt_error, LEAST_TILT):
        said.append(f"Gravity seems {tilt:.1f} degrees off what the IMU says: check rotation_trunk_from_imu.")
    return tuple(said)
