"""The parameters of all terms.

A new term is an entry of `GROUPS`, a field of `TermSettings`, and an item in `Terms._build`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.friction_inertia import Friction, Inertia
from exo_gravity.core.compensation.terms.springs import Coupling, Damping, SoftLimits, Spring
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.kinematics import LinkInertia
from exo_gravity.core.params import Param, params_of

Row = Sequence[float]
GROUPS: dict[str, type[Any]] = {
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

    friction: Friction = field(default_factory=Friction)
    inertia: Inertia = field(default_factory=Inertia)
    damping: Damping = field(default_factory=Damping)
    spring: Spring = field(default_factory=Spring)
    coupling: Coupling = field(default_factory=Coupling)
    limits: SoftLimits = field(default_factory=SoftLimits)
    assist: Assist = field(default_factory=Assist)

    def on_arm(self, robot: ArmModel) -> TermSettings:
        """Return these settings with limits as stiff as `robot` can bear.

        Raises ParameterError unless every spring and damper is stable on `robot`, without a wearer in it.
        """
        on = [term for term in (self.damping, self.spring, self.coupling) if term.on]
        if not (on or self.limits.on or self.inertia.on):
            return self
        if robot.by_moments:
            robot.check_masses("terms that depend on the inertia")
        least = least_inertia(*(tuple(a.tolist()) for a in (robot.length, robot.cog, robot.mass)))
        for term in on:
            term.check(least)
        return replace(self, limits=self.limits.on_arm(least))


@lru_cache(maxsize=8)
def least_inertia(length: Row, cog: Row, mass: Row) -> tuple[float, ...]:
    """Return the least inertia (4,) in kg m^2 that each joint of a robot feels."""
    return LinkInertia.of(ArmModel(length, cog, mass)).least()


def term_parameters() -> tuple[Param, ...]:
    """Return the parameters of all terms, with their prefixes."""
    return tuple(
        replace(param, name=f"{prefix}.{param.name}") for prefix, owner in GROUPS.items() for param in params_of(owner)
    )


def term_settings_of(values: Mapping[str, Any]) -> TermSettings:
    """Return the settings that parameter values describe, or raise ParameterError."""
    groups: dict[str, Any] = {}
    for prefix, owner in GROUPS.items():
        try:
            groups[prefix] = owner(**{param.name: values[f"{prefix}.{param.name}"] for param in params_of(owner)})
        except ParameterError as error:
            name = error.name if "." in error.name else f"{prefix}.{error.name}"
            raise ParameterError(name, error.value, error.expected) from None
    return TermSettings(**groups)
