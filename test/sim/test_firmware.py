# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What each simulated firmware does with the same frames: frames in, and the state, the reply and the torque out."""

from __future__ import annotations

from dataclasses import replace

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT_V3, unpack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, EXTENDED, SET_ZERO, pack_command
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.params import values_of
from exo_gravity.sim import FIRMWARES, Firmware, SimulatedMotor
from exo_gravity.sim.motors.ak import Heat
from exo_gravity.sim.params import SIMULATOR, device_of, set_faults
from exo_gravity.sim.virtual_time import Wire

from ..support.simulated_device import make_device

SPEC = MOTORS["AK60-6"]
V3_SPEC = MIT_V3.ranged(SPEC)
V3_JOINT = JointMotor(V3_SPEC, 3, wire_format=MIT_V3)
STEP = 0.02  # Nm, more than a code of torque
PUSH, ZERO = pack_command(SPEC, 0.0, 0.0, 0.0, 0.0, 2.0), pack_command(SPEC, 0.0, 0.0, 0.0, 0.0, 0.0)
DAMP = pack_command(SPEC, 0.0, 0.0, 0.0, 1.0, 0.0)
TO_BOOT_LOADER, NEXT_TO_IT, CLEAR_FAULTS = (b"\xff" * 7 + bytes((code,)) for code in (0xFB, 0xFA, 0xF0))
MIT_BOARDS = ("ak", "vendor", "open_drive")


def motor_of(name: str, can_id: int = 3, **changes: object) -> SimulatedMotor:
    return SimulatedMotor(JointMotor(SPEC, can_id), replace(FIRMWARES[name], **changes))


def play(motor: SimulatedMotor, *frames: bytes, position: float = 0.0) -> list[bytes | None]:
    """Let `motor` receive frames at rest; return its replies."""
    return [motor.receive(data, position, 0.0, 0.0) for data in frames]


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


@pytest.mark.parametrize(
    ("name", "is_silent", "while_on", "after"),
    [("ak", True, 0.0, 0.0), ("vendor", False, 0.0, 0.3), ("open_drive", False, 0.3, 0.3)],
)
def test_set_zero_its_reply_and_the_zero_after_a_power_cycle(name, is_silent, while_on, after):
    def angle(motor: SimulatedMotor) -> float:
        return unpack_reply(motor.joint.spec, motor.receive(ZERO, 0.3, 0.0, 9.0)[:6]).position

    motor = motor_of(name)
    assert [reply is None for reply in play(motor, SET_ZERO, position=0.3)] == [is_silent]
    assert angle(motor) == pytest.approx(0.0, abs=1e-3)
    motor.unplugged = True
    motor.unplugged = False
    assert angle(motor) == pytest.approx(after, abs=1e-3)
    motor = motor_of(name)
    play(motor, ENTER, SET_ZERO, position=0.3)
    assert angle(motor) == pytest.approx(while_on, abs=1e-3)


@pytest.mark.parametrize(("name", "timeout"), [("open_drive", None), ("ak", None), ("vendor", None), ("vendor", 0.15)])
def test_a_time_out_drops_torque_and_damping_at_once_until_the_next_command(name, timeout):
    changes = {} if timeout is None else {"timeout": timeout}
    motor = motor_of(name, **changes)
    limit = motor.firmware.timeout
    assert limit == (timeout if timeout is not None else {"open_drive": 0.025}.get(name, 0.0))
    play(motor, ENTER, pack_command(SPEC, 0.0, 0.0, 0.0, 1.0, 2.0))
    torques = [motor.advance(0.0, 0.0, 0.001) for _ in range(400)]
    held = sum(torque > 1.9 for torque in torques)
    assert held == pytest.approx(1000.0 * limit, abs=1.0) if limit else held == 400
    assert motor.entered and (motor.damping == 0.0) is bool(limit) and motor.dips == bool(limit)
    play(motor, PUSH)
    assert motor.advance(0.0, 0.0, 0.001) == pytest.approx(2.0, abs=STEP)


def test_an_arm_on_the_open_drive_falls_while_its_host_is_stopped_for_60_ms():
    device = make_device(FIRMWARES["open_drive"])
    for can_id in (1, 2, 3, 4):
        device.exchange(can_id, ENTER)
    device.exchange(2, pack_command(MOTORS["AK80-9"], 0.0, 0.0, 0.0, 0.0, 4.0))
    speeds = []
    for _ in range(60):
        device.advance(0.001)
        speeds.append(device.arm.velocities[1])
    assert speeds[24] > 0.1 and speeds[24] > speeds[59] and device.motors[1].dips == 1


