# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate imu: the mounting of the IMU, from a recording of its samples or from the running driver.

docs/calibration.md has the idea: upright, the accelerometer shows the trunk's z axis (up); the trunk bows about its y
axis, so y is along bowed x upright. The samples then pass through the estimator that `imu` will use: where it gives no
tilt, or another one than the accelerometer, there is no result. Posture limits that: no person stands upright, or bows
straight ahead, to better than a degree. The arm's weight shows the mounting to a tenth of one (`with_mounting`): from
one lean of the stand the rotation that moves gravity, from two leans the heading as well.
"""

import argparse
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import Tilt, angle_between
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.numbers import Vector
from exo_gravity.core.trunk.checks import IMU, reported_orientation, reported_vector
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.lab.calibration.identification import Identified
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.recorded import samples_of
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.calibration.tours import Say, model_of
from exo_gravity.lab.calibration.tracking import mean_direction
from exo_gravity.lab.inputs.arms import ConfiguredArm, node_values
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.processes import Launcher

NODE = "/imu"
IMU_TYPE = "sensor_msgs/msg/Imu"
ROTATION = "rotation_trunk_from_imu"
REQUEST = (
    "stand upright for 3 s, bow straight ahead by 45 degrees or so, stay there for 3 s, stand upright again for 3 s; "
    "bow three times in all, then lean to your right by 15 degrees or so, stay there for 3 s, and stand upright again"
)
BLOCK = 0.25  # s
STILL_RATE = 0.06  # rad/s; a person who stands still sways at 0.02
STILL_ACCELERATION = 0.4  # m/s^2
MIN_STILL = 1.0  # s
UPRIGHT = math.radians(8.0)  # within which two phases are the same posture
MIN_BOW = math.radians(20.0)
MIN_LEAN = math.radians(9.0)
MAX_OFF_AXIS = math.radians(10.0)  # between the axes that gyroscope and accelerometer show
MAX_WOBBLE = 0.35  # of the rotation, about other axes than its main one
ANGLE_RATIO = (0.8, 1.25)  # of the gyroscope's angle to the accelerometer's
POSTURE = math.radians(1.0)  # assumed error of a person's upright posture, and of the bow's direction
SENSOR = 5e-3  # rad: 5 mg, the bias of a calibrated accelerometer
ONE_G = (0.9, 1.1)  # of the accelerometer at rest
RESTS = 6
DISTINCT = math.radians(30.0)  # between two rests on different sides
NO_VECTOR = (math.nan,) * 3
LEAST_STEP = 1e-4  # s between two samples
SETTLED = 1.5  # s of rest at the start of a record after which `imu` has a tilt
SAME_TILT = math.radians(3.0)  # between accelerometer and `imu` at rest: what `imu` promises
LARGEST_ERROR = math.radians(0.5)  # of the two directions in which gravity can be off
LARGEST_HEADING_ERROR = math.radians(1.0)
NO_HEADING = (
    "The IMU's heading does not show from one lean of the stand: `calibrate scale` shows it if the stand leans about "
    "5 degrees back without the weight, and 5 degrees forward with it."
)


class ImuRecord(NamedTuple):
    """Samples in the IMU's axes; NaN where the driver does not measure a quantity.

    Without a gyroscope, as of a BNO085, the angular velocity is that of the reported orientation.
    """

    time: np.ndarray  #: (n,) s
    angular_velocity: np.ndarray  #: (n, 3) rad/s
    acceleration: np.ndarray  #: (n, 3) m/s^2


class Phase(NamedTuple):
    """A second or more in which the IMU neither turned nor accelerated."""

    samples: slice
    up: np.ndarray  #: (3,), unit vector of the mean acceleration


class Mounting(NamedTuple):
    """How an IMU is mounted on the trunk."""

    quaternion: np.ndarray  #: trunk from IMU, (x, y, z, w)
    error: np.ndarray  #: (3,) rad, standard error about the trunk's x, y and z
    bow: float  #: rad, the deepest
    bows: int  #: how many


def calibrate_imu(options: argparse.Namespace, arm: ConfiguredArm | None, say: Say) -> CalibrationResult:
    """Calibrate the IMU of the file options.params from options.bag, or live.

    The file's `/imu` names the topic. options.rests: a recording of six rests, None for none. options.wait: waits for
    the person. Raises DataError.
    """
    values = node_values(load(options.params), NODE, IMU)
    topic = values["input_topic"]
    samples = read_samples(options.bag or _record(options, say), topic)
    record = record_of(samples)
    found = mounting(record)
    check_as_imu(samples, still_phases(record), found, values)
    quaternion = found.quaternion.round(6).tolist()
    error = " ".join(f"{angle:.1f}" for angle in np.degrees(found.error))
    accuracy = f"±{error} degrees about the trunk's x, y and z, most of which is posture"
    bows = f"from {found.bows} {'bow' if found.bows == 1 else 'bows'} of up to {math.degrees(found.bow):.0f} degrees"
    changes = [Change(NODE, ROTATION, quaternion, f"{accuracy}, {bows}")]
    if options.rests:
        *rows, remainder = six_rests(record_of(read_samples(options.rests, topic)))
        scale, bias = (" ".join(f"{value:.4f}" for value in row) for row in rows)
        fit = f"true = scale (shown - bias), scale {scale}, bias {bias} m/s^2, for the driver"
        changes.append(Change(NODE, "", 0, f"accelerometer: {fit}; {remainder:.3f} m/s^2 remain"))
    return CalibrationResult(tuple(changes))


def read_samples(bag: Path, topic: str) -> list[ImuSample]:
    """Return the samples of `topic` in a recording as `imu` takes them, in order of their stamps. Raises DataError."""
    samples: list[ImuSample] = []
    for found in samples_of(bag, topic, IMU_TYPE):
        columns = [(found["header.stamp.sec"] + found["header.stamp.nanosec"] * 1e-9).tolist()]
        for name, axes, reported in (
            ("angular_velocity", "xyz", reported_vector),
            ("linear_acceleration", "xyz", reported_vector),
            ("orientation", "xyzw", reported_orientation),
        ):
            values = np.column_stack([found[f"{name}.{axis}"] for axis in axes]).tolist()
            columns.append(list(map(reported, values, found[f"{name}_covariance"][:, 0].tolist())))
        samples += [ImuSample(*row) for row in zip(*columns, strict=True)]
    return sorted(samples, key=attrgetter("time"))


def record_of(samples: Sequence[ImuSample]) -> ImuRecord:
    """Return the samples as arrays; the times begin with 0."""
    times, rates, forces, quaternions = zip(*samples, strict=True)
    time = np.array(times) - times[0]
    rate, force = (np.array([values or NO_VECTOR for values in column]) for column in (rates, forces))
    if all(quaternions) and not (np.isfinite(rate).all() and rate.any()):
        world_from_imu = Rotation.from_quat(quaternions)
        turns = (world_from_imu[:-1].inv() * world_from_imu[1:]).as_rotvec()
        rate[:-1] = turns / np.maximum(np.diff(time), LEAST_STEP)[:, None]
        rate[-1] = rate[-2]
    return ImuRecord(time, rate, force)


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
            options.wait(REQUEST)
        finally:
            launcher.stop()
    say(f"Recorded: {bag}")
    return bag


def still_phases(record: ImuRecord) -> list[Phase]:
    """Return the still phases in order.

    Raises DataError if the samples are too few or not finite, or if the accelerometer does not show one g at rest.
    """
    time, rate, force = record
    for name, measured in (("angular_velocity", rate), ("linear_acceleration", force)):
        if len(time) < 10 or not np.all(np.isfinite(measured)):
            raise DataError(f"{len(time)} IMU samples, must be 10 or more, all with a finite {name}")
    median = np.median(rate, axis=0)

    def is_still(block: tuple[int, int]) -> bool:
        part = slice(*block)
        turning = np.linalg.norm(rate[part].mean(axis=0) - median)
        shaking = np.max(np.linalg.norm(force[part] - force[part].mean(axis=0), axis=1))
        return bool(turning < STILL_RATE and shaking < STILL_ACCELERATION)

    edges = np.searchsorted(time, np.append(np.arange(time[0], time[-1], BLOCK), np.inf))
    phases = []
    for still, run in groupby(pairwise(np.unique(edges).tolist()), is_still):
        blocks = list(run)
        samples = slice(blocks[0][0], blocks[-1][1])
        if not still or time[samples][-1] - time[samples][0] < MIN_STILL - BLOCK:
            continue
        share = float(np.linalg.norm(force[samples].mean(axis=0))) / STANDARD_GRAVITY
        if not ONE_G[0] <= share <= ONE_G[1]:
            raise DataError(f"at rest the accelerometer shows {share:.2f} g, must be 1: check its unit (m/s^2)")
        phases.append(Phase(samples, mean_direction(force[samples])))
    return phases


def mounting(record: ImuRecord) -> Mounting:
    """Return the mounting that a record shows of a person who bows, once or several times, and then leans to the right.

    Between and after they stand upright. Bows alone look the same where the accelerometer's sign is reversed.

    Raises DataError, which says what to do, if there are no still phases upright, bowed, leaning and upright; if the
    bow is too small or not about one axis; if the lean is to the left; or if gyroscope and accelerometer contradict
    each other.
    """
    phases = still_phases(record)
    if not phases:
        raise DataError("the IMU was never still for 1 s: stand still, bow, keep still, and stand upright again")
    bends = [angle_between(phase.up, phases[0].up) for phase in phases]
    standing = [index for index, bend in enumerate(bends) if bend < UPRIGHT]
    if standing[-1] < bends.index(max(bends)):
        raise DataError("the record must begin and end upright: stand for 2 s before each bow or lean, and after it")
    upright = np.array([phases[index].up for index in standing])
    z = mean_direction(upright)
    lowest = [(first, max(range(first, last), key=bends.__getitem__)) for first, last in pairwise(standing)]
    turns = [(phases[first], phases[low]) for first, low in lowest if bends[low] >= MIN_LEAN]
    if len(turns) < 2:
        raise DataError(f"there is no bow before a lean to the right: {REQUEST}")
    bow = max(angle_between(bowed.up, before.up) for before, bowed in turns[:-1])
    if bow < MIN_BOW:
        small = f"the bow was {math.degrees(bow):.0f} degrees, must be {math.degrees(MIN_BOW):.0f} or more"
        raise DataError(f"{small}: bow farther, and stay there for 2 s")
    bows = [turn for turn in turns[:-1] if angle_between(turn[1].up, turn[0].up) >= MIN_BOW]
    leant = turns[-1][1]
    across = np.cross([bowed.up for _, bowed in bows], z)
    axes = across / np.linalg.norm(across, axis=1, keepdims=True)
    y = mean_direction(axes)
    bias = np.concatenate([record.angular_velocity[phase.samples] for phase in phases]).mean(axis=0)
    off_axis = [_checked_turn(record, *pair, bias, axis) for pair, axis in zip(bows, axes, strict=True)]
    level = math.hypot(SENSOR, max(POSTURE, *(angle_between(up, z) for up in upright)))
    sideways = level / math.sin(min(bow, math.pi / 2)), float(np.mean(off_axis)) / 2.0
    heading = max(level, math.hypot(*sideways) / math.sqrt(len(bows)))
    rotation = Rotation.from_matrix(np.stack((np.cross(y, z), y, z)))
    forward, left, _ = -rotation.apply(leant.up)
    if abs(forward) > abs(left):
        raise DataError("the last posture was no lean to the side: after the bows lean to your right, and stay for 3 s")
    if left > 0.0:
        cause = "if it was to the right, the accelerometer's sign is reversed: at rest it must show +9.8 upward"
        raise DataError(f"the lean was to the left: {cause}")
    return Mounting(rotation.as_quat(canonical=True), np.array((level, level, heading)), bow, len(bows))


def check_as_imu(
    samples: Sequence[ImuSample], phases: Sequence[Phase], found: Mounting, values: Mapping[str, Any]
) -> None:
    """Raise DataError unless `imu` gives the tilt that each still phase of the samples shows.

    found: the mounting. values: of `imu`'s parameters.
    """
    settings = (values[name] for name in ("rate", "gyroscope_range", "accelerometer_range"))
    estimator = TrunkEstimator(found.quaternion.tolist(), *settings)
    ends = {phase.samples.stop - 1: phase for phase in phases}
    problem = ""
    for k, sample in enumerate(samples):
        answer = None
        try:
            answer = estimator.update(sample)
            problem = "" if answer else problem
        except ParameterError as error:
            problem = problem or f"{error.name} must be {error.expected}"  # the first since the last tilt
        since = sample.time - samples[0].time
        if k not in ends or since < SETTLED:
            continue
        when = f"{since:.0f} s after the first sample"
        if answer is None:
            raise DataError(f"`imu` would give no tilt {when}: {problem or estimator.settling}")
        apart = angle_between(-answer.gravity, estimator.rotation @ ends[k].up)
        if apart > SAME_TILT:
            source = "fused" if sample.orientation is None else "reported"
            raise DataError(
                f"the {source} orientation, which `imu` would use, is {math.degrees(apart):.0f} degrees from the "
                f"accelerometer at rest {when}: check the axes of the IMU's driver"
            )


def _checked_turn(record: ImuRecord, upright: Phase, bowed: Phase, bias: np.ndarray, axis: np.ndarray) -> float:
    """Return the angle in rad between `axis` and the gyroscope's axis on the way down. Raises DataError."""
    way = slice(upright.samples.stop, bowed.samples.start + 1)
    rate, step = record.angular_velocity[way] - bias, np.gradient(record.time[way])
    bow, turned = angle_between(bowed.up, upright.up), float(np.sum(rate @ axis * step))
    low, high = ANGLE_RATIO
    if not low <= turned / bow <= high:
        raise DataError(
            f"bowing, the gyroscope turned by {math.degrees(turned):.0f} degrees and the accelerometer by "
            f"{math.degrees(bow):.0f}: check units and signs of the IMU's driver"
        )
    _, singular, axes = np.linalg.svd(rate * np.sqrt(step)[:, None], full_matrices=False)
    wobble = float(np.hypot(*singular[1:]) / np.linalg.norm(singular))
    off_axis = angle_between(axes[0] * np.sign(axes[0] @ axis), axis)
    if wobble > MAX_WOBBLE or off_axis > MAX_OFF_AXIS:
        raise DataError(
            f"the bow was not about one axis ({math.degrees(off_axis):.0f} degrees off, {wobble:.0%} about others): "
            "bow straight ahead, without leaning or turning"
        )
    return off_axis


