# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The times of a recording without the steps of the computer's clock.

A computer without a battery for its clock sets it when it finds a time server: times of arrival step back, or ahead by
an hour or by decades. The order in which messages lie in the file does not change then. So it divides the recording
into parts at each step, and puts each part behind the one before it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

SECOND = 1_000_000_000  # ns
LATEST = 2**62  # ns since 1970, in the year 2116; a later time is damage


@dataclass(frozen=True)
class ClockTuning:
    """What counts as a step of the clock."""

    back: int = 50_000_000  #: ns; messages that overtake each other differ by less
    ahead: int = 30 * SECOND  #: ns without a message; a shorter pause is one of the recording
    join: int = SECOND  #: ns between two parts after a step: a gap, in which no hold goes on
    edge: int = SECOND // 2  #: ns by which a message of another topic may lie outside of its part
    outside: int = 86_400 * SECOND  #: ns by which it may lie before or after the arm's joint states


CLOCK = ClockTuning()


@dataclass(frozen=True)
class Timeline:
    """The parts of a recording between steps of its clock. Arrays (k,) have one value for each part."""

    first: np.ndarray  #: number of the first message among all messages of the recording
    offset: np.ndarray  #: ns to add to its times
    begin: np.ndarray  #: ns, its first time, with the offset
    end: np.ndarray  #: ns, its last time, with the offset
    steps: tuple[int, ...]  #: ns of each step, positive ahead
    known: tuple[np.ndarray, np.ndarray]  #: numbers (n,) and times (n,) in ns of the messages that it is made of

    def part(self, ordinal: np.ndarray) -> np.ndarray:
        """Return the part (n,) in which the `ordinal`-th messages (n,) lie."""
        return np.maximum(np.searchsorted(self.first, ordinal, "right") - 1, 0)

    def times(self, ordinal: np.ndarray, arrival: np.ndarray) -> np.ndarray:
        """Return the times (n,) in ns of messages that arrived at `arrival` (n,) ns; near their part in any case.

        A time of 0 is unknown: such a message has the time of its neighbours in the file.
        """
        part, last = self.part(ordinal), len(self.first) - 1
        low = self.begin[part] - np.where(part == 0, CLOCK.outside, CLOCK.edge)
        high = self.end[part] + np.where(part == last, CLOCK.outside, CLOCK.edge)
        times = np.clip(arrival + self.offset[part], low, high)
        lost = np.flatnonzero(arrival <= 0)
        if len(lost):
            numbers, known = self.known
            times[lost] = known[np.minimum(np.searchsorted(numbers, ordinal[lost]), len(known) - 1)]
        return times


def timeline(ordinal: np.ndarray, arrival: np.ndarray) -> Timeline:
    """Return the timeline of a recording from the times of arrival (n,) in ns of one topic, in the order of its file.

    ordinal: (n,) numbers of its messages among all messages.

    Its longest part keeps its times.
    """
    arrival = without_outliers(arrival)
    change = np.diff(arrival)
    cuts = np.flatnonzero((change < -CLOCK.back) | (change > CLOCK.ahead)) + 1
    if _is_in_another_order(arrival):
        cuts = cuts[:0]
    parts = [slice(*ends) for ends in pairwise((0, *cuts.tolist(), len(arrival)))]
    begin = np.array([arrival[part].min() for part in parts])
    end = np.array([arrival[part].max() for part in parts])
    length = end - begin
    steps = tuple((arrival[cuts] - arrival[cuts - 1]).tolist())
    placed = np.concatenate(([0], np.cumsum(length[:-1] + CLOCK.join)))
    anchor = int(np.argmax(length))
    placed += begin[anchor] - placed[anchor]
    first, offset = ordinal[[part.start for part in parts]], placed - begin
    shifted = arrival + np.repeat(offset, [part.stop - part.start for part in parts])
    return Timeline(first, offset, placed, placed + length, steps, (ordinal, shifted))


def without_outliers(arrival: np.ndarray) -> np.ndarray:
    """Return times (n,) in which a single one far from both of its neighbours, which agree, is that of the first."""
    change, around = np.diff(arrival), arrival[2:] - arrival[:-2]
    is_step = (change < -CLOCK.back) | (change > CLOCK.ahead)
    alone = is_step[:-1] & is_step[1:] & (around >= -CLOCK.back) & (around <= CLOCK.ahead)
    result = arrival.copy()
    result[1:-1][alone] = arrival[:-2][alone]
    return result


def _is_in_another_order(arrival: np.ndarray) -> bool:
    """Return whether the runs of times, sorted, follow each other: the file's order is then not that of arrival."""
    change = np.diff(arrival)
    if np.all(change >= -CLOCK.back):
        return False
    cuts = np.flatnonzero((change < -CLOCK.back) | (change > CLOCK.join)) + 1
    edges = [0, *cuts.tolist(), len(arrival)]
    runs = sorted((int(arrival[a:b].min()), int(arrival[a:b].max())) for a, b in pairwise(edges))
    return all(-CLOCK.back <= later[0] - earlier[1] <= CLOCK.join for earlier, later in pairwise(runs))
