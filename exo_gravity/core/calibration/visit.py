"""One pose of a tour: the sweeps through it, there and back, until enough of them were good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from exo_gravity.core.calibration.average import Average, Sweep, average
from exo_gravity.core.calibration.motion import WINDOW, Line, Station
from exo_gravity.core.model.gravity import Torque

FOLLOWED = 0.5  # of the way of the reference, that each joint must follow in a sweep that counts
MAX_FAILURES = 3  # pairs of sweeps in which a joint may stick: each shows the controller more of its friction


class Visit:
    """Collects the samples of the sweeps through `station`.

    slope: (4, 4) Nm/rad, change of the expected torque with the angles; bend: its curvature, as for `average`.
    stuck_joints: those that did not follow one of the last two sweeps, with the part of the way that they did.
    """

    def __init__(self, station: Station, slope: np.ndarray, bend: np.ndarray) -> None:
        self.station = station
        self.stuck_joints: dict[int, float] = {}
        self._failures = 0
        self._slope, self._bend = slope, bend
        self._sweeps: list[Sweep] = []
        self._samples: list[tuple[Sequence[float], Torque]] = []
        self._directions: list[tuple[float, float, float]] = []

    @property
    def line(self) -> Line:
        """The next sweep."""
        ends = (self.station.low, self.station.high)
        return Line(*(ends if len(self._sweeps) % 2 == 0 else ends[::-1]), self.station.speed)

    @property
    def is_complete(self) -> bool:
        """Whether enough sweeps were good."""
        return len(self._sweeps) == 2 * self.station.cycles

    @property
    def has_failed(self) -> bool:
        """Whether joints stuck too often here."""
        return self._failures > MAX_FAILURES

    @property
    def direction(self) -> np.ndarray:
        """Mean direction of gravity (3,) during the sweeps."""
        mean = np.mean(self._directions, axis=0)
        return np.asarray(mean / np.linalg.norm(mean))

    def note(self, position: Sequence[float], effort: Torque, direction: tuple[float, float, float]) -> None:
        """Take a sample: the `effort` (4,) Nm that brought the arm to `position` (4,) rad."""
        self._samples.append((tuple(position), effort))
        self._directions.append(direction)

    def end_sweep(self) -> np.ndarray | None:
        """End a sweep. Return the friction (4,) in Nm that it and the one before show, None after a way there."""
        position, effort = (np.array(column) for column in zip(*self._samples, strict=True))
        self._sweeps.append(Sweep(len(self._sweeps) % 2 == 0, position, effort))
        self._samples = []
        if len(self._sweeps) % 2:
            return None
        ways = [np.abs(sweep.position[-1] - sweep.position[0]) for sweep in self._sweeps[-2:]]
        shares = np.min(ways, axis=0) / (2.0 * WINDOW * self.station.amplitude)
        self.stuck_joints = {joint: float(share) for joint, share in enumerate(shares) if share < FOLLOWED}
        return average(self._sweeps[-2:], self._slope, self._bend).friction

    def start_again(self, failed: bool) -> None:
        """Discard the sweeps so far; failed: because a joint did not follow."""
        self._failures += failed
        self._sweeps, self._directions = [], []

    def result(self) -> Average:
        """Return the average of the sweeps."""
        return average(self._sweeps, self._slope, self._bend)