def six_rests(record: ImuRecord) -> tuple[np.ndarray, np.ndarray, float]:
    """Return scale (3,) and bias (3,) m/s^2 of the accelerometer from six or more rests, and what remains, in m/s^2.

    True is scale * (shown - bias), so that a shown^2 + b shown = 1 for a and b that follow from both: a linear fit.
    Raises DataError if there are too few sides, or if they do not determine all six numbers.
    """
    sides: list[Phase] = []
    for phase in still_phases(record):
        if all(angle_between(side.up, phase.up) > DISTINCT for side in sides):
            sides.append(phase)
    if len(sides) < RESTS:
        raise DataError(f"the IMU rested on {len(sides)} different sides, must be {RESTS}: lay it on each for 2 s")
    shown = np.array([record.acceleration[side.samples].mean(axis=0) for side in sides]) / STANDARD_GRAVITY
    fit, _, rank, _ = np.linalg.lstsq(np.hstack((shown**2, shown)), np.ones(len(shown)), rcond=1e-3)
    square, across = np.split(fit, 2)
    if rank < RESTS or np.any(square <= 0.0):
        raise DataError("the six rests do not determine the accelerometer: lay it on all six sides")
    bias = -across / (2.0 * square)
    scale = np.sqrt(square / (1.0 + square @ bias**2))
    remainder = STANDARD_GRAVITY * (np.linalg.norm(scale * (shown - bias), axis=1) - 1.0)
    return scale, STANDARD_GRAVITY * bias, float(np.sqrt(np.mean(remainder**2)))


