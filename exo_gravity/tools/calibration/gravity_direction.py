"""The IMU's mounting as the arm's weight shows it: to a tenth of a degree, where posture leaves a degree.

Only the rotation that moves gravity is corrected: the torques do not show the heading of the IMU.
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


def with_mounting(outcome: Outcome, params: Path) -> Outcome:
    """Return `outcome` with a better mounting of the IMU in the file `params`, if the poses showed one."""
    found, arm, nodes = outcome.identified, outcome.arm, load(params)
    rotation = nodes.get(NODE, {}).get(ROTATION)
    if found is None or arm is None or not outcome.changes or not rotation or not arm.compensator["use_imu"]:
        return outcome
    error = float(np.hypot(*np.sort(found.tilt_error)[:2]))
    if not 0.0 < error < LARGEST_ERROR:
        return outcome
    measured = np.mean([observation.direction for observation in outcome.observations], axis=0)
    turned = measured + np.cross(found.tilt, measured)
    angle, quaternion = corrected(rotation, _in_trunk(arm.side, measured), _in_trunk(arm.side, turned))
    note = f"±{math.degrees(error):.1f} degrees from the arm's weight, which is {math.degrees(angle):.1f} degrees off"
    line = f"{ROTATION}: corrected by {math.degrees(angle):.1f} ±{math.degrees(error):.1f} degrees"
    change = Change(NODE, ROTATION, [round(value, 6) for value in quaternion], note)
    return replace(outcome, changes=(*outcome.changes, change), lines=(*outcome.lines, line))


def corrected(
    rotation: Sequence[float], measured: np.ndarray, true: np.ndarray
) -> tuple[float, tuple[float, float, float, float]]:
    """Return the angle in rad between two directions of gravity, and the mounting after the turn by it.

    rotation: trunk from IMU (x, y, z, w), with which gravity was `measured`, (3,) in the trunk's axes. true: (3,).
    """
    axis = np.cross(measured, true)
    angle = math.atan2(float(np.linalg.norm(axis)), float(measured @ true))
    half = axis / max(float(np.linalg.norm(axis)), 1e-12) * math.sin(angle / 2.0)
    vector, scalar, w = np.array(rotation[:3]), float(rotation[3]), math.cos(angle / 2.0)
    x, y, z = (w * vector + scalar * half + np.cross(half, vector)).tolist()
    return angle, (x, y, z, w * scalar - float(half @ vector))


def _in_trunk(side: str, direction: np.ndarray) -> np.ndarray:
    """Return a direction in an arm's base frame in the trunk's axes, as in `core.tilt`."""
    outward, forward, down = direction
    return np.array((forward, outward if side == "left" else -outward, -down))
