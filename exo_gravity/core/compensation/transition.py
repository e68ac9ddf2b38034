"""A change of law or settings without a step: what the torque would jump by is kept, and fades linearly."""

from __future__ import annotations

from collections.abc import Sequence

from exo_gravity.core.model.gravity import Torque


class Transition:
    """The remainder of the last change; none at the start."""

    def __init__(self) -> None:
        self._remainder: Torque = ()
        self._start: float | None = None  # s; None after the transition

    def begin(self, now: float, before: Torque, after: Sequence[float]) -> Torque:
        """Begin the way from `before` to `after`, (n,) Nm each, at `now` s; return its start, `before`."""
        self._remainder = tuple(b - a for b, a in zip(before, after, strict=True))
        self._start = now
        return before

    def blended(self, now: float, torque: Torque, duration: float) -> Torque:
        """Return `torque` (n,) plus what is left at `now` of the remainder, which lasts `duration` s."""
        if self._start is None:
            return torque
        left = 1.0 - (now - self._start) / duration
        if left <= 0.0:
            self._start = None
            return torque
        return tuple(t + left * r for t, r in zip(torque, self._remainder, strict=True))
