# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The terms at work: their parameters, and their bounded sum, plus the outer loop's input.

The compensator guides a change of parameters. Whatever is wrong with the sum, gravity compensation goes on beneath it.
A new term is a field of `TermSettings` and an item in `Terms._built`. A laboratory's own needs no fork: a distribution
that names a `TermParameters` with a `torque` under the entry point group GROUP is found where a file gives one of its
parameters, whose prefix is the entry point's name.
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, NamedTuple

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.compensation.load_change import PAUSE
from exo_gravity.core.compensation.terms.assist import Assist, AssistInput
from exo_gravity.core.compensation.terms.catalogue import (
    DELAY,
    MAX_FRICTION_SHARE,
    AccelerationFilter,
    Coupling,
    Damping,
    EnergyTank,
    Friction,
    Inertia,
    SoftLimits,
    Spring,
    TermState,
)
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Torque, clamp, for_joints
from exo_gravity.core.params import Param, params_of

GROUP = "exo_gravity.terms"


@dataclass(frozen=True)
class SumLimits:
    """What bounds all terms together."""

    #: Nm: well below the motors' rated torque, which gravity needs; another arm's joints all get the least
    effort: Sequence[float] = (2.0, 4.0, 2.0, 2.0)
    edge_share: float = 0.8  #: of the stiffness that the arm can bear, for `limits` where that is less


SUM = SumLimits()


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
    others: Mapping[str, Any] = field(default_factory=dict)  #: of other distributions, by the same prefix

    def on_arm(self, robot: Arm) -> "TermSettings":
        """Return these settings with limits as stiff as `robot` can bear.

        Raises ParameterError unless every spring and damper is stable on `robot`, without a wearer in it.
        """
        if not any(getattr(self, name).on for name in ("damping", "spring", "coupling", "limits", "inertia")):
            return self
        least = robot.links.least
        # A spring that acts DELAY late gives the energy of a damping of -stiffness * DELAY. Virtual damping acts as
        # late, so inertia / (2 DELAY) is the most that damps: twice what the spring needs.
        dampers = [inertia / (2.0 * DELAY) for inertia in least]
        springs = [most / (2.0 * DELAY) for most in dampers]
        coupled = ([self.coupling.largest], [self.coupling.stable(least)]) if self.coupling.on else ((), ())
        for name, values, most, unit in (
            ("damping.viscosity", self.damping.viscosity, dampers, "Nm s/rad"),
            ("spring.stiffness", self.spring.stiffness, springs, "Nm/rad"),
            ("coupling.stiffness", *coupled, "Nm/rad"),
        ):
            if any(value > limit for value, limit in zip(values, most, strict=True)):
                expected = f"at most {[round(limit, 3) for limit in most]} {unit}, which"
                raise ParameterError(name, list(values), f"{expected} {1000 * DELAY:.0f} ms late is stable")
        stiffness = tuple(min(k, SUM.edge_share * most) for k, most in zip(self.limits.stiffness, springs, strict=True))
        return replace(self, limits=replace(self.limits, stiffness=stiffness))


#: the parameters of each term by the prefix of their names
GROUPS: dict[str, Any] = {own.name: own.default_factory for own in fields(TermSettings) if own.name != "others"}


def term_parameters(groups: Mapping[str, Any] = GROUPS) -> tuple[Param, ...]:
    """Return the parameters of terms, with their prefixes."""
    return tuple(
        replace(param, name=f"{prefix}.{param.name}") for prefix, owner in groups.items() for param in params_of(owner)
    )


def term_settings_of(values: Mapping[str, Any], others: Mapping[str, Any] | None = None) -> TermSettings:
    """Return the settings that parameter values describe, or raise ParameterError.

    others: the terms of other distributions, as `GROUPS`.
    """
    ours, theirs = (
        {
            prefix: owner(**{param.name: values[f"{prefix}.{param.name}"] for param in params_of(owner)})
            for prefix, owner in groups.items()
        }
        for groups in (GROUPS, others or {})
    )
    return TermSettings(**ours, others=theirs)


