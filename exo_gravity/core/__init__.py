# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mathematics: standard library and NumPy only. No ROS, no input or output, no clock (time is an argument)."""

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.paper import ArmModel, gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.laws import LAWS

__all__ = [
    "LAWS",
    "STANDARD_GRAVITY",
    "ArmModel",
    "Tilt",
    "Wearer",
    "gravity_torque",
    "paper_mobile_torque",
    "paper_static_torque",
]
