# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated device with default motors, and the frames that a bridge sends to it."""

from collections.abc import Sequence
from typing import Any

import can

from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import WireFormat, pack_command
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.command import Command, Send
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor

SPECS = [MOTORS[name] for name in ("AK60-6", "AK80-9", "AK60-6", "AK60-6")]
OFF = Command.off(len(SPECS))
RAISED = (0.3, 0.8, 0.7, 0.6)  # rad


def make_device(
    firmware: Firmware | None = None,
    ids: Sequence[int] = (1, 2, 3, 4),
    config: ArmConfig | None = None,
    formats: Sequence[WireFormat] = (MIT,) * 4,
) -> SimulatedDevice:
    joints = joints_of(formats, ids)
    return SimulatedDevice(SimulatedArm(config), [SimulatedMotor(joint, firmware) for joint in joints])


def joints_of(formats: Sequence[WireFormat], ids: Sequence[int] = (1, 2, 3, 4)) -> tuple[JointMotor, ...]:
    """Return the default motors with boards of these formats."""
    columns = zip(SPECS, ids, formats, strict=True)
    return tuple(
        JointMotor(wire_format.ranged(spec), can_id, wire_format=wire_format) for spec, can_id, wire_format in columns
    )


def command_of(effort: Sequence[float], damping: Sequence[float] = NO_TORQUE) -> Command:
    """Return the command of motors that are on, all of them for sure. effort: (4,) Nm, damping: (4,) Nm s/rad."""
    return Command(tuple(effort), tuple(damping), (Send.COMMAND,) * len(SPECS), True)


def sending(send: Send, command: Command = OFF) -> Command:
    """Return `command` with the same frame for all motors, which may be on."""
    return command._replace(send=(send,) * len(command.send), powered=True)


def command(joint: int, torque: float = 0.0, kd: float = 0.0) -> bytes:
    """Return the data of a command to the motor of `joint`; torque: Nm, kd: Nm s/rad."""
    return pack_command(SPECS[joint], 0.0, 0.0, 0.0, kd, torque)


def frame(can_id: int, data: bytes | None, **changes: Any) -> can.Message:
    """Return a CAN message with an 11-bit ID."""
    return can.Message(**{"arbitration_id": can_id, "data": data, "is_extended_id": False, **changes})
