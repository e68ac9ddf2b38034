# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What people do with an IMU on their trunk: walk, bow, lean, turn, sit down, jump up, clap, nod; in random order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .imu_faults import STILL_TIME, G, Motion

FROM_HIPS = ((0.1, 0.0, 0.35), (-0.1, 0.05, 0.5), (0.0, 0.15, 0.5))  # m, of the IMU: on the breastbone, back, shoulder
GYROSCOPE_SPAN = 0.002  # s over which it averages
NEAR = 1e-3  # s between positions that give an acceleration
ROLL, PITCH, YAW, AHEAD, LEFT, UP = np.eye(6)
STRIDE = 2.0 * np.pi * 0.95  # rad/s
SHAKES = {  # amplitudes of roll, pitch, yaw (rad) and of the hips' acceleration (m/s^2), and rad/s
    "clap": ((0.0, 0.01, 0.0, 0.5, 0.5, 0.3), 2.0 * np.pi * 3.0),
    "nod": ((0.0, 0.05, 0.0, 0.2, 0.0, 0.0), 2.0 * np.pi * 1.5),
}


@dataclass(frozen=True)
class Step:
    """A turn and a shift by `change` (6,): roll, pitch, yaw in rad, hips ahead, left, up in m, with minimum jerk."""

    start: float
    duration: float
    change: np.ndarray


@dataclass(frozen=True)
class Shake:
    """Walking, clapping or nodding."""

    kind: str
    start: float
    duration: float


def bows(angle: float, over: float, walk: float) -> list[Step | Shake]:
    """Return a walk of `walk` s, and right after it a bow by `angle` rad in `over` s, and back."""
    begin = STILL_TIME + walk
    bow = Step(begin, over, angle * PITCH)
    return [Shake("walk", STILL_TIME, walk), bow, Step(begin + over + 1.0, over, -angle * PITCH)]


def day(seed: int, duration: float) -> list[Step | Shake]:
    """Return motions in random order, some of them at the same time."""
    random, at = np.random.default_rng(seed), STILL_TIME
    parts: list[Step | Shake] = []
    while at < duration:
        kind = random.choice(("bow", "bow", "lean", "turn", "sit", "jump", "walk", "clap", "nod"))
        over, length = random.uniform(0.6, 2.0), random.uniform(2.0, 10.0)
        if kind in {"clap", "nod", "walk"}:
            parts.append(Shake(kind, at, length))
            over = length if random.random() < 0.7 else 0.0  # or the next one at the same time
        elif kind == "sit":
            parts += [Step(at, 0.8, 0.6 * PITCH - 0.3 * AHEAD), Step(at + 0.5, 0.6, -0.4 * UP)]
            parts += [Shake("impact", at + 1.0, 0.1), Step(at + 1.1, 0.8, -0.6 * PITCH)]
            over = 1.9
        elif kind == "jump":
            parts += [Step(at, 0.6, 0.6 * PITCH), Step(at + 0.4, 0.6, 0.4 * UP + 0.3 * AHEAD)]
            parts.append(Step(at + 0.6, 0.6, -0.6 * PITCH))
            over = 1.2
        else:
            if kind == "turn":
                over = max(over, 0.8)
            size = {"bow": (0.2, 1.2), "lean": (-0.4, 0.4), "turn": (-3.0, 3.0)}[kind]
            change = random.uniform(*size) * {"bow": PITCH, "lean": ROLL, "turn": YAW}[kind]
            parts.append(Step(at, over, change))
            if kind != "turn":
                hold = random.choice((0.0, random.uniform(0.0, 3.0)))
                parts.append(Step(at + over + hold, over, -change))
                over = 2.0 * over + hold
        at += over + random.choice((0.0, random.uniform(0.0, 2.0)))
    return parts


def worn(parts: list[Step | Shake], duration: float, rate: float, seed: int = 0) -> Motion:
    """Return the samples of an IMU at `rate` Hz on the trunk of a person who does `parts`."""
    times = np.arange(round(duration * rate)) / rate
    random = np.random.default_rng(seed)
    place = np.array(FROM_HIPS[seed % len(FROM_HIPS)])
    turned, pushed = [], np.zeros((len(times), 3))
    places = []
    for shift in (-GYROSCOPE_SPAN, -NEAR, 0.0, NEAR):
        pose, push = _pose(parts, times + shift)
        rotation = Rotation.from_euler("ZYX", pose[:, [2, 1, 0]])
        turned.append(rotation)
        places.append(pose[:, 3:] + rotation.apply(place))
        pushed = push if shift == 0.0 else pushed
    moves = (places[1] - 2.0 * places[2] + places[3]) / NEAR**2
    now = turned[2]
    gyroscope = (turned[0].inv() * now).as_rotvec() / GYROSCOPE_SPAN
    gyroscope += random.normal(0.0, 0.003, 3) + random.normal(0.0, 0.002, gyroscope.shape)
    force = now.inv().apply(moves + np.array((0.0, 0.0, G))) + pushed
    force += random.normal(0.0, 0.05, 3) + random.normal(0.0, 0.03, force.shape)
    return Motion(rate, times, gyroscope, force, now.inv().apply((0.0, 0.0, -1.0)), times + 0.001)


def _pose(parts: list[Step | Shake], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose (n, 6) as in Step, and the acceleration of steps and shakes (n, 3) in the trunk's axes."""
    pose, jumps, push = np.zeros((len(times), 6)), np.zeros((len(times) + 1, 6)), np.zeros((len(times), 3))
    for part in parts:
        first, last = np.searchsorted(times, (part.start, part.start + part.duration))
        since = times[first:last] - part.start
        if isinstance(part, Step):
            s = since / part.duration
            pose[first:last] += np.outer(s**3 * (10.0 - 15.0 * s + 6.0 * s * s), part.change)
            jumps[last] += part.change
            continue
        if part.kind == "impact":
            push[first:last, 2] += 1.3 * G * np.sin(np.pi * since / part.duration)
            continue
        fade = np.clip(np.minimum(since, part.duration - since) / min(1.0, part.duration / 2.0), 0.0, 1.0)
        fade = fade**3 * (10.0 - 15.0 * fade + 6.0 * fade * fade)
        if part.kind == "walk":  # as in sim.trunk_motion
            one, two = STRIDE * since, 2.0 * STRIDE * since
            pose[first:last, 0] += 0.035 * fade * np.sin(one)
            pose[first:last, 1] += 0.017 * fade * np.sin(two)
            heel = 0.23 * np.cos(two) + 0.06 * np.cos(2.0 * two)
            push[first:last] += (G * fade * np.stack((0.14 * np.sin(two), 0.14 * np.cos(one), heel))).T
        else:
            amplitudes, speed = SHAKES[part.kind]
            wave = np.outer(fade * np.sin(speed * since), amplitudes)
            pose[first:last, :3] += wave[:, :3]
            push[first:last] += wave[:, 3:]
    return pose + np.cumsum(jumps, axis=0)[:-1], push
