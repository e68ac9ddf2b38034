"""The terms at work: their parameters, their bounded sum, plus the outer loop's input.

The sum is bounded, rate-limited, and never steps: the difference that a change of parameters makes fades. Whatever is
wrong with the sum, gravity compensation goes on beneath it. A new term is a field of `TermSettings` and an item in
`Terms._build`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from exo_gravity.core.compensation.limiter import LONGEST_STEP, Transition, limited
from exo_gravity.core.compensation.terms.assist import Assist, AssistInput
from exo_gravity.core.compensation.terms.friction_inertia import (
    MAX_FRICTION_SHARE,
    AccelerationFilter,
    EnergyTank,
    Friction,
    Inertia,
    InertiaTerm,
)
from exo_gravity.core.compensation.terms.springs import Coupling, Damping, SoftLimits, Spring, Term, TermState
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import NO_TORQUE, Torque
from exo_gravity.core.model.kinematics import LinkInertia, least_inertia
from exo_gravity.core.params import Param, params_of

MAX_GAP = 0.2  # s between two cycles, beyond which the terms begin again from no torque
MAX_EFFORT = (2.0, 4.0, 2.0, 2.0)  # Nm of all terms: well below the motors' rated torque, which gravity needs
MAX_EFFORT_RATE = 50.0  # Nm/s


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
        least = least_inertia(LinkInertia.of(robot))
        for term in on:
            term.check(least)
        return replace(self, limits=self.limits.on_arm(least))


#: the parameters of each term by the prefix of their names
GROUPS: dict[str, Any] = {own.name: own.default_factory for own in fields(TermSettings)}


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


class Terms:
    """What one compensator adds to gravity compensation.

    names: of the joints (4,). arm: what moves, with known masses, for `inertia`. `assist` is the outer loop's input.
    """

    def __init__(self, names: Sequence[str], settings: TermSettings, arm: ArmModel) -> None:
        self.settings = settings
        self.assist = AssistInput(names, settings.assist)
        self._arm = arm
        self._refusal = ""  # why the sum is not used
        self._output = NO_TORQUE
        self._transition = Transition()
        self._tank = EnergyTank()
        self._acceleration = AccelerationFilter()
        self._time = self._spring_start = -math.inf
        self._pending: tuple[TermSettings, ArmModel] | None = None
        self._active = self._build()
        self._idle = False

    @property
    def active(self) -> list[str]:
        """The names of the terms that are on, and 'assist' if efforts are used."""
        return [name for name in GROUPS if getattr(self.settings, name).on]

    @property
    def energy(self) -> float:
        """Energy in J left in the tank of `inertia`."""
        return self._tank.level

    @property
    def problem(self) -> str:
        """Why the sum of the terms or the outer loop's efforts are not used although they are asked for, or ''."""
        assist = self.assist
        refused = assist.reason if assist.assist.on and assist.state == "refused" else ""
        return self._refusal or refused

    def apply(self, settings: TermSettings, arm: ArmModel) -> None:
        """Use new settings and a new arm from the next `torque` on; the torque moves to them without a step."""
        if settings != self.settings or arm is not self._arm:
            self._pending, self._idle = (settings, arm), False

    def torque(self, now: float, theta: Sequence[float], velocity: Sequence[float], gravity: Sequence[float]) -> Torque:
        """Return the torque (4,) in Nm on top of gravity compensation at `now` (s, monotonic).

        theta, velocity: (4,) rad and rad/s. gravity: (4,) Nm of gravity compensation.
        """
        dt, self._time = now - self._time, now
        if self._idle:
            return NO_TORQUE
        if not 0.0 <= dt <= MAX_GAP:
            self._output, self._transition, dt = NO_TORQUE, Transition(), 0.0
        acceleration = self._acceleration.update(velocity, dt) if self.settings.inertia.on else NO_TORQUE
        state = TermState(now, dt, theta, velocity, acceleration, gravity, now - self._spring_start)
        total = self._transition.blended(now, self._sum(state))
        if self._pending is not None:
            self._change(*self._pending, now)
            after = self._sum(state._replace(dt=0.0, elapsed=now - self._spring_start))
            total = self._transition.begin(now, total, after)
        self._refusal = "" if math.isfinite(sum(total)) else "torque of the terms is not finite"
        if self._refusal:
            total, self._transition = NO_TORQUE, Transition()
            self._acceleration = AccelerationFilter()  # it may have kept what is not finite
        step = MAX_EFFORT_RATE * min(dt, LONGEST_STEP)
        columns = zip(total, self._output, MAX_EFFORT, strict=True)
        self._output = shaped = tuple([limited(wanted, last, limit, step) for wanted, last, limit in columns])
        if self.assist.idle:
            self._idle = not self._active and self._transition.is_over and shaped == NO_TORQUE
            return shaped
        a, b, c, d = self.assist.torque(now)
        return a + shaped[0], b + shaped[1], c + shaped[2], d + shaped[3]

    def _sum(self, state: TermState) -> Torque:
        a = b = c = d = 0.0
        for term in self._active:
            e, f, g, h = term.torque(state)
            a, b, c, d = a + e, b + f, c + g, d + h
        return a, b, c, d

    def _change(self, settings: TermSettings, arm: ArmModel, now: float) -> None:
        if settings.spring != self.settings.spring:
            self._spring_start = now
        self.settings, self._arm, self._pending = settings, arm, None
        self.assist.assist = settings.assist
        self._active = self._build()

    def _build(self) -> list[Term]:
        """Return the terms that are on."""
        s = self.settings
        terms: list[Term] = [term for term in (s.friction, s.damping, s.spring, s.coupling, s.limits) if term.on]
        if s.inertia.on:
            left = [(MAX_FRICTION_SHARE - s.friction.share) * coulomb for coulomb in s.friction.coulomb]
            terms.append(InertiaTerm(s.inertia.share, LinkInertia.of(self._arm), left, self._tank))
        return terms
