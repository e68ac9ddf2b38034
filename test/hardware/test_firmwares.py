# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm on the motors of each firmware, in virtual time on a bus with arbitration: judged by what the motors did."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from exo_gravity.core.motors.ak import MIT, USUAL_MOTORS
from exo_gravity.core.motors.families import FORMATS, MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.motors.firmware import FIRMWARES, Firmware

from ..support.copies import prepared
from ..support.thorough import quick
from .carried_arm import (
    ENERGY,
    EVENTS,
    POSE,
    REAL_RATE,
    CarriedArm,
    assert_held_and_let_down,
    assert_switched_on_and_off_without_a_collision,
    cut,
)

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
    assert_switched_on_and_off_without_a_collision(FirmwareArm(FIRMWARES[name], bitrate=1_000_000))


@FIRMWARE
def test_an_arm_is_held_and_let_down(name: str) -> None:
    assert_held_and_let_down(raised_arm(name))


@FIRMWARE
def test_a_torque_that_another_tool_left_in_the_motors_memory_is_not_carried_out(name: str) -> None:
    arm = FirmwareArm(FIRMWARES[name], remembered=4.9)
    arm.carry()
    arm.assert_not_thrown()


# Of stalls, the firmware that takes them worst; Damiao motors that restart are in `test_damiao_arm`.
WORST = [("open_drive", "loop stalls for 75 ms"), ("v3_2", "loop stalls for 120 ms")]


@pytest.mark.parametrize(("name", "event"), quick(WORST, itertools.product(REPLYING, EVENTS)))
def test_whatever_the_firmware_drops_the_motors_drive_no_joint(name: str, event: str) -> None:
    """A motor that has lost its torque lets its joint fall; what counts is what motors drive, then and afterwards."""
    arm = raised_arm(name)
    arm.go_through(EVENTS[event], is_loss="stalls" not in event)
    assert arm.safety.state is State.ACTIVE or arm.safety.fault
    assert not any(motor.dips for motor in arm.device.motors) or arm.safety.fault, "torque was lost without a word"


@pytest.mark.parametrize("motor", [1, 2])
def test_while_a_motor_that_has_lost_its_power_is_late_the_others_stop_driving_their_joints(motor: int) -> None:
    arm = raised_arm("ak")
    arm.go_through(cut(1.0, motor), is_loss=True)
    assert arm.caused.energy < ENERGY, arm.caused


def test_a_board_in_query_reply_mode_is_not_started_and_the_reason_is_told() -> None:
    arm = FirmwareArm(FIRMWARES["v3_query"])
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert "query-reply" in arm.safety.refusal or "no reply" in arm.safety.refusal
    assert not arm.device.powered
