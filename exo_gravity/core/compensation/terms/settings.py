"""The parameters of all terms.

A new term is one file, an entry of `GROUPS`, a field of `TermSettings` and an item in `Terms._build`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.coupling import Coupling
from exo_gravity.core.compensation.terms.damping import Damping
from exo_gravity.core.compensation.terms.friction import Friction
from exo_gravity.core.compensation.terms.inertia import Inertia
from exo_gravity.core.compensation.terms.link_inertia import LinkInertia
from exo_gravity.core.compensation.terms.shaper import Shaping
from exo_gravity.core.compensation.terms.soft_limits import SoftLimits
from exo_gravity.core.compensation.terms.spring import PosePath, Spring
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.params import Param, params_of

Row = Sequence[float]
GROUPS: dict[str, type[Any]] = {
    "terms": Shaping,
    "friction": Friction,
    "inertia": Inertia,
    "damping": Damping,
    "spring": Spring,
    "coupling": Coupling,
    "limits": SoftLimits,
    "assist": Assist,
}


@dataclass(frozen=True)
class TermSettings:
    """The parameters of every term; the name of a field is the prefix of its parameters."""

    terms: Shaping = field(default_factory=Shaping)
    friction: Friction = field(default_factory=Friction)
    inertia: Inertia = field(default_factory=Inertia)
    damping: Damping = field(default_factory=Damping)
    spring: Spring = field(default_factory=Spring)
    coupling: Coupling = field(default_factory=Coupling)
    limits: SoftLimits = field(default_factory=SoftLimits)
    assist: Assist = field(default_factory=Assist)

    def check(self, robot: ArmModel) -> None:
        """Raise ParameterError unless every spring and damper is stable on `robot`, without a wearer in it."""
        on = [term for term in (self.damping, self.spring, self.coupling, self.limits) if term.on]
        if not on and not self.inertia.on:
            return
        if robot.by_moments:
            robot.check_masses("terms that depend on the inertia")
        least = least_inertia(*(tuple(a.tolist()) for a in (robot.length, robot.cog, robot.mass)), self.inertia.rotor)
        for term in on:
            term.check(least)


@lru_cache(maxsize=8)
def least_inertia(length: Row, cog: Row, mass: Row, rotor: Row) -> tuple[float, ...]:
    """Return the least inertia (4,) in kg m^2 that each joint of a robot feels."""
    return LinkInertia(ArmModel(length, cog, mass), rotor).least()


def term_parameters() -> tuple[Param, ...]:
    """Return the parameters of all terms, with their prefixes."""
    return tuple(
        replace(param, name=f"{prefix}.{param.name}") for prefix, owner in GROUPS.items() for param in params_of(owner)
    )


def term_settings_of(values: Mapping[str, Any], path: PosePath | None = None) -> TermSettings:
    """Return the settings that parameter values describe, or raise ParameterError; path: of the spring."""
    groups: dict[str, Any] = {}
    for prefix, owner in GROUPS.items():
        given = {param.name: values[f"{prefix}.{param.name}"] for param in params_of(owner)}
        if owner is Spring:
            given["path"] = path
        try:
            groups[prefix] = owner(**given)
        except ParameterError as error:
            name = error.name if "." in error.name else f"{prefix}.{error.name}"
            raise ParameterError(name, error.value, error.expected) from None
    return TermSettings(**groups)
