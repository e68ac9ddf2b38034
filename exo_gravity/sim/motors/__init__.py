# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated motors, a family a file: they behave as their firmware does.

Those of other distributions' families are found by the entry point group GROUP: its name is that of the family, and it
leads to a class like `ak.SimulatedMotor`, whose arguments are a joint's motor, its firmware and how it warms.
"""

from collections.abc import Mapping

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors import ak as ak_family
from exo_gravity.core.motors import damiao as damiao_family
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.params import installed, loaded
from exo_gravity.sim.motors.ak import Firmware, Heat, SimulatedMotor
from exo_gravity.sim.motors.damiao import DamiaoMotor

GROUP = "exo_gravity.simulated_motors"
OURS: Mapping[str, type[SimulatedMotor]] = {
    ak_family.FAMILY: SimulatedMotor,
    damiao_family.FAMILY: DamiaoMotor,
}


def class_of(family: str) -> type[SimulatedMotor]:
    """Return what simulates the motors of a family. Raises ParameterError if nothing does."""
    if family in OURS:
        return OURS[family]
    if family not in installed(GROUP):
        raise ParameterError("motor", family, f"of a family with an entry point of {GROUP}, to be simulated")
    found: type[SimulatedMotor] = loaded(GROUP, family, "simulated motor")
    return found


def simulated(joint: JointMotor, firmware: Firmware | None = None, heat: Heat | None = None) -> SimulatedMotor:
    """Return the simulated motor of a joint; arguments as those of `SimulatedMotor`. Raises ParameterError."""
    return class_of(joint.spec.family)(joint, firmware, heat)
