"""calibrate imu: the mounting of the IMU, from a recording of its samples or from the running driver.

The file's `/imu` names the topic. Live, the recorder alone is started, beside the user's own IMU driver.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from exo_gravity.bag.storage import Storage
from exo_gravity.core.calibration.imu_mounting import AccelerometerFit, ImuRecord, Mounting, mounting, six_rests
from exo_gravity.core.errors import DataError
from exo_gravity.core.trunk.params import IMU
from exo_gravity.tools.calibration.outcome import Change, Outcome
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


def run(options: argparse.Namespace, arm: ConfiguredArm | None, say: Callable[[object], None]) -> Outcome:
    """Calibrate the IMU of the file options.params from options.bag, or live.

    options.rests: a recording of six rests, None for none. options.ask: waits for the person. Raises DataError.
    """
    topic = node_values(load(options.params), NODE, IMU)["input_topic"]
    bag = options.bag or _record(options, say)
    try:
        found = mounting(read_imu(bag, topic))
        fit = six_rests(read_imu(options.rests, topic)) if options.rests else None
    except DataError as error:
        return Outcome((), (), (str(error),), None)
    changes, lines = _mounting_result(found)
    if fit is not None:
        line = _accelerometer_line(fit)
        changes, lines = (*changes, Change(NODE, "", 0, line)), (*lines, line)
    return Outcome(changes, lines)


def read_imu(bag: Path, topic: str) -> ImuRecord:
    """Return the samples of `topic` in a recording, in order of their stamps. Raises DataError."""
    storage, types = Storage(bag), get_typestore(Stores.ROS2_JAZZY)
    rows: list[tuple[float, ...]] = []
    for batch in storage.batches(lambda name, kind: name == topic and kind == IMU_TYPE):
        for data in batch.data:
            try:
                message: Any = types.deserialize_cdr(data, batch.msgtype)
            except (SerdeError, ValueError) as error:
                raise DataError(f"{bag}: {topic}: {error}") from None
            stamp, rate, force = message.header.stamp, message.angular_velocity, message.linear_acceleration
            rows.append((stamp.sec + stamp.nanosec * 1e-9, rate.x, rate.y, rate.z, force.x, force.y, force.z))
    if not rows:
        topics = ", ".join(sorted(storage.topics)) or "none"
        raise DataError(f"{bag}: no samples of {topic} ({IMU_TYPE}); its topics: {topics}")
    values = np.array(sorted(rows))
    return ImuRecord(values[:, 0] - values[0, 0], values[:, 1:4], values[:, 4:7])


def _mounting_result(found: Mounting) -> tuple[tuple[Change, ...], tuple[str, ...]]:
    error = " ".join(f"{math.degrees(angle):.1f}" for angle in found.error)
    bias = " ".join(f"{value:+.4f}" for value in found.gyroscope_bias)
    bias_error = " ".join(f"{value:.4f}" for value in found.gyroscope_bias_error)
    quaternion = [round(float(value), 6) for value in found.quaternion]
    accuracy = f"±{error} degrees about the trunk's x, y, z, of which posture is the larger part"
    bows = f"{found.bows} {'bow' if found.bows == 1 else 'bows'} of up to {math.degrees(found.bow):.0f} degrees"
    lines = (
        f"{ROTATION}: {' '.join(f'{value:.4f}' for value in quaternion)} (x, y, z, w), {accuracy}",
        f"from {bows}",
        f"gyroscope bias {bias} rad/s, ±{bias_error}; the imu node estimates it by itself",
    )
    note = f"{accuracy}, from {bows}; gyroscope bias {bias} rad/s"
    return (Change(NODE, ROTATION, quaternion, note),), lines


def _accelerometer_line(fit: AccelerometerFit) -> str:
    scale, bias = (" ".join(f"{value:.4f}" for value in values) for values in (fit.scale, fit.bias))
    return f"accelerometer: true = scale (shown - bias), scale {scale}, bias {bias} m/s^2, for the driver; " + (
        f"{fit.residual:.3f} m/s^2 remain"
    )


def _record(options: argparse.Namespace, say: Callable[[object], None]) -> Path:
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
