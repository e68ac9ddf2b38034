# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated motors of each family and firmware: frames in, and the state, the reply and the torque out."""

import struct
from dataclasses import replace
from typing import Any

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT_V3, unpack_reply
from exo_gravity.core.motors.damiao import CLEAR_ERROR, DAMIAO_MIT, LOST, ON, PMAX, REGISTERS, TIMEOUT, TMAX
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, EXTENDED, SET_ZERO, pack_command
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.params import values_of
from exo_gravity.sim import FIRMWARES, Firmware, SimulatedMotor
from exo_gravity.sim.motors import class_of, simulated
from exo_gravity.sim.motors.ak import Heat
from exo_gravity.sim.motors.damiao import DamiaoMotor
from exo_gravity.sim.params import SIMULATOR, device_of, set_faults
from exo_gravity.sim.virtual_time import Wire

from ..support.simulated_device import make_device

SPEC = MOTORS["AK60-6"]
TORQUE_CODE = 2 * SPEC.torque_range / 4095
STEP = 0.02  # Nm, more than a code of torque
TO_BOOT_LOADER, NEXT_TO_IT, CLEAR_FAULTS = (b"\xff" * 7 + bytes((code,)) for code in (0xFB, 0xFA, 0xF0))
MIT_BOARDS = ("ak", "vendor", "open_drive")
MIRRORED = {"direction": -1, "zero": 0.4}


def command(torque=0.0, kd=0.0, kp=0.0, position=0.0, velocity=0.0, spec=SPEC):
    return pack_command(spec, position, velocity, kp, kd, torque)


PUSH, ZERO = command(2.0), command()


def motor_of(name: str = "ak", changes: dict[str, object] | None = None, **joint: object) -> SimulatedMotor:
    """Return a motor of the firmware `name` with `changes`, on a joint."""
    return SimulatedMotor(JointMotor(**{"spec": SPEC, "can_id": 3, **joint}), replace(FIRMWARES[name], **changes or {}))


def play(motor: SimulatedMotor, *frames: bytes, position: float = 0.0) -> list[bytes | None]:
    """Let `motor` receive frames at rest; return its replies."""
    return [motor.receive(data, position, 0.0, 0.0) for data in frames]


def reply_to(motor: SimulatedMotor, data: bytes, position: float = 0.0, velocity: float = 0.0, now: float = 0.0):
    """Return the decoded reply to `data`."""
    return unpack_reply(motor.joint.spec, motor.receive(data, position, velocity, now))


def without_power_for_a_moment(motor: SimulatedMotor) -> None:
    motor.unplugged = True
    motor.unplugged = False


# Every AK motor


@pytest.mark.parametrize(
    ("joint", "given", "position", "velocity", "torque", "within"),
    [
        ({}, {"position": 0.5, "velocity": 1.0, "kp": 4.0, "kd": 0.5}, 0.0, 0.0, 2.5, 0.05),
        ({}, {"position": 0.5, "velocity": 1.0, "kp": 4.0, "kd": 0.5}, 0.7, -2.0, 0.7, 0.02),
        (MIRRORED, {"position": 0.4, "kp": 4.0, "kd": 0.5}, 0.3, 0.0, -1.2, 0.02),
        (MIRRORED, {"position": 0.4, "kp": 4.0, "kd": 0.5}, 0.0, 2.0, -1.0, 0.02),
        ({"spec": replace(SPEC, velocity_range=45.0, torque_range=9.0)}, {"torque": 5.0}, 0.0, 0.0, 3.0, TORQUE_CODE),
    ],
    ids=["stiffness", "and damping", "mirrored stiffness", "mirrored damping", "a wrong range"],
)
def test_stiffness_damping_and_torque_act_on_the_present_joint_state(joint, given, position, velocity, torque, within):
    motor = motor_of(**joint)
    play(motor, ENTER, command(**given))
    assert motor.torque(position, velocity) == pytest.approx(torque, abs=within)


@pytest.mark.parametrize("scale", [0.75, 1.0, 1.2])
@pytest.mark.parametrize("commanded", [15.0, -15.0])
def test_torque_is_limited_to_the_motors_peak_and_no_12_bit_code_is_exactly_zero(commanded, scale):
    motor = motor_of(torque_scale=scale)
    play(motor, ENTER)
    assert abs(reply_to(motor, command(commanded)).torque) == pytest.approx(SPEC.peak_torque, abs=TORQUE_CODE)
    assert abs(motor.torque(0.0, 0.0)) == pytest.approx(motor.joint.peak_effort)
    play(motor, ZERO)
    assert abs(motor.torque(0.0, 0.0)) == pytest.approx(scale * TORQUE_CODE / 2)


