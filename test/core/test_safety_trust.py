"""What a carried arm trusts: that its motors deliver their torque, and that its zeros and signs are still right."""

from __future__ import annotations

import math
import random

import pytest

from exo_gravity.core.safety.drive import FaultCode, State

from ..support.safety_run import SafetyRun


def assert_a_wrong_angle_is_refused(arm):
    """The encoder of an arm that is off is wrong by a turn of the motor: the arm is not carried."""
    arm.changes[1].update(position=math.radians(40.0))  # one turn of an AK80-9's motor
    arm.cycle()
    arm.enable().cycle(1.0)
    assert arm.fault_code == "implausible_zero"


def test_a_motor_that_is_found_off_is_switched_on_again_with_the_torque_that_held_the_arm():
    arm = SafetyRun().until_active()
    arm.off.add(1)
    arm.steps.clear()
    since = arm.now
    while not any(arm.drive.enter):
        arm.cycle()
    assert arm.now - since <= 0.06
    assert arm.drive.enter == (False, True, False, False)
    assert arm.fault_code == "torque_not_delivered"
    assert "b: -4.00 Nm commanded" in arm.machine.fault.reason
    assert arm.drive.effort[1] < -3.0


@pytest.mark.parametrize("doubt", ["position_jump", "motor_error", "outside_limits", "torque_not_delivered"])
def test_after_a_fault_that_casts_doubt_on_them_zeros_are_checked_again(doubt):
    arm = SafetyRun().until_active()
    arm.machine.trip(FaultCode(doubt), "test", arm.now)
    arm.cycle(10.0)
    assert arm.machine.clear(arm.now)
    assert_a_wrong_angle_is_refused(arm)


def test_an_angle_that_jumps_while_the_arm_is_off_is_no_longer_trusted():
    arm = SafetyRun().until_active()
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    assert_a_wrong_angle_is_refused(arm)


def test_a_motor_that_does_not_switch_on_is_refused_at_every_start():
    arm = SafetyRun().until_active()
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.off.add(3)
    arm.enable().cycle(1.6)
    assert arm.fault_code == "torque_not_delivered"
    assert "d: the motor did not switch on" in arm.machine.fault.reason


def test_noise_of_the_current_sensors_is_no_fault():
    arm = SafetyRun().until_active()
    dice = random.Random(3)
    for _ in range(5_000):  # 20 s
        for i, torque in enumerate(arm.applied):
            arm.changes[i] = {"effort": torque * dice.gauss(1.0, 0.05) + dice.gauss(0.0, 0.12)}
        arm.cycle()
    assert arm.machine.state is State.ACTIVE
