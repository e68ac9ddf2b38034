"""What CONTRIBUTING's "Add a motor" and "Add a wire format" say, done in this process, and an arm carried with it.

    python -m test.support.added_motor motor|format

It is a process of its own because tables of parameters list the motors and formats when they are imported: so the entry
is made as in the source, before anything else is imported. Prints what came of it as JSON.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import Any

from exo_gravity.core.motors import wire_formats
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import (
    COMMAND,
    OTHER,
    REPLY,
    MotorCommand,
    MotorSpec,
    WireFormat,
    pack_fields,
    unpack_fields,
)

# Figures for this test: who adds the motor takes them from its manual.
AK70 = MotorSpec(
    "AK70-10",
    velocity_range=50.0,
    torque_range=25.0,
    v3_ranges=None,
    rated_torque=8.3,
    peak_torque=24.8,
    gear_ratio=10,
    pole_pairs=21,
    torque_per_ampere=8.3 / 7.2,
    rotor_inertia=4.1e-3,
)
ORDER = ("torque", "position", "velocity", "kp", "kd")


class SwappedFormat(WireFormat):
    """The frames of V1 and V2 boards, with the torque first, and with replies on IDs of their own."""

    def reply_id(self, motor_id: int) -> int:
        return 0x200 | motor_id

    @staticmethod
    def pack_command(spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float) -> bytes:
        values = {"position": position, "velocity": velocity, "kp": kp, "kd": kd, "torque": torque}
        return pack_fields(spec, **{name: values[name] for name in ORDER}).to_bytes(8, "big")

    @staticmethod
    def unpack_command(spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
        values = unpack_fields(spec, int.from_bytes(data, "big"), *ORDER)
        return MotorCommand(**dict(zip(ORDER, values, strict=True)))

    def classify(
        self, frame_id: int, data: bytes | bytearray, motor_ids: frozenset[int], is_remote: bool = False
    ) -> tuple[str, int]:
        if frame_id in motor_ids:
            return COMMAND, frame_id
        motor_id = frame_id - 0x200
        return (REPLY, motor_id) if motor_id in motor_ids and len(data) == 8 else (OTHER, 0)


def add_motor() -> dict[str, Any]:
    """Add the motor, without and with V3 boards; return how an arm is carried with both, or why it is refused."""
    MOTORS["AK70-10"], MOTORS["AK70-10 V3"] = AK70, replace(AK70, name="AK70-10 V3", v3_ranges=(60.0, 25.0))
    found = carried(
        {"motor": ["AK70-10", "AK80-9", "AK70-10 V3", "AK60-6"], "wire_format": ["mit", "mit", "mit_v3", "mit"]}
    )
    try:
        carried({"motor": ["AK70-10"] * 4, "wire_format": ["mit_v3"] * 4})
    except ValueError as error:  # `ParameterError`
        found["refusal"] = str(error)
    return found


def add_format() -> dict[str, Any]:
    """Add the wire format; return how an arm with it is carried."""
    wire_formats.FORMATS["swapped"] = SwappedFormat("swapped")
    return carried({"wire_format": ["swapped", "mit", "swapped", "mit_v3"]})


def carried(given: dict[str, Any]) -> dict[str, Any]:
    """Carry the simulated arm that these parameters describe for a second, in virtual time, and let it down."""
    from exo_gravity.core.arm.gravity import gravity_torque
    from exo_gravity.core.motors.joint_motor import motors_of
    from exo_gravity.core.params import values_of
    from exo_gravity.core.safety.drive import Efforts, State
    from exo_gravity.core.safety.limits import CAN_BRIDGE, check_bridge, limits_of
    from exo_gravity.sim.params import SIMULATOR, device_of
    from exo_gravity.sim.virtual_arm import VirtualArm

    given = {"can.interface": "virtual", "can.channel": "wire", **given}
    values = values_of(
        CAN_BRIDGE, {**given, "rate": 100.0, "sign_check_torque": 0.0, "max_effort": [3.0, 9.0, 3.0, 3.0]}
    )
    motors, limits = motors_of(values), limits_of(values)
    check_bridge(values["rate"], motors, limits)
    device = device_of(values_of(SIMULATOR, given))

    class Holding:
        """Asks for what holds the device where it is."""

        def efforts(self, latest: float) -> Efforts:
            held = gravity_torque(device.arm.config.links, device.arm.positions)
            return Efforts(tuple(held), arm.now, damped=False, held=False)

        def take(self, now: float, samples: Any) -> None:
            pass

    arm = VirtualArm(device, Holding(), motors, limits, values["rate"])
    safety = arm.safety
    arm.enable()
    arm.run_until(lambda: safety.state is State.ACTIVE, 5.0)
    state, is_on = safety.state.value, [motor.entered for motor in device.motors]
    safety.disable(arm.now)
    arm.run_until(lambda: arm.loop.is_off, 20.0)
    arm.bus.stop()
    return {
        "state": state,
        "fault": safety.fault and safety.fault.reason,
        "on": is_on,
        "off": arm.loop.is_off and not device.powered,
        "ignored": dict(arm.bus.ignored),
        "home_tolerance": limits.home_tolerance,
        "peak": [motor.peak_effort for motor in motors],
        "rotors": list(device.arm.config.rotor_inertia),
        "most": next(param.bounds for param in CAN_BRIDGE if param.name == "max_effort"),
    }


if __name__ == "__main__":
    print(json.dumps({"motor": add_motor, "format": add_format}[sys.argv[1]]()))