def test_a_reply_is_in_motor_coordinates_and_its_zero_is_where_set_zero_found_the_joint():
    motor = motor_of(**MIRRORED)
    play(motor, ENTER)
    reply = reply_to(motor, command(1.0), position=0.3, velocity=2.0)
    assert reply.position == pytest.approx(0.1, abs=2e-4)
    assert reply.velocity == pytest.approx(-2.0, abs=0.012)
    assert reply.torque == pytest.approx(1.0, abs=TORQUE_CODE)
    play(motor, SET_ZERO, position=0.3)
    for position, replied in ((0.3, 0.0), (0.5, -0.2)):
        assert reply_to(motor, ZERO, position, now=2.0).position == pytest.approx(replied, abs=2e-4)


def test_a_motor_that_gives_its_rated_torque_warms_by_its_rise_and_cools_again():
    motor = SimulatedMotor(JointMotor(SPEC, 3), Firmware(), Heat(rise=60.0, time=100.0))
    for data, seconds, temperature in ((command(SPEC.rated_torque), 100, 30.0 + 60.0 * 0.632), (EXIT, 1000, 30.0)):
        play(motor, ENTER, data)
        for _ in range(seconds):
            motor.advance(0.0, 0.0, 1.0)
        assert motor.temperature == pytest.approx(temperature, abs=0.5 if seconds == 100 else 0.1)


# What differs between the firmwares of V1 and V2 boards


@pytest.mark.parametrize(
    ("frames", "torques"),
    [
        ((PUSH,), (0.0, 0.0, 0.0)),
        ((PUSH, ENTER), (2.0, 0.0, 2.0)),
        ((ENTER, PUSH), (2.0, 2.0, 2.0)),
        ((ENTER, PUSH, EXIT), (0.0, 0.0, 0.0)),
        ((ENTER, PUSH, EXIT, ENTER), (2.0, 2.0, 0.0)),
        ((ENTER, PUSH, EXIT, ZERO, ENTER), (0.0, 2.0, 0.0)),
        ((ENTER, PUSH, EXIT, ENTER, ZERO), (0.0, 0.0, 0.0)),
    ],
    ids=["off", "before ENTER", "on", "EXIT", "ENTER again", "zero before ENTER", "zero after ENTER"],
)
@pytest.mark.parametrize(("column", "name"), list(enumerate(MIT_BOARDS)), ids=MIT_BOARDS)
def test_which_command_acts_after_which_frames(name, column, frames, torques):
    motor = motor_of(name)
    replies = play(motor, *frames)
    assert motor.torque(0.0, 0.0) == pytest.approx(torques[column], abs=STEP)
    assert None not in replies


# Of each firmware: bytes of a reply, its ID, whether it is silent at SET_ZERO; rad afterwards while on, and once it
# was without power, 0.3 where SET_ZERO was not obeyed or kept; whether ENTER works with an error; IDs that it obeys.
BOARDS = [
    ("ak", 8, 3, True, 0.0, 0.0, False, (0x03,)),
    ("vendor", 8, 3, False, 0.0, 0.3, False, (0x03,)),
    ("open_drive", 7, 0, False, 0.3, 0.3, True, (0x03, 0x83, 0x703)),
]


