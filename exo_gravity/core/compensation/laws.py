"""The laws by which the torque that holds an arm can be computed, by name.

A law is an object with two methods, and its entry in `LAWS` is what makes it for the settings in force. A law that does
not apply in every pose says where it does not: the compensator then carries the arm by the exact law.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from exo_gravity.core.arm.anfis import AnfisLaw
from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import Torque, exact_torque, mobile_torque, static_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError


class Law(Protocol):
    """How the torque that holds one arm of n joints is computed."""

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return why the law does not apply at `theta` (n,) rad and `tilt`, in a sentence; '' if it does.

        The sentence contains no measured value, so it stays the same as long as the reason does.
        """
        ...

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm at `theta` (n,) rad; meaningless where `outside` gives a reason."""
        ...


class GravityModel(Protocol):
    """An arm of n joints whose torques come from outside `core`: `hardware.urdf_arm.UrdfArm`."""

    max_effort: tuple[float, ...]  #: the joints' own limits, (n,) Nm; 0 if not known
    mass: float  #: kg that the joints carry

    @property
    def fixed(self) -> tuple[str, ...]:
        """Other joints on which the torque depends, and which are taken to be at 0."""
        ...

    def follow(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take the positions (m,) of all joints that are reported, by name; raises ParameterError if one is missing."""
        ...

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm at `theta` (n,) rad; gravity: (3,) m/s^2 in the root link's axes."""
        ...


@dataclass(frozen=True)
class ArmLaw:
    """A law of the exoskeleton's own arm: a formula, and where it does not apply."""

    arm: ArmModel
    formula: Callable[[ArmModel, Sequence[float], Tilt], Torque]
    limits: Callable[[ArmModel, Sequence[float], Tilt], str] | None = None  #: why not here, or ''; None: everywhere

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return why the formula does not apply here, or ''; theta: (4,) rad."""
        return self.limits(self.arm, theta, tilt) if self.limits else ""

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (4,) in Nm at `theta` (4,) rad."""
        return self.formula(self.arm, theta, tilt)


@dataclass(frozen=True)
class UrdfLaw:
    """The torque of any serial arm, from its URDF; it applies everywhere."""

    model: GravityModel
    gain: Sequence[float]  #: scales the torque, (n,)
    gravity: float  #: m/s^2

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return ''."""
        return ""

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm at `theta` (n,) rad; tilt: of the root link, like that of the left arm."""
        torque = self.model.torque(theta, [self.gravity * component for component in tilt.gravity_in_trunk])
        return tuple([gain * tau for gain, tau in zip(self.gain, torque, strict=True)])


class LawData(Protocol):
    """What a law can be made of: the compensator's `Settings`."""

    @property
    def arm(self) -> ArmModel:
        """The exoskeleton's own arm, with what it carries."""
        ...

    @property
    def anfis(self) -> AnfisLaw | None:
        """The model in `anfis_file`, if it is given."""
        ...

    @property
    def urdf(self) -> UrdfLaw | None:
        """The law of another arm, known by its URDF; then there is no `arm`."""
        ...


def _paper_static(given: LawData) -> Law:
    given.arm.check_masses("law paper_static")
    return ArmLaw(given.arm, static_torque)


def _paper_mobile(given: LawData) -> Law:
    given.arm.check_masses("law paper_mobile")
    return ArmLaw(given.arm, mobile_torque)


def _anfis(given: LawData) -> Law:
    if given.anfis is None:
        raise ParameterError("law", "anfis", "used with anfis_file, a model from train_anfis")
    given.arm.check_masses("law anfis")
    return ArmLaw(given.arm, given.anfis.torque, given.anfis.outside)


def _urdf(given: LawData) -> Law:
    if given.urdf is None:
        raise ParameterError("law", "urdf", "chosen at the start, with an arm from a URDF")
    return given.urdf


#: what makes each law, by name. Raises ParameterError where the law does not cover such an arm
LAWS: dict[str, Callable[[LawData], Law]] = {
    "exact": lambda given: ArmLaw(given.arm, exact_torque),
    "paper_static": _paper_static,
    "paper_mobile": _paper_mobile,
    "anfis": _anfis,
    "urdf": _urdf,
}
