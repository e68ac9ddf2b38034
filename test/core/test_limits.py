"""The limits that shape the torque of a carried arm."""

from __future__ import annotations

import math

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE, Limits

from ..support.safety_run import LIMITS, PERIOD, SafetyRun, reading


def test_torque_exceeds_neither_its_limit_nor_its_rate():
    arm = SafetyRun().until_active()
    arm.steps.clear()
    arm.effort = (39.0, -39.0, 39.0, -39.0)
    arm.cycle(1.0)
    assert arm.drive.effort == (3.0, -9.0, 3.0, -3.0)
    assert max(arm.steps) <= MAX_EFFORT_RATE * PERIOD * 1.0001
    assert "max_effort (b)" in arm.machine.acted


def test_a_hot_motor_gets_less_torque():
    arm = SafetyRun().until_active()
    arm.effort = (3.0, 9.0, 3.0, 3.0)
    arm.changes[1].update(temperature=75)
    arm.cycle(1.0)
    assert arm.drive.effort[1] == pytest.approx(6.75)
    assert "derating (b)" in arm.machine.acted


@pytest.mark.parametrize("rate", [20.0, 100.0, 500.0])
@pytest.mark.parametrize("inertia", [0.005, 0.03, 0.3])
@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_the_soft_wall_never_throws_a_joint_back_faster_than_it_came(rate, inertia, speed):
    """One joint without friction or gravity runs into its wall; the motor applies torque and damping at once."""
    period, limit = 1.0 / rate, LIMITS.position_max[0]
    position, velocity, torque = limit - 0.15, speed, 0.0
    for _ in range(int(4.0 * rate)):
        joints = [reading(position=position, velocity=round(velocity / 0.022) * 0.022, time=0.0)] * 4
        (torque, *_), (damping, *_), _ = LIMITS.shape((0.0,) * 4, 1.0, joints, (torque,) * 4, period)
        end = torque / damping if damping else math.inf  # rad/s, where the damping balances the torque
        if damping:
            decay = math.exp(-damping / inertia * period)
            position += end * period + (velocity - end) * (1.0 - decay) * inertia / damping
            velocity = end + (velocity - end) * decay
        else:
            position += (velocity + 0.5 * torque / inertia * period) * period
            velocity += torque / inertia * period
        assert velocity >= -speed
    assert position < limit + 6.0 * max(0.1, speed * period)


def test_a_wall_pushes_back_before_a_joint_limit():
    low, high = LIMITS.position_min[3], LIMITS.position_max[3]
    for position, sign in ((low + 0.05, 1), (high - 0.05, -1)):
        joints = [reading(position=position, time=0.0)] * 4
        shaped, damping, acted = LIMITS.shape((0.0,) * 4, 1.0, joints, (0.0,) * 4, 1.0)
        assert shaped[3] == pytest.approx(sign * 1.25)
        assert damping[3] == 5.0
        assert "soft wall (d)" in acted


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_effort", (3.0, 9.0, 3.0)),
        ("position_max", (0.0,) * 4),
        ("command_timeout", 5.0),
        ("sign_check_torque", math.nan),
        ("joint_names", ("a", "a", "b", "c")),
    ],
)
def test_an_impossible_limit_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        Limits(**{**vars(LIMITS), field: value})
    assert caught.value.name == field
