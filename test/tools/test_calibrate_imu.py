# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate imu from recordings, through the command line."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vqf import VQF

from exo_gravity.core.arm.tilt import angle_between, rotation_matrix
from exo_gravity.lab.calibration.imu import ImuRecord
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.tools.calibrate import main

from ..support.imu_records import record, rests
from ..support.synthetic_bags import START, STORE, write_bag

IMU, TOPIC = "sensor_msgs/msg/Imu", "/imu/data_raw"
MOUNTED = np.array((0.1, -0.2, 0.6, 0.768))
MOUNTED /= np.linalg.norm(MOUNTED)


def imu_entry(
    time: float, rate: np.ndarray, force: np.ndarray, orientation: np.ndarray | None = None, unknown: float = 0.0
) -> tuple[str, int, bytes]:
    """Return type, stamp and bytes of a message; unknown: first entry of the covariances of rate and force."""
    types = STORE.types
    stamp = START + round(time * 1e9)
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="imu"
    )
    vector, covariance = types["geometry_msgs/msg/Vector3"], np.full(9, unknown)
    quaternion = (0.0, 0.0, 0.0, 1.0) if orientation is None else orientation
    message = types[IMU](
        header, types["geometry_msgs/msg/Quaternion"](*map(float, quaternion)),
        np.full(9, -1.0 if orientation is None else 0.0),
        vector(*map(float, rate)), covariance, vector(*map(float, force)), covariance,
    )  # fmt: skip
    return IMU, stamp, bytes(STORE.serialize_cdr(message, IMU))


def bag_of(
    folder: Path, samples: ImuRecord, orientation: np.ndarray | None = None, unknown: float = 0.0, topic: str = TOPIC
) -> Path:
    reported = [None] * len(samples.time) if orientation is None else orientation
    rows = zip(*samples, reported, strict=True)
    return write_bag(folder, ((topic, *imu_entry(*row, unknown)) for row in rows))


def reported(samples: ImuRecord, kind: str) -> np.ndarray:
    """Return an orientation: what VQF makes of the samples, one filled in, zeros, or one of other axes."""
    rate, force = (np.ascontiguousarray(values) for values in samples[1:])
    filtered = np.roll(VQF(0.01).updateBatch(rate, force)["quat6D"], -1, axis=1)
    turned = (Rotation.from_quat(filtered) * Rotation.from_euler("x", 3.8, degrees=True)).as_quat()
    upright = np.tile(filtered[100], (len(rate), 1))
    return {"true": filtered, "filled in": upright, "zeros": 0.0 * filtered, "of other axes": turned}[kind]


def calibrate(tmp_path: Path, *arguments: str) -> int:
    params = str(packaged_config("exo.yaml"))
    return main(["imu", "--params", params, "--output", str(tmp_path / "new.yaml"), *arguments])


def is_found(tmp_path: Path) -> bool:
    """Whether the mounting in the new file is that of the IMU."""
    found = rotation_matrix(load(tmp_path / "new.yaml")["/imu"]["rotation_trunk_from_imu"])
    error = found @ rotation_matrix(MOUNTED).T
    return all(angle_between(axis, column) < math.radians(1.5) for axis, column in zip(np.eye(3), error, strict=True))


def test_the_mounting_goes_into_the_new_file_and_onto_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = bag_of(tmp_path / "bag", record(MOUNTED))
    assert calibrate(tmp_path, "--bag", str(bag)) == 0 and is_found(tmp_path)
    text = (tmp_path / "new.yaml").read_text(encoding="utf-8")
    assert "calibrate imu: ±1.0 1.0" in text and "# x, y, z, w, from a calibration" in text
    assert "Calibrated." in (tmp_path / "new.html").read_text(encoding="utf-8")
    assert "rotation_trunk_from_imu" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kind", "unknown", "problem"),
    [
        ("true", 0.0, ""),
        ("zeros", 0.0, ""),
        ("zeros", -1.0, ""),
        ("filled in", 0.0, "its orientation_covariance\\[0\\] must be -1"),
        (
            "of other axes",
            0.0,
            "the reported orientation, which `imu` would use, is [34] degrees from the accelerometer",
        ),
    ],
)
def test_the_orientation_that_imu_will_use_is_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, unknown: float, problem: str
) -> None:
    samples = record(MOUNTED)
    bag = bag_of(tmp_path / "bag", samples, reported(samples, kind), unknown)
    assert calibrate(tmp_path, "--bag", str(bag)) == (1 if problem else 0)
    assert re.search(problem, capsys.readouterr().err)


def test_an_imu_that_reports_its_orientation_and_no_rate_is_calibrated(tmp_path: Path) -> None:
    samples = record(MOUNTED)
    still = samples._replace(angular_velocity=np.zeros_like(samples.angular_velocity))
    bag = bag_of(tmp_path / "bag", still, reported(samples, "true"))
    assert calibrate(tmp_path, "--bag", str(bag)) == 0 and is_found(tmp_path)


def test_six_rests_are_shown_and_noted_in_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bow = bag_of(tmp_path / "bow", record(MOUNTED))
    sides = bag_of(tmp_path / "rests", rests(6, np.array((1.02, 0.97, 1.01)), np.array((0.2, -0.3, 0.1))))
    assert calibrate(tmp_path, "--bag", str(bow), "--rests", str(sides)) == 0
    assert "scale 1.02" in capsys.readouterr().out
    assert "accelerometer: true = scale (shown - bias), scale 1.02" in (tmp_path / "new.yaml").read_text("utf-8")


SLOW = ImuRecord(*(values[::10] for values in record(MOUNTED)))


@pytest.mark.parametrize(
    ("samples", "topic", "sentence"),
    [
        (record(MOUNTED, bow=0.2), TOPIC, "not calibrated: the bow was 11 degrees"),
        (SLOW, TOPIC, "samples a second must be 20 or more; they come at 10 Hz"),
        (SLOW, "/other", "no samples of /imu/data_raw (sensor_msgs/msg/Imu); its topics: /other"),
    ],
    ids=["a small bow", "slow samples", "another topic"],
)
def test_a_recording_that_shows_nothing_is_refused_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], samples: ImuRecord, topic: str, sentence: str
) -> None:
    bag = bag_of(tmp_path / "bag", samples, topic=topic)
    assert calibrate(tmp_path, "--bag", str(bag)) == 1
    assert sentence in capsys.readouterr().err
    assert list(tmp_path.glob("new.*")) == []
