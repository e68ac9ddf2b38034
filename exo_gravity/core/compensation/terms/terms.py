"""The terms at work: their sum behind the shaper, plus the outer loop's input."""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.compensation.terms.acceleration import AccelerationFilter
from exo_gravity.core.compensation.terms.assist import AssistInput
from exo_gravity.core.compensation.terms.friction import MAX_SHARE
from exo_gravity.core.compensation.terms.inertia import EnergyTank, InertiaTerm
from exo_gravity.core.compensation.terms.link_inertia import LinkInertia
from exo_gravity.core.compensation.terms.settings import TermSettings
from exo_gravity.core.compensation.terms.shaper import Shaper
from exo_gravity.core.compensation.terms.term import Term, TermState
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import NO_TORQUE, Torque

MAX_GAP = 0.2  # s between two cycles, beyond which the terms begin again from no torque
NO_ACCELERATION = (0.0,) * 4


class Terms:
    """What one compensator adds to gravity compensation.

    names: of the joints (4,). arm: what moves, with known masses, for `inertia`. `assist` is the outer loop's input.
    """

    def __init__(self, names: Sequence[str], settings: TermSettings, arm: ArmModel) -> None:
        self.settings = settings
        self.assist = AssistInput(names, settings.assist)
        self._arm = arm
        self._shaper = Shaper(settings.terms)
        self._tank = EnergyTank()
        self._acceleration = AccelerationFilter()
        self._time = self._spring_start = -math.inf
        self._pending: tuple[TermSettings, ArmModel] | None = None
        self._active = self._build()
        self._idle = False

    @property
    def active(self) -> list[str]:
        """The names of the terms that are on, and 'assist' if efforts are used."""
        names = ("friction", "inertia", "damping", "spring", "coupling", "limits", "assist")
        return [name for name in names if getattr(self.settings, name).on]

    @property
    def energy(self) -> float:
        """Energy in J left in the tank of `inertia`."""
        return self._tank.level

    @property
    def problem(self) -> str:
        """Why the sum of the terms or the outer loop's efforts are not used although they are asked for, or ''."""
        assist = self.assist
        refused = assist.reason if assist.assist.on and assist.state == "refused" else ""
        return self._shaper.refusal or refused

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
            self._shaper.restart()
            dt = 0.0
        acceleration = self._acceleration.update(velocity, dt) if self.settings.inertia.on else NO_ACCELERATION
        state = TermState(now, dt, theta, velocity, acceleration, gravity, now - self._spring_start)
        total = self._sum(state)
        if self._pending is not None:
            self._change(*self._pending, now)
            after = self._sum(state._replace(dt=0.0, elapsed=now - self._spring_start))
            self._shaper.change(total, after)
            total = after
        shaped = self._shaper.shape(total, dt)
        if self._shaper.refusal:
            self._acceleration = AccelerationFilter()  # it may have kept what is not finite
        if self.assist.idle:
            self._idle = not self._active and self._shaper.idle
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
        self.assist.assist, self._shaper.shaping = settings.assist, settings.terms
        self._active = self._build()

    def _build(self) -> list[Term]:
        """Return the terms that are on."""
        s = self.settings
        terms: list[Term] = [s.friction, s.damping, s.spring, s.coupling, s.limits]
        if s.inertia.on:
            left = [(MAX_SHARE - s.friction.share) * coulomb for coulomb in s.friction.coulomb]
            terms.append(InertiaTerm(s.inertia, LinkInertia(self._arm, s.inertia.rotor), left, self._tank))
        return [term for term in terms if term.on]
