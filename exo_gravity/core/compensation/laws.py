# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The laws by which the torque that holds an arm can be computed, by name.

A law is an object with two methods, and its entry in `LAWS` is what makes it for the settings in force. A law that does
not apply in every pose says where it does not: the compensator then carries the arm by the exact law.

A laboratory's own law needs no fork: a distribution that names what makes it under the entry point group GROUP is found
here, as `anfis` of this one is (exo_gravity/lab/anfis.py). To look entry points up takes a tenth of a second: the
compensator does it at its start (`installed`), so that no change of law holds up its cycle. Terms of others are found
in the same way (terms/terms.py).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.paper import ArmModel, mobile_torque, static_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import Torque
from exo_gravity.core.params import installed, loaded

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


Maker = Callable[[LawData], Law]


class Laws(dict[str, Maker]):
    """What makes each law, by name. Raises ParameterError where the law does not cover such an arm."""

    by_moments = ("exact", URDF_LAW)  #: laws that need neither masses nor centres of gravity

    def __missing__(self, name: str) -> Maker:
        """Return what makes the law `name` of another distribution. Raises KeyError, ParameterError."""
        maker: Maker = loaded(GROUP, name, "law")
        return maker

    def __contains__(self, name: object) -> bool:
        """Return whether the law `name` is known, or a distribution has it."""
        return super().__contains__(name) or name in installed(GROUP)


LAWS = Laws(
    {
        "exact": lambda given: ExactLaw(given.arm),
        "paper_static": lambda given: ArmLaw(given.arm.with_masses("paper_static"), static_torque),
        "paper_mobile": lambda given: ArmLaw(given.arm.with_masses("paper_mobile"), mobile_torque),
        "anfis": lambda given: loaded(GROUP, "anfis", "law")(given),
        URDF_LAW: lambda given: ExactLaw(given.arm),
    }
)
