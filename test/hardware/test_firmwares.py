"""An arm on the motors of each firmware, in virtual time on a bus with arbitration: judged by what the motors did."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensator
from exo_gravity.core.compensation.controller import DirectController
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS, USUAL_MOTORS
from exo_gravity.core.motors.wire_formats import FORMATS, MIT
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.can.can_port import CanPort
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS, SimulatedArm
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.judge import Driven, driven
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.motors.firmware import FIRMWARES, Firmware
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.truth import TruthRecords
from exo_gravity.sim.virtual_arm import VirtualArm
from exo_gravity.sim.virtual_time import Wire
from exo_gravity.sim.virtual_wearer import VirtualWearer

PEAK = (9.0, 18.0, 9.0, 9.0)  # Nm
RATE = 250.0  # Hz
POSE = [0.0, 0.5, 0.4, 0.6]  # rad
WORN_MASS, WORN_COG = Wearer(75.0).on_links(DEFAULT_LINKS.length)
DRIVEN, ENERGY = 0.6, 0.3  # rad/s and J that motors may cause
# While a motor has no power and it is not yet known, the others push on with the torque of the pose before.
UNKNOWN_LOSS = 1.9, 0.5  # rad/s and J
FIRMWARE = pytest.mark.parametrize("name", [name for name in FIRMWARES if name != "v3_query"])


def motor_of(firmware: Firmware, name: str, can_id: int) -> JointMotor:
    """Return the motor as a parameter file for this firmware describes it."""
    wire_format = FORMATS[firmware.wire_format or MIT.name]
    spec = wire_format.ranged(MOTORS[name])
    own = {"position_range": firmware.position_range, "torque_per_ampere": firmware.torque_per_ampere.get(name)}
    spec = replace(spec, **{field: value for field, value in own.items() if value})
    return JointMotor(spec, can_id, wire_format=wire_format)


class FirmwareArm(DirectController, VirtualArm):
    """The arm of a 75 kg wearer, hanging, in Zero-G; its motors have one firmware. truth: since it was last cleared."""

    def __init__(self, firmware: Firmware, remembered: float = 0.0, bitrate: int = 0) -> None:
        joints = [motor_of(firmware, name, 1 + i) for i, name in enumerate(USUAL_MOTORS)]
        usual = replace(firmware, status_rate=500.0)  # as docs/wiring.md asks for
        config = ArmConfig(wearer_mass=WORN_MASS, wearer_cog=WORN_COG, coulomb_friction=(0.1,) * len(joints))
        device = SimulatedDevice(SimulatedArm(config), [SimulatedMotor(joint, usual) for joint in joints])
        for joint in joints if remembered else ():  # what another tool left in their memory
            for frame in (*joint.enter, (joint.command_id, joint.command(remembered, 0.0)), *joint.exit):
                device.exchange(*frame)
        settings = Settings("right", DEFAULT_LINKS, mode="zero_g", support=1.0, max_effort=PEAK, use_imu=False,
                            wearer_mass=WORN_MASS, wearer_cog=WORN_COG)  # fmt: skip
        limits = Limits(JOINTS, max_effort=PEAK)
        DirectController.__init__(self, Compensator(settings, JOINTS), limits)
        wire = Wire(start=0.0, bitrate=bitrate)
        wire.play(device, tick=None)
        port = CanPort(wire.open(), wire.clock, wire.open)
        VirtualArm.__init__(self, device, self, joints, limits, RATE, wire, [port] * len(joints))
        self.truth = device.truth = TruthRecords()

    def carry(self) -> None:
        """Enable the hanging arm, and run until it is carried."""
        self.enable()
        assert self.run_until(lambda: self.safety.state in (State.ACTIVE, State.FAULT), 30.0), self.safety.waiting_for
        assert self.safety.state is State.ACTIVE, self.safety.fault

    def raise_to(self, pose: list[float]) -> None:
        """Let the wearer bring the arm to a pose, and leave it to the motors."""
        script = TrialScript.parse({"name": "raise", "steps": [{"move": pose, "over": 2.0}]})
        self.device.start(VirtualWearer(script))
        self.run(3.0)
        self.truth = self.device.truth = TruthRecords()

    @property
    def caused(self) -> Driven:
        """What the motors caused."""
        return driven(self.truth.records)


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
    arm = FirmwareArm(FIRMWARES[name])
    arm.carry()
    arm.raise_to(POSE)
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


def cut(joints: tuple[int, ...], duration: float) -> Callable[[FirmwareArm], None]:
    def act(arm: FirmwareArm) -> None:
        for joint in joints:
            arm.device.unplug(joint, duration)

    return act


def stall(duration: float) -> Callable[[FirmwareArm], None]:
    return lambda arm: arm.clock.stall(duration)


EVENTS = {
    "all motors restart in 20 ms": cut((0, 1, 2, 3), 0.02),
    "all motors restart in 80 ms": cut((0, 1, 2, 3), 0.08),
    "supply cut for 3 s": cut((0, 1, 2, 3), 3.0),
    "motor 2 restarts in 30 ms": cut((1,), 0.03),
    "motor 2 loses its power for 1 s": cut((1,), 1.0),
    **{f"loop stalls for {ms} ms": stall(ms / 1000.0) for ms in (20, 40, 60, 75, 120)},
}


# Of each kind of event, the firmware that takes it worst.
WORST = [
    ("open_drive", "loop stalls for 75 ms"),
    ("v3_2", "loop stalls for 120 ms"),
    ("vendor", "all motors restart in 80 ms"),
    ("ak", "motor 2 restarts in 30 ms"),
]
OTHERS = [(name, event) for name in FIRMWARES if name != "v3_query" for event in EVENTS if (name, event) not in WORST]


@pytest.mark.parametrize(
    ("name", "event"), [*WORST, *(pytest.param(*other, marks=pytest.mark.thorough) for other in OTHERS)]
)
def test_whatever_the_firmware_drops_the_motors_drive_no_joint(name: str, event: str) -> None:
    """A motor that has lost its torque lets its joint fall; what counts is what motors drive, then and afterwards."""
    arm = FirmwareArm(FIRMWARES[name])
    arm.carry()
    arm.raise_to(POSE)
    EVENTS[event](arm)
    arm.run_until(lambda: arm.loop.is_off, 12.0)
    caused = arm.caused
    speed, energy = (DRIVEN, ENERGY) if "stalls" in event else UNKNOWN_LOSS
    assert caused.speed < speed and caused.energy < energy, caused
    state = arm.safety.state
    dips = sum(motor.dips for motor in arm.device.motors)
    assert state is State.ACTIVE or arm.safety.fault
    assert not dips or arm.safety.fault, "torque was lost without a word"


def test_a_board_in_query_reply_mode_is_not_started_and_the_reason_is_told() -> None:
    arm = FirmwareArm(FIRMWARES["v3_query"])
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED, 15.0)
    assert "query-reply" in arm.safety.refusal or "no reply" in arm.safety.refusal
    assert not arm.device.powered


def test_a_motor_with_an_encoder_error_is_never_switched_on_again() -> None:
    arm = FirmwareArm(FIRMWARES["ak"])
    arm.carry()
    arm.raise_to(POSE)
    arm.device.motors[1].error = 5
    arm.run(10.0)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.MOTOR_ERROR
    assert arm.caused.speed < DRIVEN