def with_mounting(result: CalibrationResult, params: Path) -> CalibrationResult:
    """Return `result` with a better mounting of the IMU in the file `params`, if the arm's weight showed one."""
    found, arm = result.identified, result.arm
    rotation = load(params).get(NODE, {}).get(ROTATION)
    if found is None or arm is None or not rotation or not arm.compensator["use_imu"]:
        return result
    error, heading_error, turn = mounting_turn(found)
    if not 0.0 < error < LARGEST_ERROR:
        return result
    is_whole = heading_error < LARGEST_HEADING_ERROR
    in_trunk = turn_in_trunk(model_of(arm), arm.side, turn)
    angle, quaternion = math.degrees(float(np.linalg.norm(turn))), turned(rotation, in_trunk)
    heading = f"heading ±{math.degrees(heading_error):.2f}" if is_whole else "heading unchanged"
    accuracy = f"±{math.degrees(error):.2f} degrees, {heading}"
    note = f"{accuracy}, from the arm's weight: {angle:.1f} degrees from the value before"
    change = Change(NODE, ROTATION, quaternion.round(6).tolist(), note)
    lines = result.lines if is_whole else (*result.lines, NO_HEADING)
    return replace(result, changes=(*result.changes, change), lines=lines)


def mounting_turn(found: Identified) -> tuple[float, float, np.ndarray]:
    """Return what the arm's weight says of the IMU's mounting.

    The standard errors in rad of the inclination and of the heading, and the turn (3,) in rad in the base frame, which
    leaves the heading as it is where it is not known well.
    """
    square, axes = np.linalg.eigh(found.tilt_covariance)  # the last is nearly gravity's own axis
    error, heading_error = math.sqrt(max(0.0, square[0] + square[1])), math.sqrt(max(0.0, square[2]))
    is_whole = heading_error < LARGEST_HEADING_ERROR
    return error, heading_error, found.value.tilt if is_whole else axes[:, :2] @ axes[:, :2].T @ found.value.tilt


def turned(rotation: Vector, turn: np.ndarray) -> np.ndarray:
    """Return the mounting `rotation`, trunk from IMU (x, y, z, w), after `turn`, a rotation vector (3,)."""
    return np.asarray((Rotation.from_rotvec(turn) * Rotation.from_quat(rotation)).as_quat())


def turn_in_trunk(model: MomentModel, side: str, turn: np.ndarray) -> np.ndarray:
    """Return a rotation vector (3,) in the base frame of a `side` arm in the trunk's axes."""
    trunk = np.array([model.down(Tilt.of_gravity(side, axis)) for axis in np.eye(3)])  # its axes in the base frame
    return np.asarray(np.linalg.det(trunk) * trunk @ turn)  # a mirror, as the right arm's, reverses rotations
