"""Controllers in place of the compensator: a PID fights the wearer and sags, a law does neither."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.joint_motor import peaks_of
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.baselines import HELD, INTEGRAL, STIFFNESS, Feedforward, burden

from ..support.terms_run import MOTORS_OF_ARM

POSE = (0.1, 0.9, 0.6, 0.7)
STILL = (0.0,) * 4
MOST = (9.0, 18.0, 9.0, 9.0)


def law(theta):
    return gravity_torque(DEFAULT_LINKS, theta).tolist()


def make_device():
    return SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])


@pytest.fixture(scope="module")
def burdens():
    chosen = {"nothing": (None, False), "PID": (None, True), "law": (law, False), "both": (law, True)}
    return {name: burden(make_device, MOTORS_OF_ARM, *given, held=HELD[1:3]) for name, given in chosen.items()}


def test_a_pid_costs_the_wearer_far_more_than_an_arm_without_any_torque(burdens):
    assert burdens["PID"].effort > 5.0 * burdens["nothing"].effort > 5.0 * burdens["law"].effort
    assert burdens["both"].effort > 5.0 * burdens["law"].effort


def test_a_pid_sags_until_its_integral_carries_the_arm_and_a_law_does_not(burdens):
    assert np.degrees(burdens["nothing"].sag) > 20.0 and np.degrees(burdens["PID"].sag) > 2.0
    assert np.degrees(burdens["law"].sag) < 0.1 and np.degrees(burdens["both"].sag) < 0.1


def test_a_pid_pulls_towards_where_it_began_with_an_integral_that_ends_at_the_peak_torque():
    pid = Feedforward(None, True, MOST)
    assert pid.step(0.0, POSE, STILL).effort == STILL
    pid.step(0.5, np.subtract(POSE, 0.1).tolist(), STILL)
    effort = pid.step(1.0, np.subtract(POSE, 0.1).tolist(), STILL).effort
    assert effort == pytest.approx(0.1 * np.array(STIFFNESS) + 0.1 * np.array(INTEGRAL))
    for n in range(200):
        effort = pid.step(1.0 + n, np.subtract(POSE, 0.1).tolist(), STILL).effort
    assert effort == pytest.approx(MOST)
    for n in range(2):
        effort = pid.step(201.0 + n, np.add(POSE, 1.0).tolist(), STILL).effort
    assert max(effort) < 0.0


def test_the_torque_is_limited_to_what_the_motors_give():
    peaks = peaks_of(MOTORS_OF_ARM)[0]
    assert Feedforward(lambda theta: [99.0, -99.0, 1.0, 0.0], False, peaks).step(0.0, POSE).effort == (
        peaks[0], -peaks[1], 1.0, 0.0
    )  # fmt: skip
