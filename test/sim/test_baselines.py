"""Controllers in place of the compensator: a PID fights the wearer and sags, a law does neither."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import Tilt, gravity_torque
from exo_gravity.core.motors.joint_motor import peaks_of
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.baselines import HELD, INTEGRAL, STIFFNESS, Controlled, Feedforward, burden

from ..support.terms_run import MOTORS_OF_ARM

POSE = (0.1, 0.9, 0.6, 0.7)
STILL = (0.0,) * 4
MOST = (9.0, 18.0, 9.0, 9.0)


def law(theta, pitch):
    return gravity_torque(DEFAULT_LINKS, theta, Tilt.of("right", pitch).direction).tolist()


def upright_law(theta, _pitch):
    return law(theta, 0.0)


def make_device():
    return SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])


@pytest.fixture(scope="module")
def burdens():
    chosen = {
        "nothing": Feedforward(None, False),
        "PID": Feedforward(None, True),
        "law": Feedforward(law, False),
        "both": Feedforward(law, True),
        "upright law": Feedforward(upright_law, False),
    }
    return {name: burden(make_device, MOTORS_OF_ARM, given, held=HELD[1:2]) for name, given in chosen.items()}


def test_a_pid_costs_the_wearer_far_more_than_an_arm_without_any_torque(burdens):
    assert burdens["PID"].effort > 5.0 * burdens["nothing"].effort > 5.0 * burdens["law"].effort
    assert burdens["both"].effort > 5.0 * burdens["law"].effort


def test_a_pid_sags_until_its_integral_carries_the_arm_and_a_law_does_not(burdens):
    assert np.degrees(burdens["nothing"].sag) > 20.0 and np.degrees(burdens["PID"].sag) > 2.0
    assert np.degrees(burdens["law"].sag) < 0.1 and np.degrees(burdens["both"].sag) < 0.1


def test_a_law_that_takes_a_bowed_trunk_for_upright_lets_the_arm_sag(burdens):
    assert np.degrees(burdens["law"].sag_bowed) < 0.1
    assert np.degrees(burdens["upright law"].sag) < 0.1 and np.degrees(burdens["upright law"].sag_bowed) > 2.0


def test_a_slow_law_keeps_the_torque_of_an_earlier_pose_until_it_has_a_new_one():
    asked = []
    slow = Controlled(Feedforward(lambda theta, _: asked.append(theta) or (theta[0], 0.0, 0.0, 0.0), False, 0.01), MOST)
    given = [slow.step(0.004 * n, (float(n), 0.0, 0.0, 0.0)).effort[0] for n in range(7)]
    assert given == [0.0, 0.0, 0.0, 3.0, 3.0, 3.0, 6.0]


def test_a_pid_pulls_towards_where_it_began_with_an_integral_that_ends_at_the_peak_torque():
    pid = Controlled(Feedforward(None, True), MOST)
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
    assert Controlled(Feedforward(lambda *_: [99.0, -99.0, 1.0, 0.0], False), peaks).step(0.0, POSE).effort == (
        peaks[0], -peaks[1], 1.0, 0.0
    )  # fmt: skip
