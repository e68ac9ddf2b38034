# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Letting down an arm that a dead process left with its motors on, in virtual time."""

import itertools
from dataclasses import replace

import pytest

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, MotorCommand, unpack_command
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE
from exo_gravity.hardware.can.can_port import ArmOnBus

from ..support.simulated_device import drive_of
from ..support.thorough import quick
from .rig import LIMITS, MOTORS_OF_ARM, VirtualRig
from .simulated_rig import PERIOD
from .wires import Responder


def commands(listener: Responder, can_id: int) -> list[MotorCommand]:
    """Return the commands to motor `can_id` so far, without ENTER and EXIT."""
    frames = [bytes(message.data) for message in listener.received if message.arbitration_id == can_id]
    spec = MOTORS_OF_ARM[can_id - 1].spec
    return [unpack_command(spec, data) for data in frames if data[0] != can_id and data not in (ENTER, EXIT)]


def test_the_arm_is_lowered_from_the_noted_torques_and_its_motors_are_switched_off():
    rig = VirtualRig()
    rig.arm = replace(rig.arm, period=PERIOD)
    listener = Responder(rig.wire)
    assert rig.let_down()
    torques = [command.torque for command in commands(listener, 2)]
    assert torques[0] == pytest.approx(rig.carrying[1], abs=0.02)
    largest = max(abs(after - before) for before, after in itertools.pairwise(torques))
    assert largest <= MAX_EFFORT_RATE * PERIOD + 2 * MOTORS["AK80-9"].torque_range / 4095
    assert not rig.notes.drive.powered
    rig.assert_let_down()


def test_the_noted_damping_is_kept():
    rig = VirtualRig()
    listener = Responder(rig.wire)
    assert rig.let_down(drive_of(rig.carrying, (5.0,) * 4))
    assert min(command.kd for command in commands(listener, 2)[:50]) == pytest.approx(5.0, abs=0.01)


def test_a_motor_that_has_lost_its_power_is_not_pushed_by_the_noted_torque():
    """The operator cut the supply: the motors are off, and the arm hangs."""
    rig = VirtualRig(pose=NO_TORQUE, carried=False)
    assert rig.let_down(drive_of((0.0, 6.0, 2.0, 1.0)))
    assert rig.top_speed < 0.01
    assert rig.motors_on == [False] * 4


@pytest.mark.parametrize("is_adapter", quick([True], [False, True]), ids=["a motor", "the adapter"])
def test_an_arm_that_is_reached_again_late_is_let_down(is_adapter):
    rig, log = VirtualRig(), []
    start = rig.clock.monotonic()

    def lose() -> None:
        rig.wire.refusal = BusError("no such device")
        rig.wire.break_down(OSError("no such device"))

    if is_adapter:
        rig.clock.later(0.1, lose)
        rig.clock.later(14.0, lambda: setattr(rig.wire, "refusal", None))
    else:
        rig.device.cut_off = (False, True, False, False)
        rig.clock.later(14.0, lambda: setattr(rig.device, "cut_off", (False,) * 4))
    assert rig.let_down(log=log.append)
    assert log == ["a motor does not reply; it may still be powered; trying again"]
    assert rig.clock.monotonic() > start + 14.0
    rig.assert_let_down()


def test_a_bus_that_cannot_be_opened_is_tried_again_and_the_log_is_honest():
    rig, log = VirtualRig(), []
    rig.wire.refusal = BusError("CAN bus can0 cannot be opened")
    rig.clock.later(1.0, lambda: setattr(rig.wire, "refusal", None))
    assert rig.let_down(log=log.append)
    assert log == ["CAN bus can0 cannot be opened; the motors may still be powered"]
    rig.assert_let_down()


def test_a_single_attempt_at_a_bus_that_cannot_be_opened_fails_with_the_reason():
    rig, log = VirtualRig(), []
    rig.arm = ArmOnBus(("no_such_interface", "x", {}), MOTORS_OF_ARM, LIMITS, PERIOD)
    assert not rig.let_down(log=log.append, is_wanted=True)
    assert "CAN bus no_such_interface x" in log[0]