@pytest.mark.parametrize(
    ("name", "length", "reply_id", "silent_at_zero", "while_on", "after", "enters_with_an_error", "ids"),
    BOARDS,
    ids=MIT_BOARDS,
)
def test_the_replies_of_a_firmware_what_it_does_at_set_zero_with_an_encoder_error_and_which_ids_it_obeys(
    name, length, reply_id, silent_at_zero, while_on, after, enters_with_an_error, ids
):
    def angle(motor: SimulatedMotor) -> float:
        return unpack_reply(motor.joint.spec, motor.receive(ZERO, 0.3, 0.0, 9.0)[:6]).position

    motor = motor_of(name)
    assert (len(play(motor, ZERO)[0]), motor.reply_id) == (length, reply_id)
    assert (play(motor, SET_ZERO, position=0.3) == [None]) is silent_at_zero
    assert angle(motor) == pytest.approx(0.0, abs=1e-3)
    without_power_for_a_moment(motor)
    assert angle(motor) == pytest.approx(after, abs=1e-3)
    motor = motor_of(name)
    play(motor, ENTER, SET_ZERO, position=0.3)
    assert angle(motor) == pytest.approx(while_on, abs=1e-3)
    motor = motor_of(name)
    motor.error = 5
    assert play(motor, ENTER)[0] is not None and motor.entered is enters_with_an_error
    for can_id in (0x03, 0x83, 0x703):
        device = make_device(FIRMWARES[name])
        device.exchange(can_id, ENTER)
        assert [motor.entered for motor in device.motors] == [False, False, can_id in ids, False]


@pytest.mark.parametrize(("name", "timeout"), [("open_drive", 0.025), ("ak", 0.0), ("vendor", 0.0), ("vendor", 0.15)])
def test_a_time_out_drops_torque_and_damping_at_once_until_the_next_command(name, timeout):
    motor = motor_of(name, {} if timeout < 0.1 else {"timeout": timeout})
    play(motor, ENTER, command(2.0, kd=1.0))
    torques = [motor.advance(0.0, 0.0, 0.001) for _ in range(400)]
    assert sum(torque > 1.9 for torque in torques) == pytest.approx(
        1000.0 * timeout or 400, abs=1.0 if timeout else 0.0
    )
    assert motor.entered and (motor.damping == 0.0) is bool(timeout) and motor.dips == bool(timeout)
    play(motor, PUSH)
    assert motor.advance(0.0, 0.0, 0.001) == pytest.approx(2.0, abs=STEP)


def test_the_vendors_error_byte_is_a_mask_its_positions_span_12_56_rad_and_heat_switches_it_off_until_cleared():
    motor, readings = motor_of("vendor"), []
    seen = unpack_reply(SPEC, play(motor, ZERO, position=1.5)[0])
    assert seen.position == pytest.approx(1.5 * 12.5 / 12.56, abs=1e-3)
    play(motor, ENTER, PUSH)
    for motor.temperature in (81.0, 82.0, 119.0, 120.0, 70.0):
        motor.advance(0.0, 0.0, 0.001)
        readings.append((play(motor, PUSH)[0][7], motor.entered))
    assert readings == [(0, True), (2, True), (2, True), (6, False), (4, False)]
    play(motor, ENTER)
    assert not motor.entered
    play(motor, CLEAR_FAULTS, ENTER)
    assert motor.entered and play(motor, PUSH)[0][7] == 0


# V3 boards


V3 = JointMotor(MIT_V3.ranged(SPEC), 3, direction=-1, zero=0.2, torque_scale=0.8, wire_format=MIT_V3)


def reported(motor: SimulatedMotor, position: float = 0.5, velocity: float = 0.0):
    """Return what the joint reads from the status frame; None without one."""
    frame = motor.status(position, velocity)
    assert frame is None or frame[0] == MIT_V3.reply_id(3)
    return frame and V3.sample(frame[1], 0.0)


def pushed(firmware: Firmware | None = None) -> SimulatedMotor:
    """Return a V3 board that has received a command of 1.5 Nm."""
    motor = SimulatedMotor(V3, firmware)
    assert not motor.entered
    assert motor.receive(V3.command(1.5, 5.0), 0.5, 0.0, 0.0, V3.command_id) is None
    return motor


def test_the_first_command_switches_a_v3_board_on_its_status_shows_angle_speed_and_torque_and_exit_switches_it_off():
    motor = pushed()
    assert motor.entered and motor.torque(0.5, 0.0) == pytest.approx(1.5, abs=0.01)
    reply = reported(motor)
    assert reply[:3] == (pytest.approx(0.5, abs=0.001), 0.0, pytest.approx(1.5, abs=0.01))
    assert (reply.temperature, reply.error) == (30, 0)
    assert reported(motor, velocity=1.0).velocity == pytest.approx(1.0, abs=0.01)
    for frame_id, data in V3.exit:
        motor.receive(data, 0.5, 0.0, 0.0, frame_id)
    assert not motor.entered and motor.torque(0.5, 3.0) == 0.0
    assert reported(motor).effort == 0.0
    motor.receive((2000).to_bytes(4, "big", signed=True), 0.5, 0.0, 0.0, V3.exit[0][0])
    assert motor.torque(0.5, 0.0) == pytest.approx(-0.8 * 2.0 * 0.2997)  # a current drives it


