"""Friction and inertia: the motors take over a share of what makes the arm hard to move.

Friction: the term gives at most `share` (below 1) of the friction that takes energy from the same motion. So joint and
term together always take energy, however late the term acts, and at rest, where it is 0, friction holds the arm as
before. This is true as long as `identified` is not above the joint's real friction. Motors report speed in codes of
0.022 rad/s (AK60-6) and 0.024 rad/s (AK80-9); standstill reads as half a code.

Inertia: acceleration that is measured late gives more energy than it takes back. Two bounds keep that harmless:
- The share is below 1 and the low-pass never amplifies, so on a free arm the loop has a gain below 1 (small gain
  theorem) and cannot oscillate, however late it acts. On an elastic arm, such as a wearer's, it can: the tank ends it.
- An energy tank: the term gives no more than it took, plus TANK, plus a share of what the joints' own friction takes
  (`friction.identified`). What `friction.share` gave back is not spent twice. If the tank is empty, the term fades.
  On simulated arms with torques 10 ms late the excess was 0.76 J at most, with a TANK of 0.5 J.
At standstill there is no torque: 12-bit velocities alternate between two codes, and the acceleration that this feigns
moved the shoulder's rotation against its friction, by up to 1 degree a minute.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.springs import DELAY, TermParameters, TermState
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.model.kinematics import LinkInertia
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import owned

MAX_FRICTION = 3.0  # Nm, and Nm s/rad
MAX_FRICTION_SHARE = 0.85  # leaves a friction that is 15 % smaller than identified
STANDSTILL = 0.03  # rad/s, below which a joint is considered to stand: more than one code of 12-bit velocity
SLIDING = 0.12  # rad/s, from which on friction is given its full share
MAX_SPEED = 3.0  # rad/s, beyond which viscous friction no longer grows

MAX_INERTIA_SHARE = 0.8  # leaves a fifth for masses that are not known exactly
TANK = 0.5  # J, the kinetic energy of the robot and an arm of 3.7 kg at 1.3 rad/s of abduction
FADING = 0.2  # of TANK, below which the term fades
MOVING = 0.06  # rad/s of the fastest joint: inertia sets in from STANDSTILL to here
FAST, TOO_FAST = 4.0, 5.0  # rad/s of any joint, between which it fades: `can_bridge` trips a fault at 5
# rad/s of the acceleration's low-passes. One code of 12-bit velocity, 0.022 rad/s, moves the acceleration by
# 0.022 BANDWIDTH / e = 0.65 rad/s^2 at most: 0.06 Nm on 0.1 kg m^2. It lags by 2 / BANDWIDTH = 25 ms.
BANDWIDTH = 80.0


@dataclass(frozen=True)
class Friction(TermParameters):
    """The term `friction`. Raises ParameterError."""

    share: float = owned(
        0.0, "share of the joints' friction that the motors take over; 0: off", (0.0, MAX_FRICTION_SHARE)
    )
    identified: Sequence[float] = owned(
        (0.0,) * 8,
        "Coulomb friction of the four joints in Nm, then their viscous friction in Nm s/rad, by `calibrate friction`",
        (0.0, MAX_FRICTION),
    )

    @property
    def coulomb(self) -> Sequence[float]:
        """Coulomb friction (4,) in Nm."""
        return self.identified[:JOINT_COUNT]

    @property
    def viscous(self) -> Sequence[float]:
        """Viscous friction (4,) in Nm s/rad."""
        return self.identified[JOINT_COUNT:]

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm, along the motion."""
        torque = []
        for v, coulomb, viscous in zip(state.velocity, self.coulomb, self.viscous, strict=True):
            whole = self.share * (coulomb + viscous * min(abs(v), MAX_SPEED))
            torque.append(math.copysign(sliding(v) * whole, v))
        return tuple(torque)


def sliding(speed: float) -> float:
    """Return the share of its friction that a joint at `speed` rad/s shows: 0 where it stands, 1 where it slides."""
    return max(0.0, min(1.0, (abs(speed) - STANDSTILL) / (SLIDING - STANDSTILL)))


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
        power = _dot(torque, velocity)
        if power > 0.0 and self.level < FADING * TANK:
            share = max(0.0, self.level) / (FADING * TANK)
            torque, power = tuple([share * tau for tau in torque]), share * power
        self._time += dt
        given = self._given
        given.append((self._time, torque))
        while given[0][0] < self._time - DELAY:
            given.popleft()
        self.level = min(TANK, self.level + (income - max(power, _dot(given[0][1], velocity))) * dt)
        return torque


@dataclass(frozen=True)
class Inertia(TermParameters):
    """The term `inertia`. Raises ParameterError."""

    share: float = owned(0.0, "share of the arm's inertia that the motors take over; 0: off", (0.0, MAX_INERTIA_SHARE))

    def torque(self, links: LinkInertia, friction: Sequence[float], tank: EnergyTank, state: TermState) -> Torque:
        """Return the torque (4,) in Nm: a share of what accelerates `links` as they are accelerated now.

        friction: (4,) Nm of Coulomb friction that is left to fill the `tank`.
        """
        velocity = state.velocity
        fastest = max(map(abs, velocity))
        fading = min((fastest - STANDSTILL) / (MOVING - STANDSTILL), (TOO_FAST - fastest) / (TOO_FAST - FAST))
        share = self.share * max(0.0, min(1.0, fading))
        whole = links.torque(state.position, velocity, state.acceleration)
        income = _dot(friction, map(abs, velocity))
        return tank.pass_on(tuple([share * tau for tau in whole]), velocity, state.dt, income)


def _dot(a: Iterable[float], b: Iterable[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


class AccelerationFilter:
    """The joints' acceleration from the motors' velocity: its derivative behind two low-passes."""

    def __init__(self) -> None:
        self._once: list[float] = []  # velocity behind one low-pass
        self._twice: list[float] = []  # and behind two

    def update(self, velocity: Sequence[float], dt: float) -> Sequence[float]:
        """Return the acceleration (4,) in rad/s^2 for the `velocity` (4,) in rad/s, `dt` s after the last call.

        dt: 0 starts anew, with the acceleration 0. Its gain is below 1 at any frequency and any dt.
        """
        if dt <= 0.0 or not self._once:
            self._once, self._twice = list(velocity), list(velocity)
            return [0.0] * len(velocity)
        share = dt * BANDWIDTH / (1.0 + dt * BANDWIDTH)
        once = [a + share * (v - a) for v, a in zip(velocity, self._once, strict=True)]
        rate = share / dt
        acceleration = [rate * (a - b) for a, b in zip(once, self._twice, strict=True)]
        self._twice = [b + dt * a for b, a in zip(self._twice, acceleration, strict=True)]
        self._once = once
        return acceleration
