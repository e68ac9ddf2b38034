# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm on the motors of each firmware, in virtual time on a bus with arbitration: judged by what the motors did."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from exo_gravity.core.motors.ak import MIT, USUAL_MOTORS
from exo_gravity.core.motors.families import FORMATS, MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.motors.firmware import FIRMWARES, Firmware

from ..support.copies import prepared
from ..support.thorough import quick
from .carried_arm import DRIVEN, ENERGY, EVENTS, POSE, REAL_RATE, UNKNOWN_LOSS, CarriedArm, cut

PEAK = (9.0, 18.0, 9.0, 9.0)  # Nm
REPLYING = [name for name in FIRMWARES if name != "v3_query"]
# The farthest from the boards of other tests: its time-out, and who asks for a reply.
FIRMWARE = pytest.mark.parametrize("name", quick(("v3_2",), REPLYING))


def motor_of(firmware: Firmware, name: str, can_id: int) -> JointMotor:
    """Return the motor as a parameter file for this firmware describes it."""
    wire_format = FORMATS[firmware.wire_format or MIT.name]
    spec = wire_format.ranged(MOTORS[name])
    own = {"position_range": firmware.position_range, "torque_per_ampere": firmware.torque_per_ampere.get(name)}
    spec = replace(spec, **{field: value for field, value in own.items() if value})
    return JointMotor(spec, can_id, wire_format=wire_format)


class FirmwareArm(CarriedArm):
    """An arm whose motors have one firmware."""

    def __init__(self, firmware: Firmware, **options: float) -> None:
        joints = [motor_of(firmware, name, 1 + i) for i, name in enumerate(USUAL_MOTORS)]
        usual = replace(firmware, status_rate=500.0)  # as docs/wiring.md asks for
        super().__init__(joints, [SimulatedMotor(joint, usual) for joint in joints], PEAK, **options)


@prepared
def raised_arm(name: str) -> FirmwareArm:
    """Return an arm that the wearer has raised to `POSE` and left to motors with the firmware of this name."""
    arm = FirmwareArm(FIRMWARES[name], rate=REAL_RATE, proves_signs=False)
    arm.carry()
    arm.raise_to(POSE)
    return arm


@FIRMWARE
def test_an_arm_is_switched_on_and_off_without_a_collision(name: str) -> None:
    arm = FirmwareArm(FIRMWARES[name], bitrate=1_000_000)
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.PROVING and arm.safety.waiting_for == "", 5.0)
    arm.run(0.5)
    assert arm.device.powered
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.loop.is_off, 1.0)
    assert not arm.device.powered
    assert arm.wire.collisions == arm.wire.bus_offs == 0


@FIRMWARE
def test_an_arm_is_held_and_let_down(name: str) -> None:
    arm = raised_arm(name)
    arm.run(3.0)
    assert arm.caused.speed < 0.05
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.loop.is_off, 30.0)
    assert not arm.device.powered
    assert arm.caused.speed < DRIVEN and arm.caused.energy < ENERGY


@FIRMWARE
def test_a_torque_that_another_tool_left_in_the_motors_memory_is_not_carried_out(name: str) -> None:
    arm = FirmwareArm(FIRMWARES[name], remembered=4.9)
    arm.carry()
    assert arm.caused.speed < DRIVEN and arm.caused.energy < ENERGY


# Of stalls, the firmware that takes them worst; Damiao motors that restart are in `test_damiao_arm`.
WORST = [("open_drive", "loop stalls for 75 ms"), ("v3_2", "loop stalls for 120 ms")]


@pytest.mark.parametrize(("name", "event"), quick(WORST, itertools.product(REPLYING, EVENTS)))
def test_whatever_the_firmware_drops_the_motors_drive_no_joint(name: str, event: str) -> None:
    """A motor that has lost its torque lets its joint fall; what counts is what motors drive, then and afterwards."""
    arm = raised_arm(name)
    EVENTS[event](arm)
    arm.see_out()
    caused = arm.caused
    speed, energy = (DRIVEN, ENERGY) if "stalls" in event else UNKNOWN_LOSS
    assert caused.speed < speed and caused.energy < energy, caused
    state = arm.safety.state
    dips = sum(motor.dips for motor in arm.device.motors)
    assert state is State.ACTIVE or arm.safety.fault
    assert not dips or arm.safety.fault, "torque was lost without a word"


@pytest.mark.parametrize("motor", [1, 2])
def test_while_a_motor_that_has_lost_its_power_is_late_the_others_stop_driving_their_joints(motor: int) -> None:
    arm = raised_arm("ak")
    cut((motor,), 1.0)(arm)
    arm.see_out()
    assert arm.caused.energy < ENERGY, arm.caused


def test_a_board_in_query_reply_mode_is_not_started_and_the_reason_is_told() -> None:
    arm = FirmwareArm(FIRMWARES["v3_query"])
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert "query-reply" in arm.safety.refusal or "no reply" in arm.safety.refusal
    assert not arm.device.powered


@pytest.mark.thorough
def test_a_motor_with_an_encoder_error_is_never_switched_on_again() -> None:
    arm = raised_arm("ak")
    arm.device.motors[1].error = 5
    arm.run(10.0)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.MOTOR_ERROR
    assert arm.caused.speed < DRIVEN