def test_the_vendors_error_byte_is_a_mask_and_heat_switches_its_motor_off_until_faults_are_cleared():
    def error() -> int:
        return play(motor, PUSH)[0][7]

    motor = motor_of("vendor")
    play(motor, ENTER, PUSH)
    readings = []
    for motor.temperature in (81.0, 82.0, 119.0, 120.0, 70.0):
        motor.advance(0.0, 0.0, 0.001)
        readings.append((error(), motor.entered))
    assert readings == [(0, True), (2, True), (2, True), (6, False), (4, False)]
    play(motor, ENTER)
    assert not motor.entered
    play(motor, CLEAR_FAULTS, ENTER)
    assert motor.entered and error() == 0


@pytest.mark.parametrize(("name", "is_on"), [("ak", False), ("vendor", False), ("open_drive", True)])
def test_with_an_encoder_error_most_refuse_enter_and_reply_as_ever(name, is_on):
    motor = motor_of(name)
    motor.error = 5
    assert play(motor, ENTER)[0] is not None
    assert motor.entered is is_on


@pytest.mark.parametrize(("name", "length", "reply_id"), [("ak", 8, 3), ("vendor", 8, 3), ("open_drive", 7, 0)])
def test_the_length_and_the_id_of_replies(name, length, reply_id):
    motor = motor_of(name)
    assert (len(play(motor, ZERO)[0]), motor.reply_id) == (length, reply_id)


def test_the_vendors_positions_span_12_56_rad():
    reply = play(motor_of("vendor"), ZERO, position=1.5)[0]
    assert unpack_reply(SPEC, reply).position == pytest.approx(1.5 * 12.5 / 12.56, abs=1e-3)


def test_next_to_its_special_frames_the_vendors_motor_leaves_the_bus_until_it_loses_power():
    motor = motor_of("vendor")
    assert play(motor, ENTER, NEXT_TO_IT)[1] is not None and motor.entered
    assert play(motor, TO_BOOT_LOADER, ZERO, ENTER) == [None] * 3 and not motor.entered
    motor.unplugged = True
    motor.unplugged = False
    assert play(motor, ENTER)[0] is not None and motor.entered
    for name in ("ak", "open_drive"):
        motor = motor_of(name)
        play(motor, ENTER, TO_BOOT_LOADER)
        assert motor.torque(0.0, 0.0) == SPEC.peak_torque  # a command with every field near its maximum


@pytest.mark.parametrize("can_id", [0x03, 0x83, 0x703])
@pytest.mark.parametrize("name", MIT_BOARDS)
def test_the_open_drive_obeys_every_id_with_its_lowest_7_bits(name, can_id):
    device = make_device(FIRMWARES[name])
    device.exchange(can_id, ENTER)
    is_obeyed = can_id == 0x03 or name == "open_drive"
    assert [motor.entered for motor in device.motors] == [False, False, is_obeyed, False]


@pytest.mark.parametrize(
    ("name", "data", "is_command"),
    [
        ("ak", PUSH[:6], False),
        ("vendor", PUSH[:6], True),
        ("open_drive", PUSH[:6], True),
        ("ak", b"", False),
        ("ak", PUSH + bytes(1), False),
        ("vendor", b"", True),
        ("open_drive", b"", False),
    ],
)
def test_short_and_remote_frames_are_ignored_or_filled_with_what_is_left_of_the_frame_before(name, data, is_command):
    motor = motor_of(name, timeout=0.01)
    play(motor, ENTER, PUSH)
    for _ in range(20):
        motor.advance(0.0, 0.0, 0.001)
    assert (play(motor, data)[0] is not None) is is_command
    assert motor.torque(0.0, 0.0) == pytest.approx(2.0 * is_command, abs=STEP)


