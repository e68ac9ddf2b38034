# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A laboratory's own motor, term and law, in its own distribution: what CONTRIBUTING says, and no more.

Its board speaks MIT mode with the torque first, and replies with IDs of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.laws import LawData
from exo_gravity.core.compensation.terms.catalogue import TermParameters, TermState
from exo_gravity.core.motors.frames import (
    COMMAND,
    OTHER,
    REPLY,
    Family,
    MotorCommand,
    MotorReply,
    MotorSpec,
    WireFormat,
    pack_fields,
    state_of,
    unpack_fields,
)
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import owned
from exo_gravity.sim.motors.ak import SimulatedMotor

ORDER = ("torque", "position", "velocity", "kp", "kd")
MOTOR = MotorSpec(
    "OUR-1",
    "our_lab",
    velocity_range=20.0,
    torque_range=60.0,
    rated_torque=12.0,
    peak_torque=50.0,
    rated_speed=8.0,
    no_load_speed=12.0,
    gear_ratio=20,
    pole_pairs=7,
    torque_per_ampere=1.5,
    rotor_inertia=4e-3,
    output_encoder=False,
    can_fd=False,
    shuts_off_at=110.0,
    source="our own tests",
)


@dataclass(frozen=True)
class OurFormat(WireFormat):
    """The frames of our board."""

    def reply_id(self, motor_id: int, master_id: int = 0) -> int:
        return 0x200 | motor_id

    @staticmethod
    def pack_command(spec: MotorSpec, position: float, velocity: float, kp: float, kd: float, torque: float) -> bytes:
        values = {"position": position, "velocity": velocity, "kp": kp, "kd": kd, "torque": torque}
        return pack_fields(spec, **{name: values[name] for name in ORDER}).to_bytes(8, "big")

    @staticmethod
    def unpack_command(spec: MotorSpec, data: bytes | bytearray) -> MotorCommand:
        values = unpack_fields(spec, int.from_bytes(data, "big"), *ORDER)
        return MotorCommand(**dict(zip(ORDER, values, strict=True)))

    def pack_reply(self, spec: MotorSpec, reply: MotorReply, on: bool) -> bytes:
        return state_of(spec, reply) + bytes((reply.temperature or 0, reply.error or 0, reply.motor_id))

    def unpack_reply(self, spec: MotorSpec, motor_id: int, data: bytes | bytearray) -> MotorReply:
        position, velocity, torque = unpack_fields(
            spec, int.from_bytes(data[:5], "big"), "position", "velocity", "torque"
        )
        return MotorReply(motor_id, position, velocity, torque, data[5], data[6])

    def error_text(self, error: int) -> str:
        return f"see page {error} of our manual"

    def classify(
        self, frame_id: int, data: bytes | bytearray, reply_ids: Mapping[int, int], is_remote: bool = False
    ) -> tuple[str, int]:
        if frame_id in reply_ids:
            return COMMAND, frame_id
        motor_id = frame_id - 0x200
        return (REPLY, motor_id) if motor_id in reply_ids and len(data) == 8 else (OTHER, 0)


class OurSimulatedMotor(SimulatedMotor):
    """A motor that behaves as an AK motor of which only the frames are known."""


FAMILY = Family("our_lab", {MOTOR.name: MOTOR}, {"ours": OurFormat("ours", "our_lab")})


@dataclass(frozen=True)
class Push(TermParameters):
    """A constant torque."""

    effort: Sequence[float] = owned((0.0,) * JOINT_COUNT, "torque; 0: off", (-3.0, 3.0), "Nm")

    def torque(self, _state: TermState) -> tuple[float, ...]:
        """Return the constant torques, (n,) in Nm."""
        return tuple(self.effort)


@dataclass(frozen=True)
class Half:
    """A law that carries half of the arm."""

    arm: Arm

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        return ""

    def torque(self, theta: Sequence[float], tilt: Tilt) -> tuple[float, ...]:
        return tuple(0.5 * effort for effort in self.arm.torque(theta, tilt))


def half(given: LawData) -> Half:
    """Return the law for the settings in force."""
    return Half(given.arm)
