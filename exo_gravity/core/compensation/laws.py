# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The laws by which the torque that holds an arm can be computed, by name.

A law is an object with two methods, and its entry in `LAWS` is what makes it for the settings in force. A law that does
not apply in every pose says where it does not: the compensator then carries the arm by the exact law.

A laboratory's own law needs no fork: a distribution that names what makes it under the entry point group GROUP is found
here, as `anfis` of this one is (exo_gravity/lab/anfis.py). Entry points are looked up when such a law is chosen: an
ordinary start does not pay for them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.paper import ArmModel, mobile_torque, static_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.numbers import Torque

GROUP = "exo_gravity.laws"
URDF_LAW = "urdf"  # the exact law of an arm from a URDF


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


@dataclass(frozen=True)
class ExactLaw:
    """The arm's own torque, which is exact in every pose."""

    arm: Arm

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return ''."""
        return ""

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm at `theta` (n,) rad."""
        return self.arm.torque(theta, tilt)


@dataclass(frozen=True)
class ArmLaw:
    """A law of the paper's arm: a formula, and where it does not apply."""

    arm: ArmModel
    formula: Callable[[ArmModel, Sequence[float], Tilt], Torque]
    limits: Callable[[ArmModel, Sequence[float], Tilt], str] | None = None  #: why not here, or ''; None: everywhere

    def outside(self, theta: Sequence[float], tilt: Tilt) -> str:
        """Return why the formula does not apply here, or ''; theta: (4,) rad."""
        return self.limits(self.arm, theta, tilt) if self.limits else ""

    def torque(self, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (4,) in Nm at `theta` (4,) rad."""
        return self.formula(self.arm, theta, tilt)


class LawData(Protocol):
    """What a law can be made of: the compensator's `Settings`."""

    @property
    def arm(self) -> Arm:
        """The arm, with what it carries."""
        ...

    @property
    def trained(self) -> str:
        """The text of the file that a law was trained into; '' if none is given."""
        ...


def with_masses(arm: Arm, law: str) -> ArmModel:
    """Return the paper's arm, for a law that needs its masses. Raises ParameterError."""
    if not isinstance(arm, ArmModel):
        raise ParameterError("law", law, f"{URDF_LAW} for an arm from a URDF")
    arm.check_masses(f"law {law}")
    return arm


def _paper_static(given: LawData) -> Law:
    return ArmLaw(with_masses(given.arm, "paper_static"), static_torque)


def _paper_mobile(given: LawData) -> Law:
    return ArmLaw(with_masses(given.arm, "paper_mobile"), mobile_torque)


def _urdf(given: LawData) -> Law:
    if isinstance(given.arm, ArmModel):
        raise ParameterError("law", URDF_LAW, "chosen at the start, with an arm from a URDF")
    return ExactLaw(given.arm)


Maker = Callable[[LawData], Law]


class Laws(dict[str, Maker]):
    """What makes each law, by name. Raises ParameterError where the law does not cover such an arm."""

    def __missing__(self, name: str) -> Maker:
        """Return what makes the law `name` of another distribution. Raises KeyError, DataError."""
        self[name] = maker = _entry(name)
        return maker

    def __contains__(self, name: object) -> bool:
        """Return whether the law `name` is known, or another distribution has it."""
        try:
            return bool(self[str(name)])
        except KeyError:
            return False


def _entry(name: str) -> Maker:
    """Return what makes the law of the entry point `name`. Raises KeyError, DataError if it does not load."""
    from importlib.metadata import entry_points  # slow to import

    for entry in entry_points(group=GROUP, name=name):
        try:
            maker: Maker = entry.load()
        except Exception as error:  # the code of others
            raise DataError(f"entry point {entry.name} = {entry.value} of {GROUP}: {error}") from error
        return maker
    raise KeyError(name)


LAWS = Laws(
    {
        "exact": lambda given: ExactLaw(given.arm),
        "paper_static": _paper_static,
        "paper_mobile": _paper_mobile,
        "anfis": lambda given: _entry("anfis")(given),
        URDF_LAW: _urdf,
    }
)
