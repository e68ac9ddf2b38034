# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The protocol of the simulated motor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import unpack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, SET_ZERO, pack_command
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import Firmware, SimulatedMotor

SPEC = MOTORS["AK60-6"]
TORQUE_CODE = 2 * SPEC.torque_range / 4095


def command(position=0.0, velocity=0.0, kp=0.0, kd=0.0, torque=0.0, spec=SPEC):
    return pack_command(spec, position, velocity, kp, kd, torque)


def entered(firmware=None, **joint):
    motor = SimulatedMotor(JointMotor(**{"spec": SPEC, "can_id": 5, **joint}), firmware)
    motor.receive(ENTER, 0.0, 0.0, 0.0)
    return motor


def reply_to(motor, data, position=0.0, velocity=0.0, now=0.0):
    """Return the decoded reply to `data`."""
    return unpack_reply(motor.joint.spec, motor.receive(data, position, velocity, now))


def test_current_noise_spoils_the_replied_torque_and_not_the_torque():
    motor = entered(Firmware(current_noise=0.02))
    replied = [reply_to(motor, command(torque=5.0)).torque for _ in range(500)]
    assert np.std(replied) == pytest.approx(0.1, rel=0.2) and np.mean(replied) == pytest.approx(5.0, abs=0.02)
    assert motor.torque(0.0, 0.0) == pytest.approx(5.0, abs=TORQUE_CODE / 2)


def test_no_12_bit_code_is_exactly_zero_torque():
    motor = entered()
    motor.receive(command(torque=0.0), 0.0, 0.0, 0.0)
    assert abs(motor.torque(0.0, 0.0)) == pytest.approx(TORQUE_CODE / 2)


def test_stiffness_and_damping_act_on_the_present_joint_state():
    motor = entered()
    motor.receive(command(position=0.5, velocity=1.0, kp=4.0, kd=0.5), 0.0, 0.0, 0.0)
    for position, velocity in ((0.0, 0.0), (0.7, -2.0)):
        expected = 4.0 * (0.5 - position) + 0.5 * (1.0 - velocity)
        assert motor.torque(position, velocity) == pytest.approx(expected, rel=0.02, abs=0.02)


def test_a_reversed_motor_has_stiffness_and_damping_of_the_right_sign():
    motor = entered(direction=-1, zero=0.4)
    motor.receive(command(position=0.4, kp=4.0, kd=0.5), 0.0, 0.0, 0.0)
    assert motor.torque(0.3, 0.0) == pytest.approx(-1.2, abs=0.02)
    assert motor.torque(0.0, 2.0) == pytest.approx(-1.0, abs=0.02)


def test_a_reply_is_in_motor_coordinates():
    reply = reply_to(entered(direction=-1, zero=0.4), command(torque=1.0), position=0.3, velocity=2.0)
    assert reply.position == pytest.approx(0.1, abs=2e-4)
    assert reply.velocity == pytest.approx(-2.0, abs=0.012)
    assert reply.torque == pytest.approx(1.0, abs=TORQUE_CODE)


@pytest.mark.parametrize("scale", [0.75, 1.0, 1.2])
@pytest.mark.parametrize("commanded", [15.0, -15.0])
def test_torque_is_limited_to_the_motors_peak(commanded, scale):
    motor = entered(torque_scale=scale)
    reply = reply_to(motor, command(torque=commanded))
    assert abs(motor.torque(0.0, 0.0)) == pytest.approx(motor.joint.peak_effort)
    assert abs(reply.torque) == pytest.approx(SPEC.peak_torque, abs=TORQUE_CODE)


def test_a_wrong_firmware_range_scales_the_torque():
    motor = entered(spec=replace(SPEC, velocity_range=45.0, torque_range=9.0))
    motor.receive(command(torque=5.0), 0.0, 0.0, 0.0)
    assert motor.torque(0.0, 0.0) == pytest.approx(3.0, abs=TORQUE_CODE)


def test_set_zero_makes_the_present_angle_zero():
    motor = entered(direction=-1, zero=0.4)
    motor.receive(SET_ZERO, 0.3, 0.0, 0.0)
    assert reply_to(motor, command(), position=0.3, now=2.0).position == pytest.approx(0.0, abs=2e-4)
    assert reply_to(motor, command(), position=0.5, now=2.0).position == pytest.approx(-0.2, abs=2e-4)


@pytest.mark.parametrize(("length", "temperature", "error"), [(8, 47, 6), (6, None, None)])
def test_only_8_byte_replies_have_temperature_and_error(length, temperature, error):
    motor = entered(Firmware(reply_length=length))
    motor.temperature, motor.error = 46.6, 6
    assert len(motor.receive(command(), 0.0, 0.0, 0.0)) == length
    reply = reply_to(motor, command())
    assert (reply.temperature, reply.error) == (temperature, error)


@pytest.mark.parametrize("sign", [1, -1])
def test_readings_beyond_the_range_of_a_reply_are_clamped(sign):
    motor = entered()
    motor.temperature = 300.0
    reply = reply_to(motor, command(), position=sign * 20.0, velocity=sign * 90.0)
    assert (reply.position, reply.temperature) == (sign * SPEC.position_range, 215)
    assert reply.velocity == pytest.approx(sign * SPEC.velocity_range)


def test_an_unplugged_motor_neither_replies_nor_gives_torque_and_comes_back_with_its_zero_alone():
    motor = entered(zero=0.4)
    motor.receive(command(torque=2.0), 0.0, 0.0, 0.0)
    motor.unplugged = True
    assert motor.torque(0.0, 0.0) == 0.0
    assert motor.receive(command(torque=2.0), 0.0, 0.0, 0.0) is None
    motor.unplugged = False
    assert motor.torque(0.0, 0.0) == 0.0
    assert reply_to(motor, ENTER, position=0.1).position == pytest.approx(0.5, abs=2e-4)
    assert motor.torque(0.0, 0.0) == 0.0


def test_an_impossible_length_of_replies_is_rejected_by_name():
    with pytest.raises(ParameterError, match="reply_length"):
        Firmware(reply_length=5)
