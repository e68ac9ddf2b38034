# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The analysis of a trial: the holds of a recording, the drift in each, the response to pushes, and the verdict.

Drift is the slope of Huber's M-estimator (Huber 1964) fitted to means over parts of the hold. Averaging resolves less
than one position code, and a brief touch of the arm has little weight. The standard uncertainty combines the scatter
with one code over the length of the hold, because a reading that changed once may have been about to change at the
start.

Whether the arm held is judged within any 10 s of a hold, over the whole hold if a rate is given, and from release to
the end of a scripted hold. The last criterion fails an arm that falls at once and then hangs still.

SI units throughout: rad, rad/s, Nm, s. Arrays (joints,) are in the order of the recording's joints.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.command import State
from exo_gravity.sim.script import TRUNK_ACTIONS


@dataclass(frozen=True)
class AnalysisTuning:
    """When an arm counts as still, and how holds and motions are distinguished and measured.

    Stillness is judged from position only. Motors report velocity in steps of 22 to 24 mrad/s without a code for 0, so
    a motor at rest reports half a step. Position has steps of 0.38 mrad, and the speed limit over two blocks is ten of
    them.
    """

    block: float = 0.1  #: s, the time resolution of the analysis
    speed: float = 0.02  #: rad/s, or 69 degrees per minute: an arm that moves faster is not held
    blocks: int = 10  #: at most, for each sample: bounds the memory of a recording with long gaps
    margin: float = 0.2  #: s cut off at both ends of a still span, where a smooth motion can be slower than `speed`
    window: float = 10.0  #: s, over which `Hold.stray` is judged
    pose_time: float = 0.5  #: s before and after a motion, over which its first and last pose are averaged
    push_offset: float = 0.35  #: rad (20 degrees); a motion that ends farther away is a move to another pose
    huber: float = 1.345  #: standard deviations; gives 95 % efficiency on normal noise
    parts: int = 30  #: parts of a hold, to whose means the slope is fitted


TUNING = AnalysisTuning()
MOVED = {"slip": "slipped", "load": "gave way to a change of load"}  # what no held arm does, by the kind of the motion


ARRAYS = ("position", "velocity", "effort", "command")  # of a recording, (n, joints) each
Span = tuple[float, float]  # start and end in s
CARRIED = (State.RAMPING_IN, State.ACTIVE)  # the states of an arm's bridge in which its motors carry it


class ScriptedStep(NamedTuple):
    """A step of the trial script."""

    action: str  #: of `exo_gravity.sim.script`: 'move', 'hold', 'push', 'load', ...
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

    @cached_property
    def is_carried(self) -> np.ndarray:
        """Whether the motors carried the arm at each time, (n,)."""
        carried = np.zeros(len(self.time), bool)
        for start, end in self.while_carried(-math.inf, math.inf):
            carried |= (start <= self.time) & (self.time <= end)
        return carried


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
    sparse = float(time[-1] - time[0]) / (TUNING.blocks * len(time))
    length = max(TUNING.block, 3.0 * float(np.median(np.diff(time))), sparse)
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
    still = np.all(high - low < TUNING.speed * 2 * length, axis=1) & (filled > 0)
    return Blocks(starts, sample, mean, still, filled == 0)


def still_spans(recording: Recording, blocks: Blocks) -> Iterator[Span]:
    """Yield every span in which the arm was carried, still and, if there is a script, in one of its holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], blocks.still, [False])).astype(np.int8)))
    windows = [(step.start, step.end) for step in recording.steps if step.action == "hold"]
    for first, beyond in zip(edges[::2], edges[1::2], strict=True):
        # A block is still if it is still together with the block before it.
        start, end = blocks.time[max(first - 1, 0)] + TUNING.margin, blocks.time[beyond] - TUNING.margin
        for low, high in windows if recording.steps else ((start, end),):
            yield from recording.while_carried(float(max(start, low)), float(min(end, high)))


MIN_HOLD = 2.0  # s


@dataclass(frozen=True, eq=False)
class Hold:
    """A span in which the arm was left alone and still."""

    start: float  #: s
    end: float  #: s
    pose: np.ndarray  #: (joints,) rad, mean
    drift: np.ndarray  #: (joints,) rad, from the first part of the hold to its last
    drift_rate: np.ndarray  #: (joints,) rad/s
    drift_rate_uncertainty: np.ndarray  #: (joints,) rad/s, standard; NaN if the joint never changed its code
    stray: np.ndarray  #: (joints,) rad, largest range within any 10 s
    velocity_rms: np.ndarray  #: (joints,) rad/s as measured: half a velocity code for a motor at rest
    torque_rms: np.ndarray  #: (joints,) Nm, measured
    torque_error: np.ndarray  #: (joints,) Nm, RMS of commanded minus measured
    after: str  #: kind of the motion before it, or 'start'

    @property
    def duration(self) -> float:
        """Length in s."""
        return self.end - self.start


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion between two holds, or after the last one.

    Without a script, a motion that ends within 20 degrees of its start is taken for a push.
    """

    #: 'push', 'move', 'load', actions of the trunk ('bow', 'lean', 'walk', 'sit'), several as 'load, bow'; 'slip' (the
    #: arm moved during a hold of the script), 'gap' (nothing was recorded) or 'let down' (not carried throughout)
    kind: str
    start: float  #: s
    end: float  #: s
    peak: np.ndarray  #: (joints,) rad, signed, largest distance from the pose before
    residual: np.ndarray  #: (joints,) rad, pose after minus pose before; NaN if the arm was not still again
    until_still: float  #: s from the first movement; NaN likewise
    speed: np.ndarray  #: (joints,) rad/s, peak


