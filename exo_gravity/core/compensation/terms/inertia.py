"""Inertia: the motors accelerate a share of the links and rotors, so that the arm feels lighter to move.

Acceleration that is measured late gives more energy than it takes back. Two bounds keep that harmless:
- The share is below 1 and the low-pass never amplifies, so on a free arm the loop has a gain below 1 (small gain
  theorem) and cannot oscillate, however late it acts. On an elastic arm, such as a wearer's, it can: the tank ends it.
- An energy tank: the term gives no more than it took, plus TANK, plus a share of what the joints' own friction takes
  (`friction.coulomb`). What `friction.share` has given back is not spent twice. If the tank is empty, the term fades.
  On simulated arms with torques 10 ms late the excess was 0.76 J at most, with a TANK of 0.5 J.

At standstill there is no torque: 12-bit velocities alternate between two codes, and the acceleration that this feigns
moved the shoulder's rotation against its friction, by up to 1 degree a minute.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.link_inertia import ROTORS, LinkInertia
from exo_gravity.core.compensation.terms.term import DELAY, TermState
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.params import check_owned, owned

MAX_SHARE = 0.8  # leaves a fifth for masses that are not known exactly
TANK = 0.5  # J, the kinetic energy of the robot and an arm of 3.7 kg at 1.3 rad/s of abduction
FADING = 0.2  # of TANK, below which the term fades
STILL, MOVING = 0.03, 0.06  # rad/s of the fastest joint, between which it sets in
FAST, TOO_FAST = 4.0, 5.0  # rad/s of any joint, between which it fades: `can_bridge` trips a fault at 5


@dataclass(frozen=True)
class Inertia:
    """Parameters of the term `inertia`. Raises ParameterError."""

    share: float = owned(0.0, "share of the arm's inertia that the motors take over; 0: off", (0.0, MAX_SHARE))
    rotor: Sequence[float] = owned(ROTORS, "rotor inertia at the gear's output", (1e-4, 0.1), "kg m^2")

    def __post_init__(self) -> None:
        check_owned(self)

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return self.share > 0.0


class EnergyTank:
    """The energy in J that a term may give away; what it takes fills the tank again, up to TANK.

    The torque may act at once or DELAY later; whichever gives more energy is counted.
    """

    def __init__(self) -> None:
        self.level = TANK
        self._given: deque[tuple[float, Torque]] = deque()  # time in s and torque; the first one acts now at the latest
        self._time = 0.0

    def pass_on(self, torque: Torque, velocity: Sequence[float], dt: float, income: float) -> Torque:
        """Return `torque` (4,) in Nm, reduced when the tank is nearly empty and the torque would give energy.

        velocity: (4,) rad/s. income: W that flows into the tank, from the joints' friction.
        """
        v1, v2, v3, v4 = velocity
        a, b, c, d = torque
        power = a * v1 + b * v2 + c * v3 + d * v4
        if power > 0.0 and self.level < FADING * TANK:
            share = max(0.0, self.level) / (FADING * TANK)
            torque, power = tuple([share * tau for tau in torque]), share * power
        self._time += dt
        given = self._given
        given.append((self._time, torque))
        while given[0][0] < self._time - DELAY:
            given.popleft()
        a, b, c, d = given[0][1]
        late = a * v1 + b * v2 + c * v3 + d * v4
        self.level = min(TANK, self.level + (income - (power if power > late else late)) * dt)
        return torque


class InertiaTerm:
    """The term: the inertia of `links`, and a tank. coulomb: (4,) Nm of friction that is left to fill the tank."""

    def __init__(self, parameters: Inertia, links: LinkInertia, coulomb: Sequence[float], tank: EnergyTank) -> None:
        self.tank = tank
        self._parameters = parameters
        self._links = links
        self._coulomb = tuple(coulomb)

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return self._parameters.on

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm: a share of what accelerates the arm as it is accelerated now."""
        velocity = state.velocity
        fastest = max(map(abs, velocity))
        fading = min((fastest - STILL) / (MOVING - STILL), (TOO_FAST - fastest) / (TOO_FAST - FAST))
        share = self._parameters.share * max(0.0, min(1.0, fading))
        whole = self._links.torque(state.position, velocity, state.acceleration)
        v1, v2, v3, v4 = velocity
        c1, c2, c3, c4 = self._coulomb
        income = c1 * abs(v1) + c2 * abs(v2) + c3 * abs(v3) + c4 * abs(v4)
        a, b, c, d = whole
        return self.tank.pass_on((share * a, share * b, share * c, share * d), velocity, state.dt, income)
