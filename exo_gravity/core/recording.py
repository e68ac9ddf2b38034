"""One arm's recorded arrays, and the stretches in which it was carried, left alone and still.

Stillness is judged by position alone. The motors send velocity in steps of 22 to 24 mrad/s without a code for 0, so one
at rest reports half a step; position comes in steps of 0.38 mrad, ten of which are `STILL_SPEED` over two blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.errors import DataError

BLOCK = 0.1  # s, the grain of the analysis
STILL_SPEED = 0.02  # rad/s: 69 degrees per minute is no hold any more
MARGIN = 0.2  # s at both ends of a stillness, in which a smooth motion is still, or already, slower than that


Span = tuple[float, float]  # from, to, in s


class ScriptedStep(NamedTuple):
    """A step that the wearer was told: its action ('move', 'hold' or 'push'), when it began and ended, in s."""

    action: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Recording:
    """One arm over time. Raises DataError where shapes differ, time runs back or a position is not finite.

    name: of the arm. time: (n,) s. position, velocity, effort (measured), command (effort asked for): (n, 4), NaN
    where unknown, but for position. steps: what the wearer was told, empty if nobody recorded it. carried: when the
    motors carried the arm, in order; outside of it, it is off or on its way down. None if nobody recorded that: then it
    counts as carried all the while.
    """

    name: str
    joint_names: tuple[str, ...]
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    command: np.ndarray
    steps: tuple[ScriptedStep, ...] = ()
    carried: tuple[Span, ...] | None = None

    def __post_init__(self):
        if len(self.joint_names) != JOINT_COUNT:
            raise DataError(f"{self.name}: joints are {', '.join(self.joint_names)}: must be {JOINT_COUNT}")
        shape = (len(self.time), JOINT_COUNT)
        for field in ("position", "velocity", "effort", "command"):
            if getattr(self, field).shape != shape:
                raise DataError(f"{self.name}: {field} has the shape {getattr(self, field).shape}: must be {shape}")
        if len(self.time) < 2 or np.any(np.diff(self.time) < 0):
            raise DataError(f"{self.name}: {len(self.time)} samples: must be at least 2, in the order of their times")
        if not np.all(np.isfinite(self.position)):
            raise DataError(f"{self.name}: position has NaN or infinite values: must be finite")

    def while_carried(self, start: float, end: float) -> Iterator[Span]:
        """Yield the parts of `start` to `end` (s) in which the arm was carried."""
        for first, last in ((start, end),) if self.carried is None else self.carried:
            if max(start, first) < min(end, last):
                yield max(start, first), min(end, last)


class Blocks(NamedTuple):
    """The recording in blocks of 0.1 s: their first times (m + 1,), first samples (m + 1,), and for each block the mean
    position (m, 4), whether the arm was still (m,) and whether nothing was recorded (m,)."""

    time: np.ndarray
    sample: np.ndarray
    mean: np.ndarray
    still: np.ndarray
    empty: np.ndarray

    @property
    def length(self) -> float:
        """Length of a block in s."""
        return float(self.time[1] - self.time[0])

    def between(self, start: float, end: float) -> slice:
        """Return the blocks that lie within [start, end], at least one."""
        first = min(int(np.searchsorted(self.time, start - 1e-6)), len(self.still) - 1)
        return slice(first, max(first + 1, int(np.searchsorted(self.time, end + 1e-6, "right")) - 1))


def in_blocks(recording: Recording) -> Blocks:
    """Return the recording in blocks of 0.1 s, or of three samples where it is slower than 30 Hz."""
    time, position = recording.time, recording.position
    length = max(BLOCK, 3.0 * float(np.median(np.diff(time))))
    count = int((time[-1] - time[0]) / length) + 1
    starts = time[0] + length * np.arange(count + 1)
    sample = np.searchsorted(time, starts)
    sample[-1] = len(time)
    filled = np.diff(sample)
    # Of an empty block reduceat gives the sample that comes next.
    first = np.minimum(sample[:-1], len(time) - 1)
    mean = np.add.reduceat(position, first, axis=0, dtype=float) / np.maximum(filled, 1)[:, None]
    low, high = (extreme.reduceat(position, first, axis=0) for extreme in (np.minimum, np.maximum))
    low[1:], high[1:] = np.minimum(low[1:], low[:-1]), np.maximum(high[1:], high[:-1])
    still = np.all(high - low < STILL_SPEED * 2 * length, axis=1) & (filled > 0)
    return Blocks(starts, sample, mean, still, filled == 0)


def still_spans(recording: Recording, blocks: Blocks) -> Iterator[Span]:
    """Yield (start, end) in s of every stretch in which the arm was carried, still, and by the script left alone."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], blocks.still, [False])).astype(np.int8)))
    windows = [(step.start, step.end) for step in recording.steps if step.action == "hold"]
    for first, beyond in zip(edges[::2], edges[1::2], strict=True):
        # Block k is still together with block k - 1.
        start, end = blocks.time[max(first - 1, 0)] + MARGIN, blocks.time[beyond] - MARGIN
        for low, high in windows if recording.steps else ((start, end),):
            yield from recording.while_carried(float(max(start, low)), float(min(end, high)))


def position_resolution(values: np.ndarray) -> float:
    """Return the smallest step (rad) between one sample and the next: one position code, or 0 if it never changed."""
    steps = np.abs(np.diff(values))
    return float(steps.min(initial=math.inf, where=steps > 1e-6)) if steps.max() > 1e-6 else 0.0
