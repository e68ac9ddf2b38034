# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms on the motors of each firmware and family, in virtual time: judged by what the motors did, by the same bounds.

The boards of AK motors, Damiao motors on classic CAN and CAN FD, both on one bus, and arms that ship with the package.
At the start, signs are proven slowly, and exchanged IDs are found; elastic joints are carried.
"""

from __future__ import annotations

import itertools
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.motors.ak import MIT, USUAL_MOTORS
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
from exo_gravity.core.motors.families import FORMATS, MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.hardware.can.can_port import message_of
from exo_gravity.sim.events import ACTS
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.motors.damiao import DamiaoMotor
from exo_gravity.sim.motors.firmware import FIRMWARES, Firmware

from ..support.copies import prepared
from ..support.simulated_device import joints_of
from ..support.thorough import quick
from .carried_arm import (
    DRIVEN,
    ENERGY,
    EVENTS,
    PEAK,
    POSE,
    REAL_RATE,
    UNKNOWN_LOSS,
    CarriedArm,
    JudgedArm,
    ShippedArm,
    assert_held_and_let_down,
    assert_switched_on_and_off_without_a_collision,
    cut,
)
from .wires import Responder, motor_bus

DAMIAO_PEAK = (9.0, 18.0, 9.0, 7.0)  # Nm
LIMIT = 0.2  # s, the time-out of the Damiao motors
BY_NAME = {
    "damiao": ("DM-J4340", "DM-J8009", "DM-J4340", "DM-J4310"),
    "mixed": ("AK80-9", "DM-J8009", "DM-J4340", "AK60-6"),
}
POSES = {"elbow": [1.0], "seven_joints": [0.4, 0.3, 0.1, 0.6, 0.1, 0.2, -0.1]}  # rad, of arms that ship
REPLYING = [name for name in FIRMWARES if name != "v3_query"]
# The farthest from the boards of other tests: its time-out, and who asks for a reply.
FARTHEST = "v3_2"


def board(firmware: Firmware, name: str, can_id: int) -> JointMotor:
    """Return the motor as a parameter file for this firmware describes it."""
    wire_format = FORMATS[firmware.wire_format or MIT.name]
    own = {"position_range": firmware.position_range, "torque_per_ampere": firmware.torque_per_ampere.get(name)}
    spec = replace(wire_format.ranged(MOTORS[name]), **{field: value for field, value in own.items() if value})
    return JointMotor(spec, can_id, wire_format=wire_format)


def joint_of(name: str, can_id: int) -> JointMotor:
    """Return a motor of any family as a parameter file describes it."""
    if name.startswith("AK"):
        return JointMotor(MOTORS[name], can_id, wire_format=MIT)
    return JointMotor(MOTORS[name], can_id, wire_format=DAMIAO_MIT, timeout=LIMIT)


def arm_of(kind: str, **options: float) -> CarriedArm:
    """Return the paper's arm on the motors of a firmware, or on those of `BY_NAME`."""
    if kind in BY_NAME:
        joints = [joint_of(name, number) for number, name in enumerate(BY_NAME[kind], 1)]
        return CarriedArm(joints, [simulated(joint) for joint in joints], DAMIAO_PEAK, **options)
    firmware = replace(FIRMWARES[kind], status_rate=500.0)  # as docs/wiring.md asks for
    joints = [board(firmware, name, number) for number, name in enumerate(USUAL_MOTORS, 1)]
    return CarriedArm(joints, [SimulatedMotor(joint, firmware) for joint in joints], PEAK, **options)


@prepared
def raised_arm(kind: str) -> JudgedArm:
    """Return an arm that the wearer has raised and left to its motors."""
    shipped = kind in POSES
    arm = ShippedArm(kind, REAL_RATE) if shipped else arm_of(kind, rate=REAL_RATE, proves_signs=False)
    arm.carry()
    arm.raise_to(POSES.get(kind, POSE))
    return arm


