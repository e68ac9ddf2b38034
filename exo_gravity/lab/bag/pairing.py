# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which command was in force at each joint state.

An arm's command carries the stamp of the joint state that it answers. The command in force at a joint state is the last
one whose time is before that of the state. Times are stamps; where these run backwards or are far from the recorder's
clock, they are times of arrival.
"""

from dataclasses import dataclass

import numpy as np

from exo_gravity.lab.bag.clock import Timeline, without_outliers
from exo_gravity.lab.bag.joints import JointArrays, JointSeries


@dataclass(frozen=True)
class Pairing:
    """Which messages belong together."""

    command_age: int = 200_000_000  #: ns; an older command is no longer in force
    clock_offset: int = 1_000_000_000  #: ns between stamp and arrival
    pending: int = 100_000  #: commands, 4 MB, after which those that are not needed are forgotten


PAIRING = Pairing()


def arrival_of(series: JointSeries) -> np.ndarray:
    """Return times of arrival (n,) in ns, the stamp where that of arrival is unknown."""
    return without_outliers(_known_arrival(series))


def _known_arrival(series: JointSeries) -> np.ndarray:
    return np.where(series.arrival > 0, series.arrival, np.maximum(series.stamp, 0))


def clocks_of(series: JointSeries, line: Timeline) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times of arrival (n,) and stamps (n,) in ns on the timeline, and the share of stamps that are near.

    A stamp that is far from the recorder's clock is replaced by the time of arrival.
    """
    arrival = line.times(series.ordinal, series.arrival)
    stamp = series.stamp + line.offset[line.part(series.ordinal)]
    near = _is_near(arrival, stamp)
    return arrival, np.where(near, stamp, arrival), float(near.mean())


def _is_near(arrival: np.ndarray, stamp: np.ndarray) -> np.ndarray:
    near: np.ndarray = np.abs(arrival - stamp) < PAIRING.clock_offset
    return near


def efforts_in_force(sent: np.ndarray, effort: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Return the effort (n, joints) in Nm in force at each time of `clock` (n,) in ns, NaN where there was none.

    sent: (m,) ns, times of the commands in any order. effort: (m, joints) Nm.
    """
    order = np.argsort(sent, kind="stable")
    sent = sent[order]
    last = np.searchsorted(sent, clock, "left") - 1
    known = (last >= 0) & (clock - sent[last] < PAIRING.command_age)
    result = np.full((len(clock), effort.shape[1]), np.nan, np.float32)
    result[known] = effort[order[last[known]]]
    return result


class Thinning:
    """Forgets the commands of one arm that were in force at none of its joint states kept, by stamps or by arrival.

    Of two commands that follow each other, the first is needed if a joint state lies between them, or if their clock
    steps. The newest ones wait for their joint states.
    """

    def __init__(self) -> None:
        self._seen = 0  # commands, when this looked last
        self._settled: dict[tuple[str, ...], int] = {}  # commands by their joints, from the first on, that stay

    def apply(self, commands: JointArrays, states: JointArrays) -> None:
        """Forget commands, if there are enough new ones."""
        known = [growing.series for growing in states.by_joints.values()]
        if not known or commands.count - self._seen < PAIRING.pending:
            return
        self._seen = commands.count
        instants = [np.concatenate(clock) for clock in zip(*map(_clocks, known), strict=True)]
        newest = max(known, key=lambda series: int(series.ordinal[-1]))
        settled_before = int(_known_arrival(newest)[-1]) - 2 * PAIRING.clock_offset
        for names, growing in commands.by_joints.items():
            begin = self._settled.get(names, 0)
            clocks = _clocks(growing.series.of(slice(begin, None)))
            is_new = np.maximum(*clocks) >= settled_before
            count = int(np.argmax(is_new)) if is_new.any() else len(is_new) - 1
            needed = np.zeros(count, bool)
            for sent, of_states in zip(clocks, instants, strict=True):
                needed |= _is_needed(sent[: count + 1], of_states)
            growing.leave_out(begin, ~needed)
            self._settled[names] = begin + int(needed.sum())


def _is_needed(sent: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return whether each command but the last may be in force at a joint state: (n,), with sent (n + 1,) in ns."""
    near = np.sort(states[(states > sent.min()) & (states <= sent.max())])
    step = np.diff(sent)
    is_followed = np.diff(np.searchsorted(near, sent, "right")) > 0
    needed: np.ndarray = is_followed | (step < 0) | (step > PAIRING.command_age)
    return needed


def _clocks(series: JointSeries) -> tuple[np.ndarray, np.ndarray]:
    """Return times of arrival (n,) and stamps (n,) in ns, before steps of the clock are known."""
    arrival = _known_arrival(series)
    return arrival, np.where(_is_near(arrival, series.stamp), series.stamp, arrival)
