"""The AK60-6 and AK80-9 motors: their limits, their frames, and the load of these on the bus."""

from exo_gravity.core.motors.specs import MOTORS, pack_command, pack_reply, unpack_command, unpack_reply

__all__ = ["MOTORS", "pack_command", "pack_reply", "unpack_command", "unpack_reply"]