def test_a_v3_board_of_image_3_2_reads_its_torque_by_the_firmwares_constant_and_1_35_times_it_by_the_rated_ones():
    motor = pushed(FIRMWARES["v3_2"])
    assert motor.torque(0.5, 0.0) == pytest.approx(1.5, abs=STEP)
    status = motor.status(0.5, 0.0)[1]
    assert V3.sample(status, 0.0).effort == pytest.approx(1.5, abs=STEP)
    by_rated = replace(V3, spec=replace(V3.spec, torque_per_ampere=3.0 / 7.4))
    assert by_rated.sample(status, 0.0).effort == pytest.approx(1.5 * 3.0 / 7.4 / 0.2997, abs=STEP)


@pytest.mark.parametrize(("name", "rate", "by_broadcast"), [("v3", 500, 0), ("v3_2", 50, 1), ("v3_query", 0, 1)])
def test_status_frames_come_unasked_at_a_variants_rate_and_a_broadcast_reaches_boards_of_image_3_2(
    name, rate, by_broadcast
):
    wire, device = Wire(), make_device(FIRMWARES[name], formats=(MIT_V3,) * 4)
    host = wire.open()
    wire.play(device)
    wire.clock.sleep(1.0)
    assert sum(1 for _ in iter(lambda: host.recv(0.0), None)) == pytest.approx(4 * rate, abs=4)
    assert device.exchange(EXTENDED | 0x8FF, V3.command(1.0, 0.0)) is None
    assert [motor.entered for motor in device.motors] == [bool(by_broadcast)] * 4
    device.exchange(EXTENDED | 0x1FF, bytes(4))
    assert not device.powered


# From a parameter file


def values(**given: object) -> dict[str, object]:
    named = {name.replace("__", "."): value for name, value in given.items()}
    return values_of(SIMULATOR, {"can.interface": "virtual", "can.channel": "wire", **named})


def test_parameters_choose_the_firmware_of_each_motor_and_change_it_and_others_are_refused_by_name():
    device = device_of(values(firmware__variant=["usual", "vendor", "open_drive", "ak"]))
    assert [motor.firmware.timeout for motor in device.motors] == [0.0, 0.0, 0.025, 0.0]
    device = device_of(values(firmware__variant=["open_drive"] * 4, firmware__timeout=0.3, reply_length=6))
    assert {(motor.firmware.timeout, motor.firmware.reply_length) for motor in device.motors} == {(0.3, 6)}
    for joint in (V3, DAMIAO):
        with pytest.raises(ParameterError, match=r"variant = 'vendor': must be one of usual"):
            simulated(joint, FIRMWARES["vendor"])
    with pytest.raises(ParameterError, match="motor = 'unheard'"):
        class_of("unheard")


@pytest.mark.parametrize("dip", [0.02, 0.05, 0.08])
def test_each_motor_comes_back_from_a_dip_of_the_supply_switched_off_and_once(dip):
    device = device_of(values())
    for can_id in (1, 2, 3, 4):
        device.exchange(can_id, ENTER)
    given = values(fault__unplugged=[False, True, True, False], fault__unplugged_time=dip)
    set_faults(device, given, {"fault.unplugged"})
    device.advance(dip - 0.002)
    assert [device.exchange(can_id, ZERO) is None for can_id in (1, 2, 3, 4)] == [False, True, True, False]
    device.advance(0.004)
    set_faults(device, given, {"trunk.pitch"})  # not again
    assert None not in [device.exchange(can_id, ZERO) for can_id in (1, 2, 3, 4)]
    assert [motor.entered for motor in device.motors] == [True, False, False, True]


# Damiao motors


TICK = 0.001  # s


DAMIAO = JointMotor(MOTORS["DM-J4310"], 3, wire_format=DAMIAO_MIT, timeout=0.2)


def state(motor: DamiaoMotor, data: bytes) -> int:
    """Return the state that the reply to `data` tells, at rest at 0.3 rad."""
    return motor.receive(data, 0.3, 0.0, 0.0, 3)[0] >> 4