@pytest.mark.parametrize("kind", quick((FARTHEST, "mixed"), (*REPLYING, *BY_NAME)))
def test_an_arm_is_switched_on_and_off_without_a_collision(kind: str) -> None:
    assert_switched_on_and_off_without_a_collision(arm_of(kind, bitrate=1_000_000))


# Seven joints take eight times as long as the elbow.
@pytest.mark.parametrize("kind", quick((FARTHEST, "elbow"), (*REPLYING, "damiao", *POSES)))
def test_an_arm_is_held_and_let_down(kind: str) -> None:
    assert_held_and_let_down(raised_arm(kind))


def test_an_arm_on_can_fd_is_sent_only_fast_frames_and_is_held_and_let_down() -> None:
    arm = arm_of("damiao", is_fd=True)
    listener = Responder(arm.wire)
    arm.carry()
    assert {(message.is_fd, message.bitrate_switch) for message in listener.received} == {(True, True)}
    arm.raise_to(POSE)
    assert_held_and_let_down(arm)


@pytest.mark.parametrize("kind", quick((FARTHEST, "damiao"), (*REPLYING, "damiao")))
def test_a_torque_that_another_tool_left_in_the_motors_memory_is_not_carried_out(kind: str) -> None:
    arm = arm_of(kind, remembered=4.9)
    arm.carry()
    arm.assert_not_thrown()


# Of stalls, the firmware that takes them worst.
WORST = [
    ("open_drive", "loop stalls for 75 ms"),
    ("v3_2", "loop stalls for 120 ms"),
    ("damiao", "motor 2 restarts in 30 ms"),
    ("damiao", "loop stalls for 300 ms"),
]
OF_ALL = ("all motors restart in 80 ms", "supply cut for 3 s", "motor 1 loses its power for 1 s",
          "loop stalls for 60 ms", "loop stalls for 300 ms")  # fmt: skip
CASES = [*itertools.product((*REPLYING, "damiao"), EVENTS), *itertools.product(POSES, OF_ALL)]


@pytest.mark.parametrize(("kind", "event"), quick([*WORST, *itertools.product(["elbow"], OF_ALL)], CASES))
def test_whatever_the_firmware_drops_the_motors_drive_no_joint(kind: str, event: str) -> None:
    """A motor that has lost its torque lets its joint fall; what counts is what motors drive, then and afterwards."""
    arm = raised_arm(kind)
    arm.go_through(EVENTS[event], is_loss="stalls" not in event)
    assert arm.safety.state is State.ACTIVE or arm.safety.fault
    assert not any(motor.dips for motor in arm.device.motors) or arm.safety.fault, "torque was lost without a word"


@pytest.mark.parametrize("motor", [1, 2])
def test_while_a_motor_that_has_lost_its_power_is_late_the_others_stop_driving_their_joints(motor: int) -> None:
    arm = raised_arm("ak")
    arm.go_through(cut(1.0, motor), is_loss=True)
    assert arm.caused.energy < ENERGY, arm.caused


def test_a_board_in_query_reply_mode_is_not_started_and_the_reason_is_told() -> None:
    arm = arm_of("v3_query")
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert "query-reply" in arm.safety.refusal or "no reply" in arm.safety.refusal
    assert not arm.device.powered


# What only Damiao motors do.


def damiao_of(arm: JudgedArm, joint: int) -> DamiaoMotor:
    motor = arm.device.motors[joint]
    assert isinstance(motor, DamiaoMotor)
    return motor


def test_motors_that_let_go_in_a_stall_are_switched_on_again_and_lower_the_arm() -> None:
    arm = raised_arm("damiao")
    arm.clock.stall(0.3)
    assert arm.run_until(lambda: arm.device.motors[0].dips and arm.safety.fault, 0.1)
    assert arm.run_until(lambda: all(motor.entered for motor in arm.device.motors), 0.05)
    assert arm.run_until(lambda: arm.loop.is_off, 30.0)
    assert not arm.device.powered


