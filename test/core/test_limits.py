"""The limits that shape the torque of a carried arm."""

from __future__ import annotations

import math

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.limits import Limits

from ..support.safety_run import LIMITS, PERIOD, SafetyRun, reading


def test_torque_exceeds_neither_its_limit_nor_its_rate():
    arm = SafetyRun().until_active()
    arm.steps.clear()
    arm.effort = (39.0, -39.0, 39.0, -39.0)
    arm.cycle(1.0)
    assert arm.drive.effort == (3.0, -9.0, 3.0, -3.0)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD * 1.0001
    assert "max_effort (b)" in arm.machine.acted


def test_a_hot_motor_gets_less_torque():
    arm = SafetyRun().until_active()
    arm.effort = (3.0, 9.0, 3.0, 3.0)
    arm.changes[1].update(temperature=75)
    arm.cycle(1.0)
    assert arm.drive.effort[1] == pytest.approx(6.75)
    assert "derating (b)" in arm.machine.acted


def test_a_soft_wall_pushes_the_joint_back_from_its_limit():
    low, high = LIMITS.position_min[3], LIMITS.position_max[3]
    for position, sign in ((low + 0.05, 1), (high - 0.05, -1)):
        shaped, acted = LIMITS.shape(
            (0.0,) * 4, 1.0, [reading(position=position, time=0.0)] * 4, (sign * 2.5,) * 4, 1.0
        )
        assert shaped[3] == pytest.approx(sign * 2.5)
        assert "soft wall (d)" in acted


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_effort", (3.0, 9.0, 3.0)),
        ("max_velocity", (0.0,) * 4),
        ("position_max", (0.0,) * 4),
        ("command_timeout", 5.0),
        ("fade_time", 0.0),
        ("damping", math.nan),
        ("joint_names", ("a", "a", "b", "c")),
    ],
)
def test_an_impossible_limit_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        Limits(**{**vars(LIMITS), field: value})
    assert caught.value.name == field