def last_torque(motor: DamiaoMotor, duration: float) -> float:
    """Return the torque after so many s at rest."""
    return [motor.advance(0.3, 0.0, TICK) for _ in range(round(duration / TICK))][-1]


def ask(motor: DamiaoMotor, register: int, kind: str = "f", operation: int = 0x33, value: float = 0) -> Any:
    """Return what the motor tells of a register, or None. operation: 0x33 reads, 0x55 writes, 0xAA stores."""
    told = motor.receive(struct.pack(f"<BBBB{kind}", 3, 0, operation, register, value), 0.3, 0.0, 0.0, REGISTERS)
    return told and struct.unpack(f"<{kind}", told[4:])[0]


def test_a_motor_without_commands_lets_go_and_ignores_enter_until_its_error_is_cleared() -> None:
    motor, push = DamiaoMotor(DAMIAO), DAMIAO.command(2.0, 0.0)
    assert state(motor, push) == 0 and last_torque(motor, 0.01) == 0.0  # while it is off it is kept, and ENTER obeys it
    assert state(motor, ENTER) == ON
    assert last_torque(motor, 0.19) == pytest.approx(2.0, abs=0.01)
    assert last_torque(motor, 0.02) == 0.0 and motor.dips == 1
    assert [state(motor, data) for data in (push, ENTER)] == [LOST, LOST] and last_torque(motor, 0.01) == 0.0
    assert [state(motor, data) for data in (CLEAR_ERROR, ENTER, EXIT, ENTER)] == [0, ON, 0, ON]
    assert last_torque(motor, 0.01) == 0.0


def test_an_error_switches_the_motor_off_and_comes_back_while_its_cause_stays() -> None:
    motor, idle = DamiaoMotor(DAMIAO), DAMIAO.command(0.0, 0.0)
    play(motor, ENTER)
    motor.error = 0x9
    last_torque(motor, TICK)
    assert [state(motor, data) for data in (idle, CLEAR_ERROR, ENTER)] == [0x9] * 3 and not motor.entered
    motor.error = 0
    assert [state(motor, data) for data in (CLEAR_ERROR, ENTER)] == [0, ON]
    motor.temperature = 101.0
    last_torque(motor, TICK)
    assert state(motor, idle) == 0xC  # a hot coil


def test_registers_are_told_what_is_written_counts_until_the_power_goes_unless_it_is_stored_and_a_zero_stays() -> None:
    motor = DamiaoMotor(DAMIAO)
    assert [ask(motor, number, "I") for number in (7, 9, 10)] == [0x13, 4000, 1]
    assert [ask(motor, number) for number in (20, 21, 22, 23)] == [10.0, 12.5, 30.0, 10.0]
    assert ask(motor, 99) is None
    assert motor.receive(bytes((4, 0, 0x33, 21, 0, 0, 0, 0)), 0.3, 0.0, 0.0, REGISTERS) is None  # another motor's
    for register, kind, operation, value in (
        (PMAX, "f", 0x55, 12.566), (PMAX, "f", 0x55, -1.0), (1, "I", 0xAA, 0), (TMAX, "f", 0x55, 20.0),
        (TIMEOUT, "I", 0x55, 0),
    ):  # fmt: skip
        ask(motor, register, kind, operation, value)
    play(motor, ENTER, DAMIAO.command(2.0, 0.0))
    assert last_torque(motor, 1.0) == pytest.approx(4.0, abs=0.02)  # the same code, another torque; and no time-out
    refresh = motor.receive(bytes((3, 0, 0xCC, 0, 0, 0, 0, 0)), 0.3, 0.0, 0.0, REGISTERS)
    assert refresh == motor.receive(DAMIAO.command(5.0, 0.0), 0.3, 0.0, 0.0, 0x103) and refresh[0] == 0x13
    assert last_torque(motor, 1.0) == pytest.approx(4.0, abs=0.02)  # which a command of another mode does not change
    assert [state(motor, data) for data in (EXIT, SET_ZERO)] == [0, 0]
    without_power_for_a_moment(motor)
    assert (ask(motor, TMAX), ask(motor, PMAX)) == pytest.approx((10.0, 12.566))
    assert DAMIAO.sample(motor.receive(EXIT, 0.3, 0.0, 0.0, 3), 0.0).position == pytest.approx(0.0, abs=0.001)
