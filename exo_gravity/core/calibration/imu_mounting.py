"""How an IMU is mounted on the trunk: from standing upright, bowing, and standing upright again.

Upright, the accelerometer shows the trunk's z axis (up). Between upright and bowed the trunk turns about its y axis, so
gravity moves in the plane across it: y is along bowed x upright. The gyroscope's axis and angle must agree. Posture
limits the result: no person stands upright, or bows straight ahead, to better than a degree. Several bows average.

Six rests of the IMU on different sides show the accelerometer's scale and bias: in each it must show one g.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.tilt import angle_between

BLOCK = 0.25  # s
STILL_RATE = 0.06  # rad/s; a person who stands still sways at 0.02
STILL_ACCELERATION = 0.4  # m/s^2
MIN_STILL = 1.0  # s
UPRIGHT = math.radians(8.0)  # within which two phases are the same posture
MIN_BOW = math.radians(20.0)
MAX_OFF_AXIS = math.radians(10.0)  # between the axes that gyroscope and accelerometer show
MAX_WOBBLE = 0.35  # of the rotation, about other axes than its main one
ANGLE_RATIO = (0.8, 1.25)  # of the gyroscope's angle to the accelerometer's
POSTURE = math.radians(1.0)  # assumed error of a person's upright posture, and of the bow's direction
SENSOR = 5e-3  # rad: 5 mg, the bias of a calibrated accelerometer
ONE_G = (0.9, 1.1)  # of the accelerometer at rest
RESTS = 6
DISTINCT = math.radians(30.0)  # between two rests on different sides


class ImuRecord(NamedTuple):
    """Samples in the IMU's axes."""

    time: np.ndarray  #: (n,) s
    angular_velocity: np.ndarray  #: (n, 3) rad/s
    acceleration: np.ndarray  #: (n, 3) m/s^2


class Mounting(NamedTuple):
    """How an IMU is mounted on the trunk."""

    quaternion: np.ndarray  #: trunk from IMU, (x, y, z, w)
    error: np.ndarray  #: (3,) rad, standard error about the trunk's x, y and z
    bow: float  #: rad, the deepest
    bows: int  #: how many


class AccelerometerFit(NamedTuple):
    """An accelerometer's scale and bias: true = scale * (shown - bias)."""

    scale: np.ndarray  #: (3,)
    bias: np.ndarray  #: (3,) m/s^2
    residual: float  #: m/s^2, RMS of the rests' magnitude


class _Phase(NamedTuple):
    first: int
    beyond: int
    up: np.ndarray  # (3,) unit vector


def mounting(record: ImuRecord) -> Mounting:
    """Return the mounting that a record of standing, bowing and standing, once or several times, shows.

    Raises DataError, which says what to do, if there are no still phases upright, bowed and upright; if the bow is too
    small or not about one axis; or if gyroscope and accelerometer contradict each other.
    """
    phases = still_phases(record)
    if not phases:
        raise DataError("the IMU was never still for 1 s: stand still, bow, keep still, and stand upright again")
    upright = phases[0]
    bowed = max(phases, key=lambda phase: angle_between(phase.up, upright.up))
    bow = angle_between(bowed.up, upright.up)
    if bow < MIN_BOW:
        angle, limit = math.degrees(bow), math.degrees(MIN_BOW)
        raise DataError(
            f"the bow was {angle:.0f} degrees, must be {limit:.0f} or more: bow farther, and stay there for 2 s"
        )
    standing = [phase for phase in phases if angle_between(phase.up, upright.up) < UPRIGHT]
    if standing[-1].first < bowed.first:
        raise DataError("the record must begin and end upright: stand for 2 s before the bow and after it")
    others = [phase.up for phase in standing]
    z = _unit(np.mean(others, axis=0))
    bows = _bows(phases, standing)
    axes = [_unit(np.cross(lowest.up, z)) for _, lowest in bows]
    y = _unit(np.mean(axes, axis=0))
    resting = np.concatenate([record.angular_velocity[phase.first : phase.beyond] for phase in phases])
    bias = resting.mean(axis=0)
    off_axis = [
        _check_turn(record, *pair, bias, axis, angle_between(pair[1].up, pair[0].up))
        for pair, axis in zip(bows, axes, strict=True)
    ]
    level = math.hypot(SENSOR, max(POSTURE, *(angle_between(up, z) for up in others)))
    sideways = level / math.sin(min(bow, math.pi / 2)), float(np.mean(off_axis)) / 2.0
    heading = max(level, math.hypot(*sideways) / math.sqrt(len(bows)))
    rotation = np.stack((np.cross(y, z), y, z))
    return Mounting(_quaternion(rotation), np.array((level, level, heading)), bow, len(bows))


