"""Soft limits: springs at the edge of a workspace that a therapist chooses, within the joint limits of `can_bridge`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.term import LATE, TermState, check_stiffness, clamp
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.params import check_owned, owned

EDGE = 0.05  # rad beyond the edge over which the damping rises, so that it does not set in with a jolt


@dataclass(frozen=True)
class SoftLimits:
    """Parameters of the term `limits`. Raises ParameterError."""

    stiffness: Sequence[float] = owned((0.0,) * 4, "spring beyond the workspace; 0: off", (0.0, 50.0), "Nm/rad")
    lower: Sequence[float] = owned((-1.5, 0.0, -0.6, 0.0), "lower edge of the workspace", (-3.15, 3.15), "rad")
    upper: Sequence[float] = owned((1.5, 1.6, 1.6, 2.5), "upper edge of the workspace", (-3.15, 3.15), "rad")
    max_effort: Sequence[float] = owned((1.0, 2.0, 1.0, 1.0), "largest torque of the spring", (0.0, 5.0), "Nm")

    def __post_init__(self) -> None:
        check_owned(self)
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ParameterError("limits.upper", list(self.upper), f"above limits.lower = {list(self.lower)}")

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return any(self.stiffness)

    def check(self, least_inertia: Sequence[float]) -> None:
        """Raise ParameterError unless the springs are stable on these inertias (4,) kg m^2."""
        check_stiffness("limits.stiffness", self.stiffness, least_inertia)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm: none inside, back towards the workspace outside."""
        torque = []
        columns = zip(
            self.stiffness, self.lower, self.upper, state.position, state.velocity, self.max_effort, strict=True
        )
        for k, low, high, q, v, most in columns:
            if low <= q <= high:
                torque.append(0.0)
                continue
            depth = q - high if q > high else q - low
            damping = LATE * k * min(1.0, abs(depth) / EDGE)
            torque.append(clamp(-k * depth, most) - damping * v)
        return tuple(torque)