def test_a_v3_board_of_image_3_2_reads_its_torque_by_the_firmwares_constant_and_1_35_times_it_by_the_rated_ones():
    motor = SimulatedMotor(V3_JOINT, FIRMWARES["v3_2"])
    motor.receive(V3_JOINT.command(2.0, 0.0), 0.0, 0.0, 0.0)
    assert motor.torque(0.0, 0.0) == pytest.approx(2.0, abs=STEP)
    status = motor.status(0.0, 0.0)[1]
    assert V3_JOINT.sample(status, 0.0).effort == pytest.approx(2.0, abs=STEP)
    by_rated = replace(V3_JOINT, spec=replace(V3_JOINT.spec, torque_per_ampere=3.0 / 7.4))
    assert by_rated.sample(status, 0.0).effort == pytest.approx(2.0 * 3.0 / 7.4 / 0.2997, abs=STEP)


@pytest.mark.parametrize(("name", "is_obeyed"), [("v3", False), ("v3_2", True), ("v3_query", True)])
def test_a_broadcast_reaches_every_board_of_image_3_2(name, is_obeyed):
    device = make_device(FIRMWARES[name], formats=(MIT_V3,) * 4)
    assert device.exchange(EXTENDED | 0x8FF, V3_JOINT.command(1.0, 0.0)) is None
    assert [motor.entered for motor in device.motors] == [is_obeyed] * 4
    device.exchange(EXTENDED | 0x1FF, bytes(4))
    assert not device.powered


@pytest.mark.parametrize(("name", "rate"), [("v3", 500), ("v3_2", 50), ("v3_query", 0)])
def test_status_frames_come_unasked_as_often_as_the_variant_sends_them(name, rate):
    wire = Wire()
    host = wire.open()
    wire.play(make_device(FIRMWARES[name], formats=(MIT_V3,) * 4))
    wire.clock.sleep(1.0)
    count = 0
    while host.recv(0.0):
        count += 1
    assert count == pytest.approx(4 * rate, abs=4)


def test_with_its_configuration_cable_a_v3_board_reports_and_ignores_commands():
    motor = SimulatedMotor(V3_JOINT)
    motor.cable = True
    motor.receive(V3_JOINT.command(1.0, 0.0), 0.0, 0.0, 0.0)
    assert not motor.entered and motor.status(0.0, 0.0) is not None


def test_a_firmware_of_other_boards_is_refused_by_name():
    with pytest.raises(
        ParameterError, match=r"firmware\.variant = 'vendor': must be one of usual, v3, v3_2, v3_query for"
    ):
        SimulatedMotor(V3_JOINT, FIRMWARES["vendor"])


def values(**given: object) -> dict[str, object]:
    named = {name.replace("__", "."): value for name, value in given.items()}
    return values_of(SIMULATOR, {"can.interface": "virtual", "can.channel": "wire", **named})


def test_parameters_choose_the_firmware_of_each_motor_and_change_it():
    device = device_of(values(firmware__variant=["usual", "vendor", "open_drive", "ak"]))
    assert [motor.firmware.timeout for motor in device.motors] == [0.0, 0.0, 0.025, 0.0]
    assert [motor.firmware.reply_length for motor in device.motors] == [8, 8, 7, 8]
    device = device_of(values(firmware__variant=["open_drive"] * 4, firmware__timeout=0.3, reply_length=6))
    assert {(motor.firmware.timeout, motor.firmware.reply_length) for motor in device.motors} == {(0.3, 6)}


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
    set_faults(device, given, {"trunk.pitch"})
    assert None not in [device.exchange(can_id, ZERO) for can_id in (1, 2, 3, 4)]
    assert [motor.entered for motor in device.motors] == [True, False, False, True]


def test_a_motor_that_gives_its_rated_torque_warms_by_its_rise_and_cools_again():
    motor = SimulatedMotor(JointMotor(SPEC, 3), Firmware(), Heat(rise=60.0, time=100.0))
    play(motor, ENTER, pack_command(SPEC, 0.0, 0.0, 0.0, 0.0, SPEC.rated_torque))
    for _ in range(100):
        motor.advance(0.0, 0.0, 1.0)
    assert motor.temperature == pytest.approx(30.0 + 60.0 * 0.632, abs=0.5)
    play(motor, EXIT)
    for _ in range(1000):
        motor.advance(0.0, 0.0, 1.0)
    assert motor.temperature == pytest.approx(30.0, abs=0.1)


def test_a_weak_motor_gives_less_than_it_reports():
    motor = motor_of("ak")
    motor.strength = 0.8
    assert unpack_reply(SPEC, play(motor, ENTER, PUSH)[1]).torque == pytest.approx(2.0, abs=STEP)
    assert motor.torque(0.0, 0.0) == pytest.approx(1.6, abs=STEP)
