# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The power of a motor whose replies say whether it is on."""

from __future__ import annotations

import pytest

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import Send
from exo_gravity.core.safety.power import MotorPower, Power, PowerChange

CYCLE = 0.004  # s


class Told:
    """A motor, and its replies; time: s."""

    def __init__(self, *changes: PowerChange) -> None:
        self.power, self.time = MotorPower(replies=True), 0.0
        for change in changes:
            self.power.change(change)

    def reply(self, on: bool | None, torque: float = 0.0) -> None:
        self.time += CYCLE
        self.power.step(CYCLE, JointSample(0.0, 0.0, torque, 30, 0, self.time, on), False)

    def send(self) -> Send:
        return self.power.send(self.time)


@pytest.mark.parametrize("change", [PowerChange.PROBED, PowerChange.TAKEN_OVER])
def test_a_motor_that_another_process_left_is_known_from_its_first_replies(change: PowerChange) -> None:
    left_on = Told(change)
    left_on.reply(True)
    assert left_on.power.state is Power.ON
    left_off = Told(change)
    for _ in range(2):
        assert not left_off.power.is_quiet
        left_off.reply(False, torque=0.5)  # what a motor that is off may report
    assert left_off.power.is_quiet and left_off.power.state is not Power.ON


def test_a_motor_has_left_once_it_says_so_and_not_before() -> None:
    motor = Told(PowerChange.SWITCH_ON, PowerChange.SHOWN_ON, PowerChange.SWITCH_OFF)
    for _ in range(20):  # it did not hear EXIT
        assert motor.send() is Send.EXIT
        motor.reply(True)
    assert motor.power.state is Power.LEAVING
    motor.send()
    motor.reply(False)
    assert motor.power.state is Power.OFF


def test_one_wrong_reply_does_not_make_a_motor_count_as_off() -> None:
    motor = Told(PowerChange.SWITCH_ON, PowerChange.SHOWN_ON)
    for on in (True, False, True, False, True):
        motor.reply(on)
        assert not motor.power.is_told_off
    motor.reply(False)
    motor.reply(False)
    assert motor.power.is_told_off


def test_silence_takes_back_what_was_told() -> None:
    motor = Told(PowerChange.SWITCH_ON, PowerChange.SHOWN_ON)
    motor.reply(False)
    motor.power.step(CYCLE, JointSample(0.0, 0.0, 0.0, 30, 0, motor.time, False), True)
    motor.reply(False)
    assert not motor.power.is_told_off
