# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm on Damiao motors, in virtual time, on classic CAN and CAN FD: judged by what the motors did.

The events and bounds are those of arms on AK motors.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace

import pytest

from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.damiao import (
    CLEAR_ERROR,
    CTRL_MODE,
    DAMIAO_MIT,
    LOST,
    PMAX,
    REGISTERS,
    TIMEOUT,
    TMAX,
    WRITE,
)
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.hardware.can.can_port import message_of
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.motors.damiao import DamiaoMotor

from ..support.copies import prepared
from ..support.thorough import quick
from .carried_arm import (
    EVENTS,
    POSE,
    REAL_RATE,
    UNKNOWN_LOSS,
    CarriedArm,
    assert_held_and_let_down,
    assert_switched_on_and_off_without_a_collision,
    stall,
)
from .wires import Responder, motor_bus

NAMES = ("DM-J4340", "DM-J8009", "DM-J4340", "DM-J4310")
PEAK = (9.0, 18.0, 9.0, 7.0)  # Nm
LIMIT = 0.2  # s, the time-out of the motors


def joint_of(name: str, can_id: int) -> JointMotor:
    """Return a motor of any family as a parameter file describes it."""
    if name.startswith("AK"):
        return JointMotor(MOTORS[name], can_id, wire_format=MIT)
    return JointMotor(MOTORS[name], can_id, wire_format=DAMIAO_MIT, timeout=LIMIT)


def arm_of(names: tuple[str, ...] = NAMES, **options: float) -> CarriedArm:
    joints = [joint_of(name, 1 + i) for i, name in enumerate(names)]
    return CarriedArm(joints, [simulated(joint) for joint in joints], PEAK, **options)


@prepared
def raised_arm() -> CarriedArm:
    """Return an arm that the wearer has raised to `POSE` and left to the motors."""
    arm = arm_of(rate=REAL_RATE, proves_signs=False)
    arm.carry()
    arm.raise_to(POSE)
    return arm


def damiao_of(arm: CarriedArm, joint: int) -> DamiaoMotor:
    motor = arm.device.motors[joint]
    assert isinstance(motor, DamiaoMotor)
    return motor


MIXED = ("AK80-9", "DM-J8009", "DM-J4340", "AK60-6")


@pytest.mark.parametrize("names", [pytest.param(NAMES, marks=pytest.mark.thorough), MIXED], ids=["damiao", "mixed"])
def test_an_arm_is_switched_on_and_off_without_a_collision(names: tuple[str, ...]) -> None:
    assert_switched_on_and_off_without_a_collision(arm_of(names, bitrate=1_000_000))


@pytest.mark.parametrize("is_fd", quick([True], [False, True]), ids=["classic", "fd"])
def test_an_arm_is_held_and_let_down(is_fd: bool) -> None:
    arm = arm_of(is_fd=is_fd)
    listener = Responder(arm.wire)
    arm.carry()
    assert {(message.is_fd, message.bitrate_switch) for message in listener.received} == {(is_fd, is_fd)}
    arm.raise_to(POSE)
    assert_held_and_let_down(arm)


def test_a_torque_that_another_tool_left_in_the_motors_memory_is_not_carried_out() -> None:
    arm = arm_of(remembered=4.9)
    arm.carry()
    arm.assert_not_thrown()


EVENTS_HERE = {**EVENTS, "loop stalls for 300 ms": stall(0.3)}
WORST = ("motor 2 restarts in 30 ms", "loop stalls for 300 ms")


@pytest.mark.parametrize("event", quick(WORST, EVENTS_HERE))
def test_whatever_the_firmware_drops_the_motors_drive_no_joint(event: str) -> None:
    arm = raised_arm()
    arm.go_through(EVENTS_HERE[event], is_loss="stalls" not in event)
    assert arm.safety.state is State.ACTIVE or arm.safety.fault
    assert any(motor.dips for motor in arm.device.motors) == (event == "loop stalls for 300 ms")


def test_motors_that_let_go_in_a_stall_are_switched_on_again_and_lower_the_arm() -> None:
    arm = raised_arm()
    arm.clock.stall(0.3)
    assert arm.run_until(lambda: arm.device.motors[0].dips and arm.safety.fault, 0.1)
    assert arm.run_until(lambda: all(motor.entered for motor in arm.device.motors), 0.05)
    assert arm.run_until(lambda: arm.loop.is_off, 30.0)
    assert not arm.device.powered


def test_a_motor_that_lets_go_says_so_where_its_torque_is_too_small_to_tell() -> None:
    arm = raised_arm()
    assert abs(arm.device.motors[0].torque(arm.device.arm.positions[0], 0.0)) < 0.2  # Nm
    damiao_of(arm, 0).write(TIMEOUT, 20)  # 1 ms, shorter than a cycle
    assert arm.run_until(lambda: arm.safety.fault, 0.05)
    fault = arm.safety.fault
    assert fault and fault.code is FaultCode.TORQUE_NOT_DELIVERED
    assert "its motor says that it is off: communication lost: no command came for its time-out" in fault.reason


