# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tracker on a single light joint, and what it takes for a vibration of a motor."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.lab.calibration.tracking import Line, Tracker, Vibration

LIGHT = 0.005  # kg m^2
RATE = 100.0  # Hz


def test_a_path_comes_to_a_joint_that_sticks_ahead_of_it() -> None:
    """It waited for the elbow, which needed 1 Nm to come back: 'a hand is on the arm'."""
    tracker, matrix = Tracker(RATE, (9.0,)), np.array([[LIGHT]])
    tracker.lines = iter([Line(np.zeros(1), np.ones(1))])
    for _ in range(100):
        tracker.step(1.0 / RATE, (0.09,), (0.0,), (0.0,), (0.0, 0.0, 1.0), matrix)
        if tracker.error[0] > 0.0:
            return
    pytest.fail(f"the joint is {tracker.error[0]:.2f} rad off")


def vibrates(speeds: list[float], rate: float) -> bool:
    """Return whether these speeds of a motor in rad/s, at `rate` Hz, are a vibration."""
    vibration = Vibration(1)
    return any(vibration.step(1.0 / rate, (speed,)).any() for speed in speeds)


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
@pytest.mark.parametrize("frequency", [28.0, 66.0, 170.0])  # Hz, of an AK80-9 on 150 Nm/rad, an AK60-6 on it, on 1,000
def test_a_rotor_that_rings_vibrates_at_any_rate(frequency: float, rate: float) -> None:
    assert vibrates((0.3 + 0.3 * np.sin(2.0 * np.pi * frequency / rate * np.arange(rate))).tolist(), rate)


def test_a_joint_that_leaves_its_friction_again_and_again_does_not_vibrate() -> None:
    assert not vibrates([*[0.0] * 40, 0.2, 0.4, 0.5, 0.3, 0.1, -0.15, -0.1, 0.0] * 20, 250.0)