@dataclass(frozen=True, eq=False)
class Release:
    """A scripted hold from release on, for as long as the arm was carried."""

    start: float  #: s
    end: float  #: s
    after: str  #: the script's action before it
    offset: np.ndarray  #: (joints,) rad, at its end
    still: bool  #: whether the arm was still at its end


@dataclass(frozen=True, eq=False)
class TrialAnalysis:
    """The result of `analyse`."""

    holds: tuple[Hold, ...]
    motions: tuple[Motion, ...]
    releases: tuple[Release, ...]


def analyse(recording: Recording, min_hold: float = MIN_HOLD) -> TrialAnalysis:
    """Return the holds of at least `min_hold` s, the motions between them and, with a script, the releases."""
    blocks = in_blocks(recording)
    steps = np.abs(np.diff(recording.position, axis=0))
    smallest = steps.min(axis=0, initial=math.inf, where=steps > 1e-6)
    resolution = np.where(np.isfinite(smallest), smallest, 0.0)  # rad, one position code; 0 if no step occurred
    shortest = max(min_hold, 4 * blocks.length) - 1e-6  # a slope requires three whole blocks
    spans = [(start, end) for start, end in still_spans(recording, blocks) if end - start >= shortest]
    motions = tuple(_motion(recording, blocks, *ends) for ends in pairwise(spans))
    kinds = ["start", *(motion.kind for motion in motions)]
    holds = tuple(_hold(recording, blocks, resolution, span, kind) for span, kind in zip(spans, kinds, strict=False))
    motions += tuple(_last_motions(recording, blocks, spans[-1])) if spans else ()
    return TrialAnalysis(holds, motions, tuple(_releases(recording, blocks)))


def _last_motions(recording: Recording, blocks: Blocks, last: Span) -> Iterator[Motion]:
    """Yield the motions after the `last` hold: one while the arm was carried, and the let-down."""
    recorded = float(recording.time[-1])
    released = recording.carried[-1][1] if recording.carried else recorded
    end = min([released, *(step.end for step in recording.steps[-1:])])
    if end - last[1] > MIN_HOLD:
        yield _motion(recording, blocks, last, (end, end))
    # A virtual wearer continues with the next step even if the arm is not carried. That is not part of the let-down.
    going_on = (s.start for s in recording.steps if s.start > released and s.action not in ("hold", "done"))
    down = min([recorded, *going_on])
    if down - released > blocks.length:
        yield _motion(recording, blocks, (last[0], released), (down, down))


def _hold(recording: Recording, blocks: Blocks, resolution: np.ndarray, span: Span, after: str) -> Hold:
    within = blocks.between(*span)
    samples = slice(*blocks.sample[[within.start, within.stop]])
    mean = blocks.mean[within]
    parts = np.array_split(np.arange(len(mean)), min(len(mean), TUNING.parts))
    part_time = np.array([blocks.time[within][part].mean() for part in parts])
    part_mean = np.array([mean[part].mean(axis=0) for part in parts])
    rate, scatter = robust_slope(part_time, part_mean, resolution)
    width = min(len(mean), max(1, round(TUNING.window / blocks.length)))
    windows = np.lib.stride_tricks.sliding_window_view(mean, width, axis=0)
    effort, command = recording.effort[samples], recording.command[samples]
    return Hold(
        *span,
        pose=mean.mean(axis=0),
        drift=part_mean[-1] - part_mean[0],
        drift_rate=rate,
        drift_rate_uncertainty=np.where(resolution, np.hypot(scatter, resolution / (span[1] - span[0])), math.nan),
        stray=(windows.max(axis=-1) - windows.min(axis=-1)).max(axis=0),
        velocity_rms=_rms(recording.velocity[samples]),
        torque_rms=_rms(effort),
        torque_error=_rms(command - effort),
        after=after,
    )


