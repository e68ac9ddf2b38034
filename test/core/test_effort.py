"""A wearer's effort, from torques and speeds that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.effort import effort_of

RATE = 250.0


def swept(joint: int, inertia: float, coulomb: float, viscous: float) -> tuple[np.ndarray, np.ndarray]:
    """Return torque and speed (n, 4) of a joint of known properties that swings at 0.3 and at 1.2 Hz."""
    time = np.arange(0.0, 20.0, 1.0 / RATE)
    speed, torque = np.zeros((len(time), 4)), np.zeros((len(time), 4))
    slow, fast = 2.0 * math.pi * 0.3, 2.0 * math.pi * 1.2
    speed[:, joint] = np.cos(slow * time) + 0.7 * np.cos(fast * time)
    acceleration = -slow * np.sin(slow * time) - 0.7 * fast * np.sin(fast * time)
    torque[:, joint] = inertia * acceleration + coulomb * np.sign(speed[:, joint]) + viscous * speed[:, joint] + 0.4
    return torque, speed


@pytest.mark.parametrize(("inertia", "coulomb", "viscous"), [(0.3, 0.4, 0.05), (0.02, 0.2, 0.3), (0.5, 0.0, 0.0)])
def test_a_sweep_shows_the_inertia_and_friction_that_the_wearer_feels(inertia, coulomb, viscous):
    felt = effort_of(*swept(1, inertia, coulomb, viscous), RATE, 1).felt
    assert felt == pytest.approx((inertia, coulomb, viscous), abs=0.01)


def test_rms_peak_work_and_jerk_of_a_known_motion():
    time = np.arange(0.0, 10.0, 1.0 / RATE)
    swing = 2.0 * math.pi
    speed = np.outer(np.sin(swing * time), (1.0, 0.0, 0.0, 0.0))
    torque = np.add(2.0 * speed, (0.0, 3.0, 0.0, 0.0))
    effort = effort_of(torque, speed, RATE)
    assert effort.rms == pytest.approx((math.sqrt(2.0), 3.0, 0.0, 0.0))
    assert effort.total == pytest.approx(math.sqrt(11.0))
    assert effort.peak == pytest.approx((2.0, 3.0, 0.0, 0.0), abs=1e-3)
    assert effort.work == pytest.approx(1.0, rel=1e-3)  # W: 2 sin^2 on average
    assert effort.jerk == pytest.approx(swing**2 / math.sqrt(2.0), rel=0.02)
    assert effort.felt is None


def test_work_that_the_arm_does_on_the_wearer_is_not_credited():
    speed = np.tile((1.0, 0.0, 0.0, 0.0), (500, 1))
    assert effort_of(-speed, speed, RATE).work == 0.0
