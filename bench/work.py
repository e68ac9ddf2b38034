# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the tools: training the ANFIS, an offline trial against real time."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from exo_gravity.lab.anfis_training import from_gravload, train_law
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.trial.from_file import simulated_trials
from exo_gravity.sim.script import TrialScript

from .table import Row, range_of, seconds_in_turns

TRAINING_LIMIT = 10.0  # s that a user waits without concern


def measure_work(quick: bool) -> Iterator[Row]:
    """Yield the rows of the tools."""
    repeats = 3 if quick else 5
    configured = configured_arm(None, "right")
    samples = from_gravload(configured)
    (seconds,) = seconds_in_turns((lambda: train_law(samples, configured.robot, 4),), repeats)
    yield Row("ANFIS, training: limit", float(np.median(seconds)), TRAINING_LIMIT, "s", range_of(seconds))

    speeds = [length / taken for length, taken in (_offline(60.0 if quick else 300.0) for _ in range(repeats))]
    yield Row("trial offline: real time", float(np.median(speeds)), 1.0, "x", range_of(speeds), more_is_better=True)


def _offline(hold: float) -> tuple[float, float]:
    """Return the simulated length of a trial on the right arm, and its run time, in s."""
    steps = [{"move": [0.1, 0.8, 0.7, 0.6], "over": 3.0}, {"hold": hold}]
    script = TrialScript.parse({"name": "bench", "steps": steps})
    params = packaged_config("sim.yaml")
    (trial,) = simulated_trials(params, script)
    begin = time.perf_counter()
    return float(trial.run().time[-1]), time.perf_counter() - begin