def robust_slope(x: np.ndarray, y: np.ndarray, resolution: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope (k,) of y (m, k) over x (m,), m > 2, and its standard uncertainty (k,) from the scatter.

    This is Huber's M-estimator by reweighted least squares. resolution: (k,); half of it is the smallest scale used.
    """
    weight = np.ones_like(y)
    for _ in range(30):
        total = weight.sum(axis=0)
        dx = x[:, None] - (weight * x[:, None]).sum(axis=0) / total
        dy = y - (weight * y).sum(axis=0) / total
        spread = (weight * dx * dx).sum(axis=0)
        slope = (weight * dx * dy).sum(axis=0) / spread
        residual = np.abs(dy - slope * dx)
        scale = np.maximum(1.4826 * np.median(residual, axis=0), resolution / 2) + 1e-12
        weight = np.minimum(1.0, TUNING.huber * scale / np.maximum(residual, 1e-12))
    return slope, np.sqrt((weight * residual**2).sum(axis=0) / (len(x) - 2) / spread)


def _motion(recording: Recording, blocks: Blocks, left: Span, right: Span) -> Motion:
    """Return the motion from the end of span `left` to the start of `right`, which is empty if no hold followed."""
    before = blocks.mean[blocks.between(max(left[0], left[1] - TUNING.pose_time), left[1])].mean(axis=0)
    after = blocks.mean[blocks.between(right[0], min(right[1], right[0] + TUNING.pose_time))].mean(axis=0)
    within = blocks.between(left[1], right[0])
    samples = slice(*blocks.sample[[within.start, within.stop]])
    joints = np.arange(len(before))
    away = np.vstack((np.zeros(len(before)), recording.position[samples] - before))
    is_still, residual = right[1] > right[0], after - before
    return Motion(
        kind=_kind(recording, left[1], right[0], bool(blocks.empty[within].any()), residual),
        start=left[1],
        end=right[0],
        peak=away[np.abs(away).argmax(axis=0), joints],
        residual=residual if is_still else np.full(len(before), math.nan),
        until_still=max(0.0, right[0] - left[1] - TUNING.margin) if is_still else math.nan,
        speed=np.abs(recording.velocity[samples]).max(axis=0, initial=0.0),
    )


def _kind(recording: Recording, start: float, end: float, empty: bool, residual: np.ndarray) -> str:
    actions = {step.action for step in recording.steps if step.start < end - 1e-6 and step.end > start + 1e-6}
    if tuple(recording.while_carried(start, end)) != ((start, end),):
        return "let down"
    if empty:
        return "gap"
    if not recording.steps:
        return "push" if np.all(np.abs(residual) < TUNING.push_offset) else "move"
    guided = next((action for action in ("move", "push") if action in actions), "")
    return guided or ", ".join(action for action in ("load", *TRUNK_ACTIONS) if action in actions) or "slip"


def _releases(recording: Recording, blocks: Blocks) -> Iterator[Release]:
    after = "start"
    for step in recording.steps:
        parts = recording.while_carried(step.start, min(step.end, float(recording.time[-1])))
        start, end = next(parts, (step.start, step.start))
        # A hold that was cut short shows the hand that has just let go, not the arm.
        if step.action == "hold" and end - start >= min(MIN_HOLD, step.end - step.start):
            within = blocks.between(start, end)
            filled = within.start + np.flatnonzero(~blocks.empty[within])  # the end may lie in a gap
            if len(filled):
                first, last = filled[[0, -1]]
                yield Release(start, end, after, blocks.mean[last] - blocks.mean[first], bool(blocks.still[last]))
        after = step.action


def _rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square (joints,) of the finite values among (n, joints); NaN for a joint that has none."""
    mean: np.ndarray = np.ma.masked_invalid(np.square(values, dtype=float)).mean(axis=0).filled(math.nan)
    return np.sqrt(mean)


@dataclass(frozen=True)
class HoldCriteria:
    """How far a held arm may drift."""

    max_stray: float = math.radians(0.5)  #: rad within any 10 s of a hold
    max_stray_after_push: float = math.radians(2.0)  #: rad, the same for a hold after a push
    max_rate: float = math.inf  #: rad/s over a hold
    max_offset: float = math.radians(2.0)  #: rad between release and the end of a scripted hold
    #: s, shortest hold that is judged by its rate: over a shorter one, a single position code is already a large rate
    rated_from: float = 0.0

    def stray_allowed(self, hold: Hold) -> float:
        """Return how far a joint may stray within any 10 s of `hold`, rad."""
        return self.max_stray_after_push if hold.after == "push" else self.max_stray

    def stayed(self, release: Release) -> bool:
        """Return whether the arm stayed where it was let go; after a push it may move."""
        return release.after == "push" or bool(np.max(np.abs(release.offset)) <= self.max_offset)
