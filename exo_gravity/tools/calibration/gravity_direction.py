"""The IMU's mounting as the arm's weight shows it: to a tenth of a degree, where posture leaves a degree.

From one lean of the stand only the rotation that moves gravity is corrected; from two leans the heading as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from exo_gravity.tools.calibration.imu import NODE, ROTATION
from exo_gravity.tools.calibration.outcome import Change, Outcome
from exo_gravity.tools.inputs.parameter_file import load

LARGEST_ERROR = math.radians(0.5)  # of the two directions in which gravity can be off
LARGEST_HEADING_ERROR = math.radians(1.0)
NO_HEADING = (
    "The IMU's heading does not show from one lean of the stand: `calibrate scale` shows it if the stand is leant "
    "forward or back by about 10 degrees when the weight is hung."
)


def with_mounting(outcome: Outcome, params: Path) -> Outcome:
    """Return `outcome` with a better mounting of the IMU in the file `params`, if the poses showed one."""
    found, arm, nodes = outcome.identified, outcome.arm, load(params)
    rotation = nodes.get(NODE, {}).get(ROTATION)
    if found is None or arm is None or not outcome.changes or not rotation or not arm.compensator["use_imu"]:
        return outcome
    square, axes = np.linalg.eigh(found.tilt_covariance)  # the last is nearly gravity's own axis
    error, heading_error = math.sqrt(max(0.0, square[0] + square[1])), math.sqrt(max(0.0, square[2]))
    if not 0.0 < error < LARGEST_ERROR:
        return outcome
    is_whole = heading_error < LARGEST_HEADING_ERROR
    turn = found.tilt if is_whole else axes[:, :2] @ axes[:, :2].T @ found.tilt
    angle, quaternion = math.degrees(float(np.linalg.norm(turn))), turned(rotation, _turn_in_trunk(arm.side, turn))
    if is_whole:
        accuracy = f"±{math.degrees(error):.2f} degrees, heading ±{math.degrees(heading_error):.2f}"
    else:
        accuracy = f"±{math.degrees(error):.2f} degrees, heading unchanged"
    note = f"{accuracy}, from the arm's weight: {angle:.1f} degrees from the value before"
    lines = (f"{ROTATION}: corrected by {angle:.1f} degrees, {accuracy}", *(() if is_whole else (NO_HEADING,)))
    change = Change(NODE, ROTATION, [round(value, 6) for value in quaternion], note)
    return replace(outcome, changes=(*outcome.changes, change), lines=(*outcome.lines, *lines))


def turned(rotation: Sequence[float], turn: np.ndarray) -> tuple[float, float, float, float]:
    """Return the mounting `rotation`, trunk from IMU (x, y, z, w), after `turn`, a rotation vector (3,)."""
    angle = float(np.linalg.norm(turn))
    half = turn * 0.5 * float(np.sinc(angle / (2.0 * math.pi)))
    vector, scalar, w = np.array(rotation[:3]), float(rotation[3]), math.cos(angle / 2.0)
    x, y, z = (w * vector + scalar * half + np.cross(half, vector)).tolist()
    return x, y, z, w * scalar - float(half @ vector)


def _turn_in_trunk(side: str, turn: np.ndarray) -> np.ndarray:
    """Return a rotation vector in an arm's base frame in the trunk's axes.

    The right arm's base frame is the left one's mirror image, so that the sense of rotation changes.
    """
    return _in_trunk(side, turn) * (1.0 if side == "left" else -1.0)


def _in_trunk(side: str, direction: np.ndarray) -> np.ndarray:
    """Return a direction in an arm's base frame in the trunk's axes, as in `core.model.tilt`."""
    outward, forward, down = direction
    return np.array((forward, outward if side == "left" else -outward, -down))
