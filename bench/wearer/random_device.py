# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A random arm for tests of the identification: what a slow tour through its best poses would measure."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np

from exo_gravity.core import ArmModel, Tilt
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.moment_model import TYPICAL_MOMENTS, PapersMoments
from exo_gravity.lab.calibration.poses import next_pose
from exo_gravity.lab.moments import load_moments, regressor

LENGTH = (0.05, 0.13, 0.30, 0.30)
PAPERS = PapersMoments(ArmModel.from_moments(LENGTH, (0.0,) * 4), keeps_tilt=True)
LEANING = Tilt.of("right", 0.30, 0.25).direction  # the stand, so that joint 1 carries something
UPRIGHT = (0.0, 0.0, 1.0)
Direction = tuple[float, float, float]
Weight = tuple[float, float]
NO_WEIGHT: Weight = (0.0, 0.0)
WEIGHT: Weight = (1.0, 0.25)  # kg, m from the elbow
CODE = 30.0 / 4095.0  # Nm, one step of an AK60-6's 12-bit torque
SAMPLES = 50  # of the effort in each direction
CANDIDATES = np.radians(
    list(itertools.product((-60, -30, 0, 30, 60), (10, 40, 70, 100, 130), (-30, 0, 30, 60, 90), (0, 30, 60, 90, 120)))
)


def off_axis_of(mass: Vector, cog_y: Vector, cog_z: Vector) -> Vector:
    """Return (W, Z, Y3, Y4) in kg m; the centres of gravity lie off the links, by (4,) m along y_n and z_n."""
    return mass[0] * cog_z[0] + mass[1] * cog_y[1], np.dot(mass[1:], cog_z[1:]), mass[2] * cog_y[2], mass[3] * cog_y[3]


class Device:
    """An arm whose masses, centres of gravity, torque scales, friction and offsets are drawn at random."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        mass = np.array((0.60, 0.46, 0.61, 0.20)) * rng.uniform(0.7, 1.3, 4)
        cog = np.minimum(np.array((0.045, 0.115, 0.235, 0.13)) * rng.uniform(0.7, 1.3, 4), LENGTH)
        off_axis = off_axis_of(mass, *rng.uniform(-0.015, 0.015, (2, 4)))
        self.moments = moments_of(ArmModel(LENGTH, cog, mass, off_axis=off_axis))
        self.scale = rng.uniform(0.7, 1.3, 4)
        self.friction = rng.uniform(0.1, 0.4, 4)
        self.offset = rng.normal(0.0, 0.02, 4)

    def effort(self, theta: Vector, direction: Vector, added: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the commands (n, 4) in Nm that hold the arm without friction."""
        return regressor(theta, direction) @ (self.moments + added) / self.scale + self.offset

    def observe(
        self,
        theta: Vector,
        direction: Vector = LEANING,
        weight: Weight = NO_WEIGHT,
        added: np.ndarray | float = 0.0,
    ) -> Observation:
        """Pass the pose in both directions: current noise of 2 %, 12 bits."""
        effort = self.effort(theta, direction, load_moments(LENGTH, *weight) + added)[0]
        mean, spread = [], []
        for way in (1.0, -1.0):
            one_way = effort + way * self.friction / self.scale
            noise = self.rng.normal(size=(SAMPLES, 4)) * (0.02 * np.abs(one_way) + 0.01)
            codes = np.round((one_way + noise) / CODE) * CODE
            mean.append(codes.mean(axis=0))
            spread.append(codes.std(axis=0, ddof=1) / np.sqrt(SAMPLES))
        half = (mean[0] - mean[1]) / 2.0
        return Observation(theta, direction, (mean[0] + mean[1]) / 2.0, half, np.hypot(*spread) / 2.0, *weight)

    def tour(self, direction: Direction = LEANING, bare: int = 8, weighed: int = 4) -> list[Observation]:
        """Observe the best `bare` poses without, and the best `weighed` with the weight."""
        return [
            *(self.observe(theta, direction) for theta in best(direction, bare)),
            *(self.observe(theta, direction, WEIGHT) for theta in best(direction, weighed, WEIGHT)),
        ]


@cache
def best(direction: Direction, count: int, weight: Weight = NO_WEIGHT) -> tuple[tuple[float, ...], ...]:
    """Return the `count` best poses; with a weight on the arm, without any before."""
    moments = np.array(TYPICAL_MOMENTS) + load_moments(LENGTH, *weight)
    taken: list[tuple[float, ...]] = []
    while len(taken) < count:
        taken.append(tuple(CANDIDATES[next_pose(taken, CANDIDATES, direction, moments, PAPERS)]))
    return tuple(taken)