def test_a_motor_that_lets_go_says_so_where_its_torque_is_too_small_to_tell() -> None:
    arm = raised_arm("damiao")
    assert abs(arm.device.motors[0].torque(arm.device.arm.positions[0], 0.0)) < 0.2  # Nm
    damiao_of(arm, 0).write(TIMEOUT, 20)  # 1 ms, shorter than a cycle
    assert arm.run_until(lambda: arm.safety.fault, 0.05)
    fault = arm.safety.fault
    assert fault and fault.code is FaultCode.TORQUE_NOT_DELIVERED
    assert "its motor says that it is off: communication lost: no command came for its time-out" in fault.reason


def test_a_host_that_died_leaves_motors_off_that_the_next_start_switches_on_again() -> None:
    arm = arm_of("damiao")
    for joint in range(len(BY_NAME["damiao"])):  # a host that dies with its motors on
        motor = damiao_of(arm, joint)
        arm.device.exchange(motor.joint.command_id, ENTER)
        arm.device.exchange(*motor.joint.idle)
    arm.device.advance(1.0)
    assert [damiao_of(arm, joint).latched for joint in range(len(BY_NAME["damiao"]))] == [LOST] * len(BY_NAME["damiao"])
    arm.carry()


def foreign(data: bytes, motor: int = 2) -> Callable[[JudgedArm], None]:
    return lambda arm: arm.wire.carry(None, message_of((motor, data)))


def push(arm: JudgedArm) -> None:
    joint = damiao_of(arm, 1).joint
    stop = arm.wire.repeat(message_of((joint.command_id, joint.command(10.0, 0.0))), 0.01)
    arm.clock.later(1.0, stop)


def write(register: int, value: float) -> Callable[[JudgedArm], None]:
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
    arm = raised_arm("damiao")
    FOREIGN[command](arm)
    arm.run_until(lambda: arm.loop.is_off, 30.0)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.FOREIGN_COMMAND
    arm.assert_not_thrown(*UNKNOWN_LOSS)
    assert not arm.device.powered


SET_OTHERWISE = [
    (TMAX, 10.0, "its TMAX (register 23) is 10, must be 54, or torque_range 10 in the file", 0.0),
    (TIMEOUT, 0.0, "its TIMEOUT (register 9) is 0, must be 4000", 0.0),
    (CTRL_MODE, 2.0, "its CTRL_MODE (register 10) is 2, must be 1", 0.0),
    (TMAX, 10.0, "its TMAX (register 23) is 10", 1.3),
]


@pytest.mark.parametrize(
    ("register", "value", "sentence", "asked"),
    quick(SET_OTHERWISE[:1], SET_OTHERWISE),
    ids=["TMAX", "TIMEOUT", "CTRL_MODE", "TMAX after it was asked"],
)
def test_a_motor_that_is_set_otherwise_than_the_file_says_is_not_switched_on(
    register: int, value: float, sentence: str, asked: float
) -> None:
    arm = arm_of("damiao")
    arm.run(max(0.0, asked - 0.3))
    arm.enable()
    arm.run(min(asked, 0.3))
    damiao_of(arm, 1).write(register, value)
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert f"motor 2 to be set right: {sentence}" in arm.safety.refusal
    assert not arm.device.powered and not arm.caused.energy


def test_the_replies_of_a_motor_with_another_master_id_are_named() -> None:
    arm = arm_of("damiao")
    joints = [
        replace(joint_of(name, 1 + i), master_id=0x20 + i if i == 1 else 0) for i, name in enumerate(BY_NAME["damiao"])
    ]
    bus = motor_bus(arm.wire, joints)
    bus.listen()
    arm.run(0.1)
    assert bus.boards.hindrance(arm.now, 250.0) == ""
    bus.receive_until(arm.now + 0.01)
    sentence = bus.boards.hindrance(arm.now, 250.0)
    assert sentence == "motor 2 replies with the ID 18: set master_id = 18, or 33 on the motor"


