"""Damping: virtual viscosity, as a therapist sets it for resistance. It takes energy, except for what comes late."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.term import DELAY, TermState, check_stable
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.params import check_owned, owned


@dataclass(frozen=True)
class Damping:
    """Parameters of the term `damping`. Raises ParameterError."""

    viscosity: Sequence[float] = owned((0.0,) * 4, "virtual viscous friction; 0: off", (0.0, 5.0), "Nm s/rad")

    def __post_init__(self) -> None:
        check_owned(self)

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return any(self.viscosity)

    def check(self, least_inertia: Sequence[float]) -> None:
        """Raise ParameterError unless the viscosity damps these inertias (4,) kg m^2 although it acts late."""
        check_stable("damping.viscosity", self.viscosity, [i / (2.0 * DELAY) for i in least_inertia], "Nm s/rad")

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm, against the motion."""
        b, v = self.viscosity, state.velocity
        return -b[0] * v[0], -b[1] * v[1], -b[2] * v[2], -b[3] * v[3]
