# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The paper's arm as everything that carries an arm needs it (`Arm`): its data, closed forms, with NumPy alone."""

from collections.abc import Mapping, Sequence

from exo_gravity.core.arm.arm_data import ArmData
from exo_gravity.core.arm.gravity import NO_TORQUE, exact_torque, gravity_torque, moments_of
from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.kinematics import LinkInertia, links_of, turning_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector


class ArmModel(ArmData):
    """The paper's arm of Table 1; `ArmData` says what it is made of, `interface.Arm` what each method is for."""

    torque = exact_torque
    torques = gravity_torque
    turning_torque = turning_torque

    @property
    def given_mass(self) -> float:
        """Kg: all of it."""
        return self.total_mass

    @property
    def has_hand(self) -> bool:
        """True: a load is held at the end of link 4."""
        return True

    @property
    def links(self) -> LinkInertia:
        """The inertia, with the usual rotors; approximate if the arm is given by its moments."""
        return links_of(self)

    def worn_links(self, mass: Vector, cog: Vector) -> LinkInertia:
        """Return the inertia with the wearer's segments, (4,) kg at (4,) m along their links, as rods of their own."""
        return self.links.joined_with(links_of(ArmModel(self.length, cog, mass)))

    @property
    def facts(self) -> Mapping[str, Sequence[float] | None]:
        """Masses and centres of gravity of the links, None if only the moments are known, and the moments."""
        mass, cog = (None, None) if self.by_moments else (self.mass.tolist(), self.cog.tolist())
        return {"mass (kg)": mass, "cog (m)": cog, "moments (kg m)": moments_of(self).tolist()}

    def massless(self, gravity: float) -> "ArmModel":
        """Return an arm with these links, without any mass, with gains of 1, where gravity is `gravity` m/s^2."""
        return type(self).from_moments(self.length, NO_TORQUE, gravity=gravity)


def papers(arm: Arm) -> ArmModel:
    """Return `arm` as the paper's arm, for what no other arm has. Raises ParameterError if it is another one."""
    if not isinstance(arm, ArmModel):
        raise ParameterError("law", "urdf", "exact: this is for the paper's arm alone")
    return arm