# The start, and elastic joints.

RIGHT, EXCHANGED = (1, 2, 3, 4), (1, 2, 4, 3)
SLOWEST = 100.0  # Hz, the lowest in use: a light joint gains most speed in a cycle
LIGHT = 6  # the seven-joint arm's last joint, 0.002 kg m^2


class LateMotor(DamiaoMotor):
    """A motor whose replies show what it read two commands ago."""

    def __init__(self, joint: JointMotor) -> None:
        super().__init__(joint)
        self._past: deque[tuple[float, float, float]] = deque(maxlen=3)

    def _readings(self, position: float, velocity: float) -> tuple[float, float, float]:
        self._past.append(super()._readings(position, velocity))
        return self._past[0]


def proven(name: str, kinds: dict[int, type[DamiaoMotor]], reversed_motor: int | None = None) -> ShippedArm:
    """Return an arm whose signs are proven, or that is refused."""
    arm = ShippedArm(name, SLOWEST, kinds)
    if reversed_motor is not None:
        ACTS["torque_reversed"](arm, reversed_motor)
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state in (State.RAMPING_IN, State.FAULT))
    return arm


PROVEN: list[tuple[str, dict[int, type[DamiaoMotor]]]] = [
    ("sim", {}),
    ("elbow", {}),
    ("three_joints", {}),
    ("seven_joints", {}),
    ("seven_joints", dict.fromkeys(range(LIGHT + 1), LateMotor)),
]


@pytest.mark.parametrize(
    ("name", "kinds"),
    quick([PROVEN[0], PROVEN[-1]], PROVEN),
    ids=["paper's", "elbow", "three joints", "seven joints", "seven joints, late replies"],
)
def test_no_joint_turns_fast_while_its_sign_is_proven(name: str, kinds: dict[int, type[DamiaoMotor]]) -> None:
    arm = proven(name, kinds)
    assert arm.safety.state is State.RAMPING_IN, arm.safety.fault
    assert 0.0 < arm.fastest < DRIVEN


def test_a_light_joint_whose_motor_is_reversed_turns_no_faster() -> None:
    arm = proven("seven_joints", {}, LIGHT)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.WRONG_SIGN
    arm.run(1.0)
    assert not arm.device.powered
    assert arm.fastest < DRIVEN


USUAL = joints_of((MIT,) * 4)
IDS = [(EXCHANGED, True), (EXCHANGED, False), (RIGHT, True), (RIGHT, False)]


# Reach, come back, and wait there until the arm is at rest.
REACH = ({"move": [0.3, 1.0, 0.8, 1.0], "over": 1.5}, {"move": POSE, "over": 1.5}, {"move": POSE, "over": 2.0})
ELASTIC = ((150.0, 0.0), (150.0, 0.02), (1000.0, 0.0), (1000.0, 0.01))  # Nm/rad, rad


@pytest.mark.parametrize(("stiffness", "play"), quick([(150.0, 0.02)], ELASTIC))
def test_an_elastic_arm_is_carried_without_an_alarm_and_stays_where_its_wearer_leaves_it(
    stiffness: float, play: float
) -> None:
    motors = [SimulatedMotor(joint) for joint in USUAL]
    arm = CarriedArm(USUAL, motors, PEAK, stiffness=stiffness, play=play)
    arm.carry()
    arm.raise_to(POSE)
    arm.act(*REACH)
    arm.run(5.2)
    assert arm.safety.state is State.ACTIVE, arm.safety.fault
    left = np.array(arm.device.arm.positions)
    arm.forget()
    arm.run(2.0)
    assert arm.safety.state is State.ACTIVE, arm.safety.fault
    arm.assert_not_thrown()
    # What the hand held bends the joint, and the link falls through its play.
    assert np.abs(np.array(arm.device.arm.positions) - left).max() < 0.03 + play