def test_a_host_that_died_leaves_motors_off_that_the_next_start_switches_on_again() -> None:
    arm = arm_of()
    for joint in range(len(NAMES)):  # a host that dies with its motors on
        motor = damiao_of(arm, joint)
        arm.device.exchange(motor.joint.command_id, ENTER)
        arm.device.exchange(*motor.joint.idle)
    arm.device.advance(1.0)
    assert [damiao_of(arm, joint).latched for joint in range(len(NAMES))] == [LOST] * len(NAMES)
    arm.carry()


def foreign(data: bytes, motor: int = 2) -> Callable[[CarriedArm], None]:
    return lambda arm: arm.wire.carry(None, message_of((motor, data)))


def push(arm: CarriedArm) -> None:
    joint = damiao_of(arm, 1).joint
    stop = arm.wire.repeat(message_of((joint.command_id, joint.command(10.0, 0.0))), 0.01)
    arm.clock.later(1.0, stop)


def write(register: int, value: float) -> Callable[[CarriedArm], None]:
    data = bytes((2, 0, WRITE, register)) + struct.pack("<f", value)
    return lambda arm: arm.wire.carry(None, message_of((REGISTERS, data)))


FOREIGN = {
    "EXIT": foreign(EXIT),
    "CLEAR_ERROR": foreign(CLEAR_ERROR),
    "EXIT of another mode": foreign(EXIT, 0x202),
    "a torque, 100 times a second": push,
    "another range": write(PMAX, 12.6),
}


@pytest.mark.parametrize("command", quick(("a torque, 100 times a second",), FOREIGN))
def test_a_foreign_command_is_answered_and_lets_the_arm_down(command: str) -> None:
    arm = raised_arm()
    FOREIGN[command](arm)
    arm.run_until(lambda: arm.loop.is_off, 30.0)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.FOREIGN_COMMAND
    arm.assert_not_thrown(*UNKNOWN_LOSS)
    assert not arm.device.powered


SET_OTHERWISE = [
    (TMAX, 10.0, "its TMAX (register 23) is 10, must be 54, or torque_range 10 in the file"),
    (TIMEOUT, 0.0, "its TIMEOUT (register 9) is 0, must be 4000"),
    (CTRL_MODE, 2.0, "its CTRL_MODE (register 10) is 2, must be 1"),
]


@pytest.mark.parametrize(("register", "value", "sentence"), quick(SET_OTHERWISE[:1], SET_OTHERWISE))
def test_a_motor_that_is_set_otherwise_than_the_file_says_is_not_switched_on(
    register: int, value: float, sentence: str
) -> None:
    arm = arm_of()
    damiao_of(arm, 1).write(register, value)
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert f"motor 2 to be set right: {sentence}" in arm.safety.refusal
    assert not arm.device.powered and not arm.caused.energy


@pytest.mark.thorough
def test_a_motor_that_is_set_otherwise_after_it_was_asked_is_found_out_before_the_start() -> None:
    arm = arm_of()
    arm.run(1.0)
    arm.enable()
    arm.run(0.3)
    damiao_of(arm, 1).write(TMAX, 10.0)
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert "TMAX" in arm.safety.refusal and not arm.device.powered


def test_a_motor_with_an_error_is_never_switched_on_again() -> None:
    arm = raised_arm()
    arm.device.motors[1].error = 0xA
    arm.run(4.0)
    fault = arm.safety.fault
    assert fault and fault.code is FaultCode.MOTOR_ERROR and "error 10 (over-current)" in fault.reason
    assert not arm.device.motors[1].entered
    arm.assert_not_thrown(*UNKNOWN_LOSS)


def test_an_error_that_has_passed_is_forgotten_once_the_operator_clears_the_fault() -> None:
    arm = raised_arm()
    motor = damiao_of(arm, 1)
    motor.error = 0xB
    assert arm.run_until(lambda: arm.loop.is_off, 30.0)
    motor.error = 0
    arm.run(1.0)
    assert motor.latched == 0xB
    assert arm.safety.clear(arm.now)
    arm.carry()  # at once: the last reply still shows the error
    assert motor.latched == 0 and motor.entered


def test_the_replies_of_a_motor_with_another_master_id_are_named() -> None:
    arm = arm_of()
    joints = [replace(joint_of(name, 1 + i), master_id=0x20 + i if i == 1 else 0) for i, name in enumerate(NAMES)]
    bus = motor_bus(arm.wire, joints)
    bus.listen()
    arm.run(0.1)
    assert bus.boards.hindrance(arm.now, 250.0) == ""
    bus.receive_until(arm.now + 0.01)
    sentence = bus.boards.hindrance(arm.now, 250.0)
    assert sentence == "motor 2 replies with the ID 18: set master_id = 18, or 33 on the motor"
