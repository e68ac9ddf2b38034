# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The times of a recording without the steps of the computer's clock, and which command was in force at each.

A computer without a battery for its clock sets it when it finds a time server: times of arrival step back, or ahead by
an hour or by decades. The order in which messages lie in the file does not change then. So it divides the recording
into parts at each step, and puts each part behind the one before it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from exo_gravity.lab.bag.layout import JointSeries

SECOND = 1_000_000_000  # ns
LATEST = 2**62  # ns since 1970, in the year 2116; a later time is damage


@dataclass(frozen=True)
class ClockTuning:
    """What counts as a step of the clock, and which times belong together."""

    back: int = 50_000_000  #: ns; messages that overtake each other differ by less
    ahead: int = 30 * SECOND  #: ns without a message; a shorter pause is one of the recording
    join: int = SECOND  #: ns between two parts after a step: a gap, in which no hold goes on
    edge: int = SECOND // 2  #: ns by which a message of another topic may lie outside of its part
    outside: int = 86_400 * SECOND  #: ns by which it may lie before or after the arm's joint states
    stamp: int = SECOND  #: ns between stamp and arrival
    command_age: int = SECOND // 5  #: ns; an older command is no longer in force


CLOCK = ClockTuning()


@dataclass(frozen=True)
class Timeline:
    """The parts of a recording between steps of its clock. Arrays (k,) have one value for each part."""

    first: np.ndarray  #: number of the first message among all messages of the recording
    offset: np.ndarray  #: ns to add to its times
    begin: np.ndarray  #: ns, its first time, with the offset
    end: np.ndarray  #: ns, its last time, with the offset
    steps: tuple[int, ...]  #: ns of each step, positive ahead
    ordinal: np.ndarray  #: (n,) numbers of the messages that it is made of
    known: np.ndarray  #: (n,) ns, their times

    def part(self, ordinal: np.ndarray) -> np.ndarray:
        """Return the part (n,) in which the `ordinal`-th messages (n,) lie."""
        return np.maximum(np.searchsorted(self.first, ordinal, "right") - 1, 0)

    def times(self, ordinal: np.ndarray, arrival: np.ndarray) -> np.ndarray:
        """Return the times (n,) in ns of messages that arrived at `arrival` (n,) ns; near their part in any case.

        A time of 0 is unknown: such a message has the time of its neighbours in the file.
        """
        part, last = self.part(ordinal), len(self.first) - 1
        low = self.begin - np.where(np.arange(last + 1) == 0, CLOCK.outside, CLOCK.edge)
        high = self.end + np.where(np.arange(last + 1) == last, CLOCK.outside, CLOCK.edge)
        times = np.clip(arrival + self.offset[part], low[part], high[part])
        lost = np.flatnonzero(arrival <= 0)
        times[lost] = self.known[np.minimum(np.searchsorted(self.ordinal, ordinal[lost]), len(self.known) - 1)]
        return times

    def of(self, series: JointSeries) -> tuple[np.ndarray, np.ndarray, float]:
        """Return times of arrival (n,) and stamps (n,) in ns, and the share of stamps that are near.

        A stamp that is far from the recorder's clock is replaced by the time of arrival.
        """
        arrival = self.times(series.ordinal, arrival_of(series))
        stamp = series.stamp + self.offset[self.part(series.ordinal)]
        near = np.abs(arrival - stamp) < CLOCK.stamp
        return arrival, np.where(near, stamp, arrival), float(near.mean())


def timeline(series: JointSeries) -> Timeline:
    """Return the timeline of a recording from the joint states of one arm. Its longest part keeps its times."""
    arrival = arrival_of(series)
    cuts = np.flatnonzero(_is_step(np.diff(arrival))) + 1
    if _is_in_another_order(arrival):
        cuts = cuts[:0]
    parts = [slice(*ends) for ends in pairwise((0, *cuts.tolist(), len(arrival)))]
    begin, end = np.array([(arrival[part].min(), arrival[part].max()) for part in parts]).T
    length = end - begin
    placed = np.concatenate(([0], np.cumsum(length[:-1] + CLOCK.join)))
    anchor = int(np.argmax(length))
    placed += begin[anchor] - placed[anchor]
    first, offset = series.ordinal[[part.start for part in parts]], placed - begin
    known = arrival + np.repeat(offset, [part.stop - part.start for part in parts])
    steps = tuple((arrival[cuts] - arrival[cuts - 1]).tolist())
    return Timeline(first, offset, placed, placed + length, steps, series.ordinal, known)


def arrival_of(series: JointSeries) -> np.ndarray:
    """Return times of arrival (n,) in ns, the stamp where that is unknown.

    A single time far from both of its neighbours, which agree, becomes that of the first of them.
    """
    arrival = np.where(series.arrival > 0, series.arrival, np.maximum(series.stamp, 0))
    is_step, around = _is_step(np.diff(arrival)), arrival[2:] - arrival[:-2]
    alone = is_step[:-1] & is_step[1:] & ~_is_step(around)
    return np.concatenate((arrival[:1], np.where(alone, arrival[:-2], arrival[1:-1]), arrival[1:][-1:]))


def _is_step(change: np.ndarray) -> np.ndarray:
    """Return which changes (n,) in ns from one time to the next are steps of the clock."""
    return (change < -CLOCK.back) | (change > CLOCK.ahead)


def _is_in_another_order(arrival: np.ndarray) -> bool:
    """Return whether the runs of times, sorted, follow each other: the file's order is then not that of arrival."""
    change = np.diff(arrival)
    cuts = np.flatnonzero((change < -CLOCK.back) | (change > CLOCK.join)) + 1
    runs = sorted((int(run.min()), int(run.max())) for run in np.split(arrival, cuts))
    gaps = [later[0] - earlier[1] for earlier, later in pairwise(runs)]
    return bool(np.any(change < -CLOCK.back)) and all(-CLOCK.back <= gap <= CLOCK.join for gap in gaps)


def efforts_in_force(sent: np.ndarray, effort: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Return the effort (n, joints) in Nm in force at each time of `clock` (n,) in ns, NaN where there was none.

    A command carries the stamp of the joint state that it answers: the last one sent before a joint state is in force.

    sent: (m,) ns, times of the commands in any order. effort: (m, joints) Nm.
    """
    order = np.argsort(sent, kind="stable")
    sent = sent[order]
    last = np.searchsorted(sent, clock, "left") - 1
    known = (last >= 0) & (clock - sent[last] < CLOCK.command_age)
    return np.where(known[:, None], effort[order[last]], np.float32(np.nan))
