# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mounting of an IMU: from records of a person who stands, bows and stands, and by `calibrate imu` from recordings.

The records are those of the simulated IMU.
"""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vqf import VQF

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import rotation_matrix
from exo_gravity.core.errors import DataError
from exo_gravity.lab.calibration.imu import ImuRecord, mounting, six_rests
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.sim.trunk_motion import ImuConfig, SimulatedImu, TrunkState

from ..support import CONFIG
from ..support.synthetic_bags import START, STORE, header, serialised, write_bag

RATE = 100.0  # Hz


def record(
    quaternion: np.ndarray,
    bow: float = 0.7,
    lean: float = 0.0,
    seed: int = 0,
    upright: float = 2.0,
    posture: tuple[float, float] = (0.0, 0.0),
    late: float = 0.0,
    right: float = 0.25,
) -> ImuRecord:
    """Return 2 s upright, a bow in 1.5 s that leans sideways by `lean` rad, 2 s bowed, back, and 2 s upright.

    And then a lean to the right by `right` rad in the same way. late: s by which the bow follows its lean.
    """
    bowed = upright + 7.0 + late
    time = np.arange(0.0, bowed + 7.0, 1.0 / RATE)
    s = np.interp(time, np.cumsum((0.0, upright, 1.5, 2.0, 1.5, 2.0)), (0.0, 0.0, 1.0, 1.0, 0.0, 0.0))
    share = s * s * (3.0 - 2.0 * s)
    leant = np.interp(time - bowed, np.cumsum((0.0, 1.5, 2.0, 1.5)), (0.0, 1.0, 1.0, 0.0))
    pitch = posture[0] + bow * np.interp(time - late, time, share)
    roll = posture[1] + lean * share + right * leant * leant * (3.0 - 2.0 * leant)
    imu = SimulatedImu(ImuConfig(tuple(quaternion), RATE, seed=seed))
    rates = np.gradient(pitch, time), np.gradient(roll, time)
    samples = [imu.sample(TrunkState(*row)) for row in zip(pitch, roll, *rates, strict=True)]
    gyroscope, accelerometer = (np.array(column) for column in zip(*samples, strict=True))
    return ImuRecord(time, gyroscope, accelerometer)


def rests(count: int, scale: np.ndarray, bias: np.ndarray) -> ImuRecord:
    """Return an IMU that lies on `count` of its sides for 2 s each, turned in 1 s."""
    sides = np.array([(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, -1, 0), (-1, 0, 0), (0, 0, -1)], float)[:count]
    rng = np.random.default_rng(3)
    force = np.repeat(sides * STANDARD_GRAVITY, 300, axis=0) / scale + bias
    rate = 1e-3 * rng.standard_normal(force.shape)
    for side in range(count):
        rate[300 * side : 300 * side + 100] += (1.5, 0.3, 0.0)
    return ImuRecord(np.arange(len(force)) / RATE, rate, force + 0.01 * rng.standard_normal(force.shape))


IMU, TOPIC = "sensor_msgs/msg/Imu", "/imu/data_raw"
MOUNTED = np.array((0.1, -0.2, 0.6, 0.768))
MOUNTED /= np.linalg.norm(MOUNTED)
STRAIGHT = np.array((0.0, 0.0, 0.0, 1.0))
SCALE, BIAS = np.array((1.02, 0.97, 1.01)), np.array((0.2, -0.3, 0.1))


def angle_of(found: object, expected: np.ndarray) -> float:
    error = rotation_matrix(found) @ rotation_matrix(expected).T
    return math.acos(max(-1.0, min(1.0, (np.trace(error) - 1.0) / 2.0)))


# From a record


@pytest.mark.parametrize("seed", range(4))
def test_any_mounting_is_found_within_its_stated_error(seed: int) -> None:
    quaternion = np.random.default_rng(seed).standard_normal(4)
    quaternion /= np.linalg.norm(quaternion)
    found = mounting(record(quaternion, seed=seed))
    assert angle_of(found.quaternion, quaternion) < min(math.radians(1.5), 2.0 * np.linalg.norm(found.error))
    assert found.bow == pytest.approx(0.7, abs=0.03)
    assert found.quaternion[3] >= 0.0 and np.linalg.norm(found.quaternion) == pytest.approx(1.0)


def test_three_bows_are_averaged_and_a_bias_of_the_gyroscope_does_no_harm() -> None:
    bows = [record(STRAIGHT, lean=lean, seed=seed) for seed, lean in enumerate((0.09, -0.05, -0.04))]
    rate, force = (np.concatenate(column) for column in zip(*(bow[1:] for bow in bows), strict=True))
    one, together = mounting(bows[0]), mounting(ImuRecord(np.arange(len(rate)) / RATE, rate, force))
    assert (one.bows, together.bows) == (1, 3)
    assert angle_of(one.quaternion, STRAIGHT) > 0.08 and angle_of(together.quaternion, STRAIGHT) < 0.02
    assert together.error[2] < one.error[2]
    shifted = bows[0]._replace(angular_velocity=bows[0].angular_velocity + np.array((0.03, -0.02, 0.01)))
    assert mounting(shifted).quaternion == pytest.approx(one.quaternion, abs=1e-3)


def test_a_crooked_posture_is_part_of_the_result_and_a_lean_counts_into_its_error() -> None:
    straight, leaning = (mounting(record(STRAIGHT, lean=lean)) for lean in (0.0, 0.09))
    assert leaning.error[2] > straight.error[2]
    crooked = mounting(record(STRAIGHT, posture=(0.05, 0.0)))
    assert angle_of(crooked.quaternion, STRAIGHT) == pytest.approx(0.05, abs=0.015)


def test_six_rests_show_scale_and_bias_of_the_accelerometer() -> None:
    scale, bias, remainder = six_rests(rests(6, SCALE, BIAS))
    assert scale == pytest.approx(SCALE, abs=1e-3) and bias == pytest.approx(BIAS, abs=5e-3)
    assert remainder < 0.01
    with pytest.raises(DataError, match="on 5 different sides, must be 6"):
        six_rests(rests(5, SCALE, BIAS))


def scaled(taken: ImuRecord, rate: float = 1.0, force: float = 1.0) -> ImuRecord:
    return ImuRecord(taken.time, rate * taken.angular_velocity, force * taken.acceleration)


GOOD = record(STRAIGHT)
TIME = np.arange(0.0, 5.0, 0.01)
SHAKEN = np.stack([np.sin(40.0 * TIME + phase) for phase in (0, 1, 2)], axis=1)
USELESS = {  # what a record shows of no mounting, and what is said of it
    "a small bow": (record(STRAIGHT, bow=0.2), "the bow was 1[12] degrees, must be 20 or more"),
    "a lean, then a bow": (record(STRAIGHT, lean=0.5, late=0.7), "not about one axis"),
    "no lean": (record(STRAIGHT, right=0.0), "there is no bow before a lean to the right"),
    "a lean to the left": (record(STRAIGHT, right=-0.25), "the lean was to the left"),
    "an accelerometer whose sign is reversed": (scaled(GOOD, force=-1.0), "the accelerometer's sign is reversed"),
    "two bows": (record(STRAIGHT, bow=0.4, right=0.0, late=0.0), "there is no bow before a lean to the right"),
    "never upright": (record(STRAIGHT, upright=0.0), "must begin and end upright"),
    "wrong signs": (scaled(GOOD, rate=-1.0), "check units and signs"),
    "rates in degrees": (scaled(GOOD, rate=57.3), "."),
    "forces in g": (scaled(GOOD, force=0.102), "shows 0.10 g, must be 1"),
    "never still": (ImuRecord(TIME, SHAKEN, 9.81 * SHAKEN), "never still"),
    "silent": (ImuRecord(TIME[:3], SHAKEN[:3], SHAKEN[:3]), "3 IMU samples"),
}


@pytest.mark.parametrize(("taken", "sentence"), USELESS.values(), ids=USELESS)
def test_a_record_that_shows_no_mounting_is_refused(taken: ImuRecord, sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        mounting(taken)


# From a recording, by the command


def bag_of(
    folder: Path, samples: ImuRecord, orientation: np.ndarray | None = None, unknown: float = 0.0, topic: str = TOPIC
) -> Path:
    """Write a bag of an IMU; unknown: first entry of the covariances of rate and force."""
    quaternion, vector = (STORE.types[f"geometry_msgs/msg/{kind}"] for kind in ("Quaternion", "Vector3"))
    reported = np.tile(STRAIGHT, (len(samples.time), 1)) if orientation is None else orientation
    known, covariance = np.full(9, -1.0 if orientation is None else 0.0), np.full(9, unknown)
    content = []
    for time, rate, force, turned in zip(*samples, reported, strict=True):
        stamp = START + round(time * 1e9)
        fields = (quaternion(*turned.tolist()), known, vector(*rate.tolist()), covariance, vector(*force.tolist()))
        content.append((topic, IMU, stamp, serialised(IMU, header(stamp, "imu"), *fields, covariance)))
    return write_bag(folder, content)


def reported(samples: ImuRecord, kind: str) -> np.ndarray:
    """Return an orientation: what VQF makes of the samples, one filled in, zeros, or one of other axes."""
    rate, force = (np.ascontiguousarray(values) for values in samples[1:])
    filtered = np.roll(VQF(0.01).updateBatch(rate, force)["quat6D"], -1, axis=1)
    turned = (Rotation.from_quat(filtered) * Rotation.from_euler("x", 3.8, degrees=True)).as_quat()
    upright = np.tile(filtered[100], (len(rate), 1))
    return {"true": filtered, "filled in": upright, "zeros": 0.0 * filtered, "of other axes": turned}[kind]


@pytest.fixture
def calibrate(run_tool, tmp_path):
    words = ("calibrate", "imu", "--params", CONFIG / "exo.yaml", "--output", tmp_path / "new.yaml")
    return lambda *bags: run_tool(*words, *bags)


def is_found(tmp_path: Path) -> bool:
    return angle_of(load(tmp_path / "new.yaml")["/imu"]["rotation_trunk_from_imu"], MOUNTED) < math.radians(1.5)


def test_the_mounting_goes_into_the_new_file_and_onto_the_page_and_six_rests_beside_it(tmp_path, calibrate) -> None:
    bow, sides = bag_of(tmp_path / "bag", record(MOUNTED)), bag_of(tmp_path / "rests", rests(6, SCALE, BIAS))
    ended = calibrate("--bag", bow, "--rests", sides)
    assert ended.code == 0 and is_found(tmp_path)
    text = (tmp_path / "new.yaml").read_text(encoding="utf-8")
    assert "calibrate imu: ±1.0 1.0" in text and "# x, y, z, w, from a calibration" in text
    assert "accelerometer: true = scale (shown - bias), scale 1.02" in text
    assert "Calibrated." in (tmp_path / "new.html").read_text(encoding="utf-8")
    assert "rotation_trunk_from_imu" in ended.out and "scale 1.02" in ended.out


OTHER_AXES = "the reported orientation, which `imu` would use, is [34] degrees from the accelerometer"
ORIENTATIONS = [  # the kind, the reported share of the rate, the covariances' first entry, and what is wrong
    ("true", 1.0, 0.0, ""),
    ("true", 0.0, 0.0, ""),
    ("zeros", 1.0, 0.0, ""),
    ("zeros", 1.0, -1.0, ""),
    ("filled in", 1.0, 0.0, r"its orientation_covariance\[0\] must be -1"),
    ("of other axes", 1.0, 0.0, OTHER_AXES),
]


@pytest.mark.parametrize(("kind", "rate", "unknown", "problem"), ORIENTATIONS)
def test_the_orientation_that_imu_will_use_is_judged(tmp_path, calibrate, kind, rate, unknown, problem) -> None:
    samples = record(MOUNTED)
    ended = calibrate("--bag", bag_of(tmp_path / "bag", scaled(samples, rate), reported(samples, kind), unknown))
    assert ended.code == (1 if problem else 0) and re.search(problem, ended.err)
    assert problem or is_found(tmp_path)


SLOW = ImuRecord(*(values[::10] for values in record(MOUNTED)))
REFUSED = {
    "a small bow": (record(MOUNTED, bow=0.2), TOPIC, "not calibrated: the bow was 11 degrees"),
    "slow samples": (SLOW, TOPIC, "samples a second must be 20 or more; they come at 10 Hz"),
    "another topic": (SLOW, "/other", "no samples of /imu/data_raw (sensor_msgs/msg/Imu); its topics: /other"),
}


@pytest.mark.parametrize(("samples", "topic", "sentence"), REFUSED.values(), ids=REFUSED)
def test_a_recording_that_shows_nothing_is_refused_and_nothing_is_written(
    tmp_path, calibrate, samples, topic, sentence
) -> None:
    ended = calibrate("--bag", bag_of(tmp_path / "bag", samples, topic=topic))
    assert ended.code == 1 and sentence in ended.err
    assert list(tmp_path.glob("new.*")) == []


def test_a_result_that_is_refused_ends_with_1_and_is_not_written(tmp_path, calibrate, monkeypatch) -> None:
    change = Change("/imu", "rotation_trunk_from_imu", [0.0, 0.0, 0.0, 1.0])
    refused = CalibrationResult((change,), (), ("the bow slipped",))
    monkeypatch.setattr("exo_gravity.lab.calibration.imu.calibrate_imu", lambda *_: refused)
    ended = calibrate("--bag", tmp_path)
    assert ended.code == 1 and "calibrate: not calibrated: the bow slipped" in ended.err
    assert list(tmp_path.glob("new.*")) == []
