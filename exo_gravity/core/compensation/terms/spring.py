"""Spring: pulls the joints towards a pose, or along a recorded path, with a limited torque.

Towards a pose it returns what energy it took, less its damping. A path moves the pose, and gives at most the limited
torque times the way along the path.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.term import LATE, TermState, check_stiffness, clamp
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.params import check_owned, owned

MAX_PATH_SPEED = 2.0  # rad/s between two poses of a path


@dataclass(frozen=True)
class PosePath:
    """Poses over time: times (n,) in s from 0 on, rising; poses (n, 4) in rad. Raises ParameterError."""

    times: tuple[float, ...]
    poses: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.times, self.times[1:], strict=False))
        if not (self.times and rising and self.times[0] == 0.0 and math.isfinite(self.times[-1])):
            raise ParameterError("times of a path", list(self.times[:3]), "rising from 0")
        if len(self.poses) != len(self.times) or not all(map(_is_pose, self.poses)):
            raise ParameterError("poses of a path", len(self.poses), f"{len(self.times)} poses of 4 angles in rad")
        for (t, a), (u, b) in zip(self._points(), self._points()[1:], strict=False):
            if math.dist(a, b) > MAX_PATH_SPEED * (u - t):
                expected = f"at most {MAX_PATH_SPEED:g} rad/s"
                raise ParameterError(f"speed of the path from {t:g} s on", math.dist(a, b) / (u - t), expected)

    @classmethod
    def load(cls, text: str) -> PosePath:
        """Return the path in a CSV file's `text`: rows of the time in s and four angles in rad. Raises DataError."""
        try:
            rows = [tuple(map(float, line.split(","))) for line in text.splitlines() if line.strip()]
            return cls(tuple(row[0] for row in rows), tuple(row[1:] for row in rows))
        except ValueError as error:  # a ParameterError too
            raise DataError(f"not a path: {error}") from None

    def _points(self) -> list[tuple[float, tuple[float, ...]]]:
        return list(zip(self.times, self.poses, strict=True))

    def at(self, elapsed: float) -> Sequence[float]:
        """Return the pose (4,) in rad `elapsed` s after the start; the last one after the end."""
        i = bisect.bisect_right(self.times, elapsed)
        if i == 0 or i == len(self.times):
            return self.poses[max(0, i - 1)]
        share = (elapsed - self.times[i - 1]) / (self.times[i] - self.times[i - 1])
        return [a + share * (b - a) for a, b in zip(self.poses[i - 1], self.poses[i], strict=True)]


@dataclass(frozen=True)
class Spring:
    """Parameters of the term `spring`; path: None for a spring towards `pose`. Raises ParameterError."""

    stiffness: Sequence[float] = owned((0.0,) * 4, "virtual spring towards the pose; 0: off", (0.0, 50.0), "Nm/rad")
    pose: Sequence[float] = owned((0.0, 0.3, 0.3, 0.5), "pose that it pulls towards", (-3.15, 3.15), "rad")
    max_effort: Sequence[float] = owned((1.0, 2.0, 1.0, 1.0), "largest torque of the spring", (0.0, 5.0), "Nm")
    path: PosePath | None = None

    def __post_init__(self) -> None:
        check_owned(self)

    @property
    def on(self) -> bool:
        """Whether the term gives torque."""
        return any(self.stiffness)

    def check(self, least_inertia: Sequence[float]) -> None:
        """Raise ParameterError unless the spring is stable on these inertias (4,) kg m^2."""
        check_stiffness("spring.stiffness", self.stiffness, least_inertia)

    def torque(self, state: TermState) -> Torque:
        """Return the torque (4,) in Nm."""
        pose = self.path.at(state.elapsed) if self.path else self.pose
        torque = []
        columns = zip(self.stiffness, pose, state.position, state.velocity, self.max_effort, strict=True)
        for k, to, q, v, most in columns:
            torque.append(clamp(k * (to - q), most) - LATE * k * v)
        return tuple(torque)


def _is_pose(pose: Sequence[float]) -> bool:
    return len(pose) == JOINT_COUNT and all(abs(angle) <= math.pi for angle in pose)
