"""The paper's arm as an `Arm`: its closed forms, with NumPy alone."""

from collections.abc import Mapping, Sequence

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE, exact_torque, moments_of
from exo_gravity.core.arm.kinematics import LinkInertia, links_of, turning_torque


class PaperArm(ArmModel):
    """An `ArmModel` that a compensator can carry."""

    torque = exact_torque
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

    @property
    def facts(self) -> Mapping[str, Sequence[float] | None]:
        """Masses and centres of gravity of the links, None if only the moments are known, and the moments."""
        mass, cog = (None, None) if self.by_moments else (self.mass.tolist(), self.cog.tolist())
        return {"mass (kg)": mass, "cog (m)": cog, "moments (kg m)": moments_of(self).tolist()}

    def massless(self, gravity: float) -> "PaperArm":
        """Return an arm with these links, without any mass, with gains of 1, where gravity is `gravity` m/s^2."""
        return type(self).from_moments(self.length, NO_TORQUE, gravity=gravity)
