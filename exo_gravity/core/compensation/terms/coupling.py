"""Coupling: one joint follows another by a ratio, as in the shoulder rhythm of the exoskeleton HARMONY.

A spring between the two, of which both feel their part: torque on the follower alone could be turned into energy by
moving the joints in a circle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.term import DELAY, LATE, TermState, clamp
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.params import check_owned, owned

JOINTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")


@dataclass(frozen=True)
class Coupling:
    """Parameters of the term `coupling`. Raises ParameterError."""

    stiffness: float = owned(0.0, "spring between follower and leader; 0: off", (0.0, 50.0), "Nm/rad")
    leader: str = owned("shoulder_abduction", "joint that leads", choices=JOINTS)
    follower: str = owned("shoulder_flexion", "joint that follows", choices=JOINTS)
    ratio: float = owned(0.5, "angle of the follower per angle of the leader", (-2.0, 2.0))
    offset: float = owned(0.0, "angle of the follower at the leader's 0", (-3.15, 3.15), "rad")
    max_effort: float = owned(1.0, "largest torque on the follower", (0.0, 5.0), "Nm")

    def __post_init__(self) -> None:
        check_owned(self)
        if self.leader == self.follower:
            raise ParameterError("coupling.follower", self.follower, "another joint than coupling.leader")

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return self.stiffness > 0.0

    def check(self, least_inertia: Sequence[float]) -> None:
        """Raise ParameterError unless the spring is stable on these inertias (4,) kg m^2."""
        follower, leader = (least_inertia[JOINTS.index(name)] for name in (self.follower, self.leader))
        most = 1.0 / (1.0 / follower + self.ratio**2 / leader) / (4.0 * DELAY**2)
        if self.stiffness > most:
            expected = f"at most {most:.2f} Nm/rad, which {1000 * DELAY:.0f} ms late is stable"
            raise ParameterError("coupling.stiffness", self.stiffness, expected)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm on follower and leader."""
        i, j = JOINTS.index(self.follower), JOINTS.index(self.leader)
        q, v, ratio = state.position, state.velocity, self.ratio
        pull = clamp(-self.stiffness * (q[i] - ratio * q[j] - self.offset), self.max_effort)
        pull -= LATE * self.stiffness * (v[i] - ratio * v[j])
        torque = [0.0] * 4
        torque[i], torque[j] = pull, -ratio * pull
        return tuple(torque)
