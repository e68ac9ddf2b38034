# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The curse of dimensionality, measured: the cost of an ANFIS for joint 3 with 2 to 6 inputs.

Inputs are added in the order of `INPUTS`: shoulder flexion and elbow, then abduction, rotation, and the trunk's pitch
and sideways tilt of up to 30 degrees. The functions per input stay the same, so the rules multiply. Each model learns
the exact law at three positions per consequent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.anfis import Anfis
from exo_gravity.core.arm.gravity import gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.lab.anfis_training import rms, train
from exo_gravity.lab.inputs.arms import ConfiguredArm

INPUTS = ("theta_3", "theta_4", "theta_2", "theta_1", "pitch", "tilt")
COLUMNS = (2, 3, 1, 0, 4, 5)  # of theta_1..theta_4, pitch, tilt
TILT = math.radians(30.0)
SAMPLES = 3  # positions per consequent
HELD_OUT = 2000  # random positions
EVALUATIONS = 20  # of the premises
MANY = 2000  # consequents; beyond, one least-squares solution takes a minute, so the premises are not trained


class Growth(NamedTuple):
    """One model: its size, its training and inference time in s, and its RMSE in Nm."""

    inputs: int
    functions: int
    rules: int
    parameters: int
    positions: int
    steps: int
    training_time: float
    inference_time: float
    training_rmse: float
    held_out_rmse: float


def growth(configured: ConfiguredArm, functions: int, inputs: int) -> Growth:
    """Return cost and error of a model of joint 3 with `functions` per input and the first `inputs` of `INPUTS`."""
    consequents = functions**inputs * (inputs + 1)
    count = math.ceil((SAMPLES * consequents) ** (1 / inputs))
    positions = np.array(list(product(np.linspace(-1, 1, count), repeat=inputs)))
    evaluations = EVALUATIONS if consequents < MANY else 1
    trained = train(positions, _torque(configured, positions), functions, max_evaluations=evaluations)
    between = np.random.default_rng(0).uniform(-1, 1, (HELD_OUT, inputs))
    error = trained.model.output(between)[:, 0] - _torque(configured, between)
    model = trained.model
    return Growth(
        inputs,
        functions,
        model.rules,
        model.parameters,
        len(positions),
        trained.evaluations,
        trained.seconds,
        _inference_time(model, between),
        trained.rmse,
        float(rms(error)),
    )


def sizes() -> Iterator[tuple[int, int]]:
    """Yield (functions, inputs) of the table, for each number of functions the cheap ones first."""
    yield from product((2, 3), range(2, len(INPUTS) + 1))


def _torque(configured: ConfiguredArm, scaled: np.ndarray) -> np.ndarray:
    """Return joint 3's torque (n,) for inputs (n, d) scaled to -1..1 over the workspace; other inputs are 0."""
    low, high = np.append(configured.low, (-TILT, -TILT)), np.append(configured.high, (TILT, TILT))
    state = np.zeros((len(scaled), len(INPUTS)))
    chosen = list(COLUMNS[: scaled.shape[1]])
    state[:, chosen] = low[chosen] + (scaled + 1) / 2 * (high - low)[chosen]
    direction = np.array([Tilt.of(configured.side, pitch, roll).direction for pitch, roll in state[:, 4:].tolist()])
    return gravity_torque(configured.robot, state[:, :4], direction)[:, 2]


def _inference_time(model: Anfis, inputs: np.ndarray) -> float:
    """Return the median time in s to evaluate one pose."""
    times = []
    for pose in inputs[:500]:
        started = time.perf_counter()
        model.output(pose[None])
        times.append(time.perf_counter() - started)
    return float(np.median(times))
