"""The AK60-6 and AK80-9 motors.

specs: their limits, and the frames of MIT mode. wire_formats: the frames of each kind of board. bus_load: the load that
the frames put on the bus. joint_motor: a motor on a joint, and the parameters of `can_bridge` that describe it.
"""

from exo_gravity.core.motors.specs import (
    MOTORS,
    MotorSpec,
    pack_command,
    pack_reply,
    unpack_command,
    unpack_reply,
)

__all__ = ["MOTORS", "MotorSpec", "pack_command", "pack_reply", "unpack_command", "unpack_reply"]