def _bows(phases: Sequence[_Phase], standing: Sequence[_Phase]) -> list[tuple[_Phase, _Phase]]:
    """Return the upright phase before each bow, and the lowest phase of the bow."""
    bows = []
    for before, after in pairwise(standing):
        between = [phase for phase in phases if before.first < phase.first < after.first]
        lowest = max(between, key=lambda phase: angle_between(phase.up, before.up), default=before)
        if angle_between(lowest.up, before.up) >= MIN_BOW:
            bows.append((before, lowest))
    return bows


def _check_turn(
    record: ImuRecord, upright: _Phase, bowed: _Phase, bias: np.ndarray, axis: np.ndarray, bow: float
) -> float:
    """Return the angle in rad between `axis` and the gyroscope's axis on the way down. Raises DataError."""
    way = slice(upright.beyond, bowed.first + 1)
    rate = record.angular_velocity[way] - bias
    step = np.gradient(record.time[way])
    turned = float(np.sum(rate @ axis * step))
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


def six_rests(record: ImuRecord, gravity: float = STANDARD_GRAVITY) -> AccelerometerFit:
    """Return scale and bias of the accelerometer from six or more rests on different sides.

    Raises DataError if there are too few, or if they do not determine all six numbers.
    """
    means: list[np.ndarray] = []
    for phase in still_phases(record):
        if all(angle_between(_unit(mean), phase.up) > DISTINCT for mean in means):
            means.append(record.acceleration[phase.first : phase.beyond].mean(axis=0))
    if len(means) < RESTS:
        raise DataError(f"the IMU rested on {len(means)} different sides, must be {RESTS}: lay it on each for 2 s")
    rests = np.array(means)
    scale, bias = np.ones(3), np.zeros(3)
    for _ in range(20):
        true = scale * (rests - bias)
        norm = np.linalg.norm(true, axis=1)
        direction = true / norm[:, None]
        jacobian = np.hstack((direction * (rests - bias), -direction * scale))
        step, _, rank, _ = np.linalg.lstsq(jacobian, gravity - norm, rcond=1e-3)
        if rank < RESTS:
            raise DataError("the six rests do not determine the accelerometer: lay it on all six sides")
        scale, bias = scale + step[:3], bias + step[3:]
    residual = np.linalg.norm(scale * (rests - bias), axis=1) - gravity
    return AccelerometerFit(scale, bias, float(np.sqrt(np.mean(residual**2))))


def still_phases(record: ImuRecord) -> list[_Phase]:
    """Return the phases of a second or more in which the IMU neither turned nor accelerated, in order.

    Raises DataError if the samples are too few or not finite, or if the accelerometer does not show one g at rest.
    """
    time, rate, force = record
    if len(time) < 10 or not all(np.all(np.isfinite(values)) for values in record):
        raise DataError(f"{len(time)} IMU samples, must be 10 or more, all finite")
    edges = np.searchsorted(time, np.arange(time[0], time[-1], BLOCK))
    edges = np.append(edges[np.append(np.diff(edges) > 0, True)], len(time))
    quiet = []
    median = np.median(rate, axis=0)
    for first, beyond in pairwise(edges):
        turning = np.linalg.norm(rate[first:beyond].mean(axis=0) - median)
        shaking = np.max(np.linalg.norm(force[first:beyond] - force[first:beyond].mean(axis=0), axis=1))
        quiet.append(turning < STILL_RATE and shaking < STILL_ACCELERATION)
    changes = np.flatnonzero(np.diff(np.concatenate(([False], quiet, [False])).astype(int)))
    phases = []
    for begin, end in zip(changes[::2], changes[1::2], strict=True):
        start, stop = int(edges[begin]), int(edges[end])
        if time[stop - 1] - time[start] < MIN_STILL - BLOCK:
            continue
        mean = force[start:stop].mean(axis=0)
        share = float(np.linalg.norm(mean)) / STANDARD_GRAVITY
        if not ONE_G[0] <= share <= ONE_G[1]:
            raise DataError(f"at rest the accelerometer shows {share:.2f} g, must be 1: check its unit (m/s^2)")
        phases.append(_Phase(start, stop, _unit(mean)))
    return phases


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation matrix: an eigenvector (Bar-Itzhack 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = np.array(
        (
            (xx - yy - zz, xy + yx, xz + zx, zy - yz),
            (xy + yx, yy - xx - zz, yz + zy, xz - zx),
            (xz + zx, yz + zy, zz - xx - yy, yx - xy),
            (zy - yz, xz - zx, yx - xy, xx + yy + zz),
        )
    )
    quaternion = np.linalg.eigh(matrix)[1][:, -1]
    return np.asarray(quaternion if quaternion[3] >= 0.0 else -quaternion)
