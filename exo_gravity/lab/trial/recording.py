# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The recorded arrays of one arm, and the time spans in which it was carried, left alone and still.

Stillness is judged from position only. Motors report velocity in steps of 22 to 24 mrad/s without a code for 0, so a
motor at rest reports half a step. Position has steps of 0.38 mrad, and the speed limit over two blocks is ten of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.command import State


@dataclass(frozen=True)
class Stillness:
    """When an arm counts as still."""

    block: float = 0.1  #: s, the time resolution of the analysis
    speed: float = 0.02  #: rad/s, or 69 degrees per minute: an arm that moves faster is not held
    blocks: int = 10  #: at most, for each sample: bounds the memory of a recording with long gaps
    margin: float = 0.2  #: s cut off at both ends of a still span, where a smooth motion can be slower than `speed`


STILLNESS = Stillness()


ARRAYS = ("position", "velocity", "effort", "command")  # of a recording, (n, joints) each
Span = tuple[float, float]  # start and end in s
CARRIED = (State.RAMPING_IN, State.ACTIVE)  # the states of an arm's bridge in which its motors carry it


class ScriptedStep(NamedTuple):
    """A step of the trial script."""

    action: str  #: 'move', 'hold' or 'push'
    start: float  #: s
    end: float  #: s


@dataclass(frozen=True, eq=False)
class Recording:
    """The recording of one arm. Raises DataError if all its samples have the same time."""

    name: str  #: of the arm
    joint_names: tuple[str, ...]
    time: np.ndarray  #: (n,) s, ascending
    position: np.ndarray  #: (n, joints) rad, finite
    velocity: np.ndarray  #: (n, joints) rad/s, NaN where unknown
    effort: np.ndarray  #: (n, joints) Nm, measured, NaN where unknown
    command: np.ndarray  #: (n, joints) Nm, requested, NaN where unknown
    steps: tuple[ScriptedStep, ...] = ()  #: of the script, empty if they were not recorded
    #: The spans in which the motors carried the arm, in order; outside of them it is off or being let down. None if
    #: these were not recorded: the arm is then taken to be carried throughout.
    carried: tuple[Span, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.time) == 0 or self.time[-1] == self.time[0]:
            raise DataError(f"{self.name}: all {len(self.time)} samples have the same time: it must advance")

    def in_order(self, joint_names: Sequence[str]) -> "Recording":
        """Return the recording with its joints in this order. Raises DataError if they are others."""
        if sorted(self.joint_names) != sorted(joint_names):
            raise DataError(f"{self.name}: joints = {', '.join(self.joint_names)}: must be {', '.join(joint_names)}")
        order = [self.joint_names.index(name) for name in joint_names]
        arrays = {name: getattr(self, name)[:, order] for name in ARRAYS}
        return replace(self, joint_names=tuple(joint_names), **arrays)

    def while_carried(self, start: float, end: float) -> Iterator[Span]:
        """Yield the parts of the span from `start` to `end` (s) in which the arm was carried."""
        for first, last in ((start, end),) if self.carried is None else self.carried:
            if max(start, first) < min(end, last):
                yield max(start, first), min(end, last)


class Blocks(NamedTuple):
    """The recording in blocks of 0.1 s."""

    time: np.ndarray  #: (m + 1,) s, the start of each block and the end of the last
    sample: np.ndarray  #: (m + 1,), the first sample of each block and the end
    mean: np.ndarray  #: (m, joints) rad, mean position
    still: np.ndarray  #: (m,), whether the arm was still
    empty: np.ndarray  #: (m,), whether the block has no samples

    @property
    def length(self) -> float:
        """Length of a block in s."""
        return float(self.time[1] - self.time[0])

    def between(self, start: float, end: float) -> slice:
        """Return the slice of the blocks within [start, end], at least one block."""
        first = min(int(np.searchsorted(self.time, start - 1e-6)), len(self.still) - 1)
        return slice(first, max(first + 1, int(np.searchsorted(self.time, end + 1e-6, "right")) - 1))


def in_blocks(recording: Recording) -> Blocks:
    """Return the recording in blocks of 0.1 s, or of three samples if its rate is below 30 Hz.

    There are no more than a few blocks for each sample, however long the recording was without any.
    """
    time, position = recording.time, recording.position
    sparse = float(time[-1] - time[0]) / (STILLNESS.blocks * len(time))
    length = max(STILLNESS.block, 3.0 * float(np.median(np.diff(time))), sparse)
    count = int((time[-1] - time[0]) / length) + 1
    starts = time[0] + length * np.arange(count + 1)
    sample = np.searchsorted(time, starts)
    sample[-1] = len(time)
    filled = np.diff(sample)
    # For an empty block, reduceat returns the next sample.
    first = np.minimum(sample[:-1], len(time) - 1)
    mean = np.add.reduceat(position, first, axis=0, dtype=float) / np.maximum(filled, 1)[:, None]
    low, high = (extreme.reduceat(position, first, axis=0) for extreme in (np.minimum, np.maximum))
    low[1:], high[1:] = np.minimum(low[1:], low[:-1]), np.maximum(high[1:], high[:-1])
    still = np.all(high - low < STILLNESS.speed * 2 * length, axis=1) & (filled > 0)
    return Blocks(starts, sample, mean, still, filled == 0)


def still_spans(recording: Recording, blocks: Blocks) -> Iterator[Span]:
    """Yield every span in which the arm was carried, still and, if there is a script, in one of its holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], blocks.still, [False])).astype(np.int8)))
    windows = [(step.start, step.end) for step in recording.steps if step.action == "hold"]
    for first, beyond in zip(edges[::2], edges[1::2], strict=True):
        # A block is still if it is still together with the block before it.
        start, end = blocks.time[max(first - 1, 0)] + STILLNESS.margin, blocks.time[beyond] - STILLNESS.margin
        for low, high in windows if recording.steps else ((start, end),):
            yield from recording.while_carried(float(max(start, low)), float(min(end, high)))
