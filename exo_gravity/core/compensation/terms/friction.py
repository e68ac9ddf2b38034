"""Friction: the motors take over a share of the joints' own friction, Coulomb and viscous.

It gives at most `share` (below 1) of the friction that takes energy from the same motion. So joint and term together
always take energy, however late the term acts, and at rest, where it is 0, friction holds the arm as before. This is
true as long as `coulomb` is not above the joint's real friction: enter what `calibrate motors` measured.

Motors report speed in codes of 0.022 rad/s (AK60-6) and 0.024 rad/s (AK80-9); standstill reads as half a code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.term import TermState
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.params import check_owned, owned

MAX_SHARE = 0.85  # leaves a friction that is 15 % smaller than identified
STILL = 0.03  # rad/s, below which the joint counts as standing: more than one code of 12-bit velocity
MOVING = 0.12  # rad/s, from which on the term gives its full share
MAX_SPEED = 3.0  # rad/s, beyond which viscous friction no longer grows


@dataclass(frozen=True)
class Friction:
    """Parameters of the term `friction`. Raises ParameterError."""

    share: float = owned(0.0, "share of the joints' friction that the motors take over; 0: off", (0.0, MAX_SHARE))
    coulomb: Sequence[float] = owned((0.0,) * 4, "identified Coulomb friction", (0.0, 3.0), "Nm")
    viscous: Sequence[float] = owned((0.0,) * 4, "identified viscous friction", (0.0, 1.0), "Nm s/rad")

    def __post_init__(self) -> None:
        check_owned(self)

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return self.share > 0.0

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm, along the motion."""
        share, torque = self.share, []
        for v, coulomb, viscous in zip(state.velocity, self.coulomb, self.viscous, strict=True):
            speed = -v if v < 0.0 else v
            if speed <= STILL:
                torque.append(0.0)
                continue
            whole = share * (coulomb + viscous * (speed if speed < MAX_SPEED else MAX_SPEED))
            if speed < MOVING:
                whole *= (speed - STILL) / (MOVING - STILL)
            torque.append(whole if v > 0.0 else -whole)
        return tuple(torque)
