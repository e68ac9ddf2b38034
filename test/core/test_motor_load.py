"""The load of the motors over minutes."""

import math

import pytest

from exo_gravity.core.safety.delivery import THERMAL_TIME, MotorLoad
from exo_gravity.core.safety.limits import UNKNOWN, JointSample


def sample(effort: float, velocity: float = 0.0) -> JointSample:
    return JointSample(0.0, velocity, effort, 30, 0, 0.0)


def load_after(seconds: float, step: float, torque: float) -> MotorLoad:
    load = MotorLoad((3.0, 9.0))
    for number in range(round(seconds / step) + 1):
        load.update(number * step, (sample(torque), UNKNOWN))
    return load


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_constant_torque_warms_a_cold_motor_exponentially_whatever_the_period(step):
    rms, other = load_after(THERMAL_TIME, step, 6.0).rms
    assert rms == pytest.approx(6.0 * math.sqrt(1.0 - math.exp(-1.0)), rel=1e-9)
    assert other == 0.0


def test_a_torque_above_rated_counts_as_overload_only_when_it_lasts():
    assert load_after(5.0, 0.1, 6.0).share[0] < 1.0
    assert load_after(60.0, 0.1, 6.0).share[0] > 1.0
    assert load_after(600.0, 0.1, 2.9).share[0] < 1.0


def test_power_is_torque_times_speed_and_negative_where_the_motor_brakes():
    load = MotorLoad((3.0, 9.0, 3.0))
    load.update(1.0, (sample(2.0, 3.0), sample(-2.0, 3.0), UNKNOWN))
    assert load.power == (6.0, -6.0, 0.0)
