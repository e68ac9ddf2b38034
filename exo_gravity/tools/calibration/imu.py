"""calibrate imu: the mounting of the IMU, from a recording of its samples or from the running driver.

The file's `/imu` names the topic. Live, only the recorder is started, while the user's own IMU driver runs.

Posture leaves an error of a degree. The arm's weight shows the mounting to a tenth of one (`with_mounting`): from one
lean of the stand the rotation that moves gravity, from two leans the heading as well.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from exo_gravity.core.calibration.imu_mounting import AccelerometerFit, ImuRecord, Mounting, mounting, six_rests
from exo_gravity.core.errors import DataError
from exo_gravity.core.model.rotation import Quaternion, product
from exo_gravity.core.trunk.params import IMU
from exo_gravity.tools.calibration.live import Say
from exo_gravity.tools.calibration.recorded import messages_of
from exo_gravity.tools.calibration.result import CalibrationResult, Change
from exo_gravity.tools.inputs.arms import ConfiguredArm, node_values
from exo_gravity.tools.inputs.parameter_file import load
from exo_gravity.tools.launcher import Launcher

NODE = "/imu"
IMU_TYPE = "sensor_msgs/msg/Imu"
ROTATION = "rotation_trunk_from_imu"
REQUEST = (
    "stand upright for 3 s, bow straight ahead by 45 degrees or so, stay there for 3 s, stand upright again for 3 s; "
    "bow three times in all"
)
LARGEST_ERROR = math.radians(0.5)  # of the two directions in which gravity can be off
LARGEST_HEADING_ERROR = math.radians(1.0)
NO_HEADING = (
    "The IMU's heading does not show from one lean of the stand: `calibrate scale` shows it if the stand is leant "
    "forward or back by about 10 degrees when the weight is hung."
)


def calibrate_imu(options: argparse.Namespace, arm: ConfiguredArm | None, say: Say) -> CalibrationResult:
    """Calibrate the IMU of the file options.params from options.bag, or live.

    options.rests: a recording of six rests, None for none. options.ask: waits for the person. Raises DataError.
    """
    topic = node_values(load(options.params), NODE, IMU)["input_topic"]
    bag = options.bag or _record(options, say)
    changes, lines = _mounting_result(mounting(read_imu(bag, topic)))
    if options.rests:
        line = _accelerometer_line(six_rests(read_imu(options.rests, topic)))
        changes, lines = (*changes, Change(NODE, "", 0, line)), (*lines, line)
    return CalibrationResult(changes, lines)


def read_imu(bag: Path, topic: str) -> ImuRecord:
    """Return the samples of `topic` in a recording, in order of their stamps. Raises DataError."""
    rows = []
    for _, message in messages_of(bag, topic, IMU_TYPE):
        stamp, rate, force = message.header.stamp, message.angular_velocity, message.linear_acceleration
        rows.append((stamp.sec + stamp.nanosec * 1e-9, rate.x, rate.y, rate.z, force.x, force.y, force.z))
    values = np.array(sorted(rows))
    return ImuRecord(values[:, 0] - values[0, 0], values[:, 1:4], values[:, 4:7])


def _mounting_result(found: Mounting) -> tuple[tuple[Change, ...], tuple[str, ...]]:
    error = " ".join(f"{math.degrees(angle):.1f}" for angle in found.error)
    quaternion = [round(float(value), 6) for value in found.quaternion]
    accuracy = f"±{error} degrees about the trunk's x, y and z, most of which is posture"
    bows = f"{found.bows} {'bow' if found.bows == 1 else 'bows'} of up to {math.degrees(found.bow):.0f} degrees"
    lines = (
        f"{ROTATION}: {' '.join(f'{value:.4f}' for value in quaternion)} (x, y, z, w), {accuracy}",
        f"from {bows}",
    )
    return (Change(NODE, ROTATION, quaternion, f"{accuracy}, from {bows}"),), lines


def _accelerometer_line(fit: AccelerometerFit) -> str:
    scale, bias = (" ".join(f"{value:.4f}" for value in values) for values in (fit.scale, fit.bias))
    return (
        f"accelerometer: true = scale (shown - bias), scale {scale}, bias {bias} m/s^2, for the driver; "
        f"{fit.residual:.3f} m/s^2 remain"
    )


def _record(options: argparse.Namespace, say: Say) -> Path:
    """Record while the person stands and bows; return the recording's folder."""
    bag = Path(options.output).with_suffix(".bag").resolve()
    if bag.exists():
        raise DataError(f"{bag} exists: choose another --output, or use it with --bag")
    with tempfile.TemporaryDirectory() as folder:
        params = Path(folder, "recorder.yaml")
        content = {"/recorder": {"ros__parameters": {"output": str(bag)}}}
        params.write_text(yaml.safe_dump(content), encoding="utf-8")
        launcher = Launcher(params, lambda node, line: None)
        launcher.start()
        try:
            options.ask(REQUEST)
        finally:
            launcher.stop()
    say(f"Recorded: {bag}")
    return bag


def with_mounting(result: CalibrationResult, params: Path) -> CalibrationResult:
    """Return `result` with a better mounting of the IMU in the file `params`, if the arm's weight showed one."""
    found, arm = result.identified, result.arm
    rotation = load(params).get(NODE, {}).get(ROTATION)
    if found is None or arm is None or not result.changes or not rotation or not arm.compensator["use_imu"]:
        return result
    square, axes = np.linalg.eigh(found.tilt_covariance)  # the last is nearly gravity's own axis
    error, heading_error = math.sqrt(max(0.0, square[0] + square[1])), math.sqrt(max(0.0, square[2]))
    if not 0.0 < error < LARGEST_ERROR:
        return result
    is_whole = heading_error < LARGEST_HEADING_ERROR
    turn = found.tilt if is_whole else axes[:, :2] @ axes[:, :2].T @ found.tilt
    angle, quaternion = math.degrees(float(np.linalg.norm(turn))), turned(rotation, turn_in_trunk(arm.side, turn))
    heading = f"heading ±{math.degrees(heading_error):.2f}" if is_whole else "heading unchanged"
    accuracy = f"±{math.degrees(error):.2f} degrees, {heading}"
    note = f"{accuracy}, from the arm's weight: {angle:.1f} degrees from the value before"
    lines = (f"{ROTATION}: corrected by {angle:.1f} degrees, {accuracy}", *(() if is_whole else (NO_HEADING,)))
    change = Change(NODE, ROTATION, [round(value, 6) for value in quaternion], note)
    return replace(result, changes=(*result.changes, change), lines=(*result.lines, *lines))


def turned(rotation: Sequence[float], turn: np.ndarray) -> Quaternion:
    """Return the mounting `rotation`, trunk from IMU (x, y, z, w), after `turn`, a rotation vector (3,)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = (turn * 0.5 * float(np.sinc(angle / (2.0 * math.pi)))).tolist()
    a, b, c, d = rotation
    return product((x, y, z, math.cos(angle / 2.0)), (a, b, c, d))


def turn_in_trunk(side: str, turn: np.ndarray) -> np.ndarray:
    """Return a rotation vector (3,) in an arm's base frame in the trunk's axes.

    The right arm's base frame is the left one's mirror image, so that the sense of rotation changes.
    """
    outward, forward, down = turn
    return np.array((forward, outward, -down) if side == "left" else (-forward, outward, down))