class TermsInForce(NamedTuple):
    """The terms of some settings."""

    terms: Sequence[Callable[[TermState], Torque]]  #: each returns (n,) Nm that the motors add
    since: float  #: s, when the spring's settings came into force


class Terms:
    """What one compensator adds to gravity compensation.

    names: of the joints (n,). arm: what moves, with known masses, for `inertia`. `assist` is the outer loop's input,
    `tank` the energy of `inertia`. in_force: the present terms.
    """

    def __init__(self, names: Sequence[str], settings: TermSettings, arm: Arm) -> None:
        self.settings = settings
        self._none = (0.0,) * len(names)
        self._most = for_joints(SUM.effort, len(names))  # Nm
        self.assist = AssistInput(names, settings.assist)
        self._refusal = ""  # why the sum is not used
        self._assisted: Torque = self._none
        self.tank = EnergyTank()
        self._acceleration = AccelerationFilter()
        self._time = -math.inf
        self._state = TermState(0.0, self._none, self._none, self._none, 0.0)
        self._has_inertia = False
        self.in_force = TermsInForce(self._built(settings, arm), -math.inf)

    @property
    def active(self) -> list[str]:
        """The names of the terms that are on, and 'assist' if efforts are used."""
        terms = {name: getattr(self.settings, name) for name in GROUPS} | dict(self.settings.others)
        return [name for name, term in terms.items() if term.on]

    @property
    def problem(self) -> str:
        """Why the sum of the terms or the outer loop's efforts are not used although they are asked for, or ''."""
        assist = self.assist
        refused = assist.reason.text if assist.assist.on and assist.state == "refused" else ""
        return self._refusal or refused

    def apply(self, settings: TermSettings, arm: Arm) -> None:
        """Use new settings and a new arm at once: it is for the caller to guide the change (`load_change`)."""
        since = self.in_force.since if settings.spring == self.settings.spring else self._time
        self.settings, self.assist.assist = settings, settings.assist
        self.in_force = TermsInForce(self._built(settings, arm), since)

    def torque(self, now: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm on top of gravity compensation at `now` (s, monotonic).

        theta, velocity: (n,) rad and rad/s.
        """
        dt, self._time = now - self._time, now
        if not 0.0 <= dt <= PAUSE:
            dt = 0.0  # the acceleration is measured anew
        acceleration = self._acceleration.update(velocity, dt) if self._has_inertia else self._none
        self._state = TermState(dt, theta, velocity, acceleration, now - self.in_force.since)
        total = _sum(self.in_force.terms, self._state)
        self._refusal = "" if math.isfinite(sum(total)) else "torque of the terms is not finite"
        if self._refusal:
            total, self._acceleration = self._none, AccelerationFilter()  # it may have kept what is not finite
        self._assisted = self.assist.torque(now) if self.assist.assist.on else self._none
        return self._whole(total)

    def torque_of(self, other: TermsInForce) -> Torque:
        """Return the torque (n,) in Nm that other terms would give in the state of the last `torque`."""
        state = self._state._replace(dt=0.0, elapsed=self._time - other.since)
        total = _sum(other.terms, state)
        if not math.isfinite(sum(total)):
            total = self._none
        return self._whole(total)

    def _whole(self, total: Torque) -> Torque:
        """Return the `total` (n,) of the terms in Nm, clamped, with the outer loop's efforts."""
        return tuple(map(operator.add, self._assisted, map(clamp, total, self._most)))

    def _built(self, s: TermSettings, arm: Arm) -> Sequence[Callable[[TermState], Torque]]:
        """Return the terms that are on."""
        own = (s.friction, s.damping, s.spring, s.coupling, s.limits, *s.others.values())
        terms = [term.torque for term in own if term.on]
        if s.inertia.on:
            self._has_inertia = True
            left = [(MAX_FRICTION_SHARE - s.friction.share) * coulomb for coulomb in s.friction.coulomb]
            terms.append(partial(s.inertia.torque, arm.links, left, self.tank))
        return terms


def _sum(terms: Sequence[Callable[[TermState], Torque]], state: TermState) -> Torque:
    return tuple(map(sum, zip((0.0,) * len(state.velocity), *(torque(state) for torque in terms), strict=True)))
