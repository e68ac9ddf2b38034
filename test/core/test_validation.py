# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters of a bridge: impossible alone, impossible together, and gone."""

from __future__ import annotations

import math

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import motors_of
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, Limits, check_bridge, limits_of

from ..support.safety_run import LIMITS


def check(**given):
    values = values_of(CAN_BRIDGE, {"can.interface": "virtual", "can.channel": "arm", **given})
    check_bridge(values["rate"], motors_of(values), limits_of(values))


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"max_effort": [9.0, 18.0, 9.0, 9.0]},  # peak torque
        {"max_effort": [6.75, 18.0, 9.0, 9.0], "torque_scale": [0.75, 1.0, 1.0, 1.0]},
        {"rate": 40.0},
        {"rate": 25.0, "command_timeout": 0.08},
        {"rate": 200.0, "command_timeout": 0.01},
    ],
)
def test_consistent_parameters_are_accepted(given):
    check(**given)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"max_efort": [3.0, 9.0, 3.0, 3.0]}, "max_efort = [3.0, 9.0, 3.0, 3.0]: must be one of"),
        ({"can_id": [1, 2, 2, 4]}, "can_id = [1, 2, 2, 4]: must be 4 different IDs"),
        ({"motor": ["AK60-6", "AK80-9", "AK60-6", "AK99-9"]}, "4 strings, one of AK10-9, AK60-6"),
        (
            {"rate": 401.0, "wire_format": ["mit", "mit", "mit_v3", "mit"]},
            "at most 400 Hz: each cycle waits for a status",
        ),
        (
            {"max_effort": [18.0] * 4},
            "max_effort = [18.0, 18.0, 18.0, 18.0]: must be at most the motors' peak torque, [9.0,",
        ),
        ({"max_effort": [3.0, 18.0, 3.0, 3.0], "torque_scale": [1.0, 0.9, 1.0, 1.0]}, "peak torque, [9.0, 16.2, 9.0"),
        ({"max_effort": [6.0, 9.0, 3.0, 3.0], "torque_range": [5.0, 18.0, 15.0, 15.0]}, "peak torque, [5.0, 18.0, 9.0"),
        ({"rate": 39.0}, "rate = 39.0: must be at least 40 Hz: command_timeout = 0.05 s must span 2 periods"),
        (
            {"rate": 20.0, "command_timeout": 0.1},
            "at least 25 Hz: the watchdog's time-out = 0.08 s must span 2 periods",
        ),
    ],
)
def test_impossible_and_contradicting_parameters_are_refused_with_their_values(given, sentence):
    with pytest.raises(ParameterError) as caught:
        check(**given)
    assert sentence in str(caught.value)


def test_a_joint_that_is_off_by_a_turn_of_its_rotor_is_never_near_its_zero():
    for motor in (motor for motor in MOTORS.values() if not motor.output_encoder):
        assert motor.home_tolerance < math.pi / motor.gear_ratio
    values = values_of(CAN_BRIDGE, {"can.interface": "virtual", "can.channel": "arm", "motor": ["AK80-9"] * 4})
    assert limits_of(values).home_tolerance == (0.34,) * 4


@pytest.mark.parametrize(("rate", "timeout"), [(500.0, 0.05), (250.0, 0.05), (100.0, 0.07), (50.0, 0.1)])
def test_a_motor_is_silent_after_50_ms_or_7_cycles_up_to_100_ms(rate, timeout):
    values = values_of(CAN_BRIDGE, {"can.interface": "virtual", "can.channel": "arm", "rate": rate})
    assert limits_of(values).reply_timeout == pytest.approx(timeout)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_effort", (3.0, 9.0, 3.0)),
        ("position_max", (0.0,) * 4),
        ("driven_speed", math.inf),
        ("command_timeout", 5.0),
        ("sign_check_torque", math.nan),
        ("joint_names", ("a", "a", "b", "c")),
    ],
)
def test_an_impossible_limit_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        Limits(**{**vars(LIMITS), field: value})
    assert caught.value.name == field
