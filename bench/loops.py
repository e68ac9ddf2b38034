# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the loop: every rate, against the same law without ROS and on bare rclpy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from exo_gravity.core.safety.gate import START_GATE
from exo_gravity.core.safety.guidance import GUIDANCE

from .loop import BOTH_ARMS, ONE_ARM, QUIET, QUIET_OTHERS, SEVEN_JOINTS, LoopRun, run_loop
from .table import Row
from .timing import percentile

RATES = (
    *(("one arm", ONE_ARM, rate) for rate in (200, 500, 1000)),
    *(("both arms", BOTH_ARMS, rate) for rate in (200, 500)),
    ("seven joints on CAN FD", SEVEN_JOINTS, 500),
)
QUICK_RATES = (RATES[1], RATES[3])
KINDS = ("nodes", "one process", "python", "rclpy")
PEERS = ("python", "Python without ROS"), ("rclpy", "bare rclpy")
ATTEMPTS = 2
PARTS = 5  # of a run; the lowest and the highest of their figures are the spread

Runs = dict[str, LoopRun]  # by kind
Progress = Callable[[str], None]


def measure_loops(quick: bool, progress: Progress) -> Iterator[Row]:
    """Yield the rows of every rate, then of the start."""
    starts = []
    for arms, file, rate in QUICK_RATES if quick else RATES:
        runs: Runs = {}
        for kind in KINDS:
            progress(f"loop, {arms}, {rate} Hz: {kind}")
            if run := quietest_run(kind, rate, file, 5.0 if quick else 20.0, progress):
                runs[kind] = run
        name = f"loop, {arms}, {rate} Hz"
        yield from rows_of(name, rate, runs, "nodes")
        yield from rows_of(f"{name}, one process", rate, runs, "one process")
        if "nodes" in runs:
            starts.append(runs["nodes"].start)
    if starts:
        median = float(np.median(starts))
        least = START_GATE.calm + GUIDANCE.time + GUIDANCE.watch
        yield Row("start, launch to active: the checks and the begin of the torque", median, least, "s", _range(starts))


def quietest_run(kind: str, rate: int, file: str, seconds: float, progress: Progress) -> LoopRun | None:
    """Return the run from which least was taken, of up to `ATTEMPTS`; None if none carried the arm."""
    best = None
    for _ in range(ATTEMPTS):
        try:
            run = run_loop(kind, rate, file, seconds)
        except RuntimeError as error:
            progress(f"  {error}")
            continue
        best = run if best is None or run.stolen + run.others < best.stolen + best.others else best
        if not best.is_disturbed:
            break
        progress(f"  disturbed: the hypervisor took {run.stolen:.1%} of the cores, other programs {run.others:.1%}")
    return best


def rows_of(name: str, rate: int, runs: Runs, kind: str) -> Iterator[Row]:
    """Yield the table's rows of the loop `name` at `rate` (Hz): runs of `kind` next to those of its peers."""
    period, allowed = 1e3 / rate, 1.0 if rate == 1000 else 0.1
    if kind not in runs:
        disturbed = any(run.is_disturbed for run in runs.values())
        yield Row(f"{name}, missed (it did not run): limit", 100.0, allowed, "%", disturbed=disturbed)
        return
    ours = runs[kind]

    def row(what: str, figure: float, other: float, unit: str, spread: str = "", of: str = kind) -> Row:
        """Return a row whose second figure is one of the kind `of`."""
        return Row(f"{name}, {what}", figure, other, unit, spread, disturbed=ours.is_disturbed or runs[of].is_disturbed)

    others = (*PEERS, ("nodes", "two processes")) if kind == "one process" else PEERS
    peers = [(peer_kind, peer) for peer_kind, peer in others if peer_kind in runs]
    for share in (50, 99, 99.9):
        figure, spread = _latency(ours, share)
        for of, peer in peers:
            yield row(f"p{share:g}: {peer}", figure, _latency(runs[of], share)[0], "ms", spread, of)
        if share == 99:
            yield row("p99: one period", figure, period, "ms", spread)
    spacing = np.concatenate([arm.spacing for arm in ours.arms]) * 1e3
    for share in (99, 99.9):
        yield row(f"spacing p{share:g}: one period", percentile(spacing, share), period, "ms")
    for what in ("missed", "late", "incomplete", "lost"):
        percents = _percents(ours, what)
        mean, spread = float(np.mean(percents)), _range(percents)
        yield row(f"{what}: limit", mean, allowed, "%", spread)
        for of, peer in peers:
            yield row(f"{what}: {peer}", mean, float(np.mean(_percents(runs[of], what))), "%", spread, of)
    yield row("taken by the hypervisor: quiet", 100.0 * ours.stolen, 100.0 * QUIET, "%")
    yield row("taken by other programs: quiet", 100.0 * ours.others, 100.0 * QUIET_OTHERS, "%")
    bridge = ("bridge", "compensator") if kind == "one process" else ("bridge",)
    counterparts = {"can_bridge": bridge, "compensator": ("compensator",)}
    for node in sorted({full_name.rpartition("/")[2] for full_name in ours.cpu}):
        shares = _cpu_shares(ours, node)
        total, spread = sum(shares), _range(shares)
        if node in counterparts and "rclpy" in runs:
            bare = sum(sum(_cpu_shares(runs["rclpy"], part)) for part in counterparts[node])
            yield row(f"CPU of {node}: bare rclpy", total, bare, "%", spread, "rclpy")
        else:
            yield row(f"CPU of {node}: a core", total, 100.0, "%", spread)


def _cpu_shares(run: LoopRun, node: str) -> list[float]:
    """Return the share of a core in percent of each process of this node, for one arm or two."""
    return [100.0 * share for full_name, share in run.cpu.items() if full_name.rpartition("/")[2] == node]


def _percents(run: LoopRun, what: str) -> list[float]:
    """Return the share of each arm's cycles in percent that were `what`: missed, late, incomplete or lost."""
    return [100.0 * getattr(arm, what) / arm.cycles for arm in run.arms]


def _latency(run: LoopRun, share: float) -> tuple[float, str]:
    """Return the percentile in ms over all arms, and its range over parts of the run."""
    parts = [
        percentile(part, share) * 1e3 for arm in run.arms for part in np.array_split(arm.latency, PARTS) if len(part)
    ]
    return percentile(np.concatenate([arm.latency for arm in run.arms]), share) * 1e3, _range(parts)


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.3g} to {max(values):.3g}" if len(values) > 1 else ""
