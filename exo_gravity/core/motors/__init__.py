# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The motors: a record of each type, their frames, and the load of these on the bus. `families` has them all."""

from exo_gravity.core.motors.ak import pack_reply, unpack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import pack_command, unpack_command

__all__ = ["MOTORS", "pack_command", "pack_reply", "unpack_command", "unpack_reply"]
