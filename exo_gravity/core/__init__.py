# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mathematics: standard library and NumPy only. No ROS, no input or output, no clock (time is an argument).

The names are imported when they are used: a node or a tool imports only what it needs from the modules below.
"""

from typing import TYPE_CHECKING

from exo_gravity.core.names import imported_when_used

if TYPE_CHECKING:
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
MODULES = {
    "arm.interface": ("STANDARD_GRAVITY",),
    "arm.paper": ("ArmModel", "gravity_torque", "paper_mobile_torque", "paper_static_torque"),
    "arm.tilt": ("Tilt",),
    "arm.wearer": ("Wearer",),
    "compensation.laws": ("LAWS",),
}
__getattr__ = imported_when_used(__name__, MODULES)


def __dir__() -> list[str]:
    """Return the names, also those not imported yet: the documents list what is here."""
    return __all__
