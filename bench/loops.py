"""The rows of the loop: each rate, with the same law without ROS and on bare rclpy beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from bench.latency import percentile
from bench.loop import OURS, Result, run
from bench.table import Row
from exo_gravity.core.safety import CALM

RATES = (("one arm", False, 200), ("one arm", False, 500), ("one arm", False, 1000), ("both arms", True, 200),
         ("both arms", True, 500))  # fmt: skip
QUICK = (RATES[1], RATES[3])
RAMP = 1.0  # s, can_bridge's ramp_time
KINDS = ("nodes", "fifo", "python", "rclpy")
PEERS = ("python", "Python without ROS"), ("rclpy", "bare rclpy")
TRIES = 3
QUIET = 0.01  # share of a core that a hypervisor may give to others in a run that counts as quiet
PARTS = 5  # of the time, whose least and largest figure are the spread


def loops(quick: bool, progress: Callable[[str], None]) -> Iterator[Row]:
    """Yield the rows of every rate, then of the start."""
    starts = []
    for arms, both, rate in QUICK if quick else RATES:
        results = {}
        for kind in KINDS:
            if kind == "fifo" and (both or rate < 500):  # they would leave no processor to two devices
                continue
            progress(f"loop, {arms}, {rate} Hz: {kind}")
            if result := _quietest(kind, rate, both, 5.0 if quick else 20.0, progress):
                results[kind] = result
        name = f"loop, {arms}, {rate} Hz"
        yield from _rows(name, rate, results, "nodes")
        if "fifo" in results:
            yield from _rows(f"{name}, thread_priority {OURS['fifo']}", rate, results, "fifo")
        if "nodes" in results:
            starts.append(results["nodes"].start)
    if starts:
        median = float(np.median(starts))
        yield Row("start, launch to active: the checks and the ramp", median, CALM + RAMP, "s", _ends(starts))


def _quietest(kind: str, rate: int, both: bool, seconds: float, progress: Callable[[str], None]) -> Result | None:
    """Return the run in which the hypervisor took least, of no more than `TRIES`; None if none carried the arm."""
    best = None
    for _ in range(TRIES):
        try:
            result = run(kind, rate, both, seconds)
        except RuntimeError as error:
            progress(f"  {error}")
            continue
        best = result if best is None or result.stolen < best.stolen else best
        if best.stolen <= QUIET:
            break
        progress(f"  the hypervisor took {100 * result.stolen:.1f}% of a core")
    return best


def _rows(name: str, rate: int, results: dict[str, Result], kind: str) -> Iterator[Row]:
    period, allowed = 1e3 / rate, 1.0 if rate == 1000 else 0.1
    if kind not in results:
        yield Row(f"{name}, missed (it did not run): limit", 100.0, allowed, "%")
        return
    ours = results[kind]
    for share in (50, 99, 99.9):
        figure, spread = _latency(ours, share)
        for other, peer in PEERS:
            if other in results:
                yield Row(f"{name}, p{share:g}: {peer}", figure, _latency(results[other], share)[0], "ms", spread)
        if share == 99:
            yield Row(f"{name}, p99: one period", figure, period, "ms", spread)
    spacing = np.concatenate([arm.spacing for arm in ours.arms]) * 1e3
    for share in (99, 99.9):
        yield Row(f"{name}, spacing p{share:g}: one period", percentile(spacing, share), period, "ms")
    for what in ("missed", "late", "incomplete", "lost"):
        percents = _percents(ours, what)
        yield Row(f"{name}, {what}: limit", float(np.mean(percents)), allowed, "%", _ends(percents))
        for other, peer in PEERS:
            if other in results:
                theirs = float(np.mean(_percents(results[other], what)))
                yield Row(f"{name}, {what}: {peer}", float(np.mean(percents)), theirs, "%", _ends(percents))
    yield Row(f"{name}, taken by the hypervisor: quiet", 100.0 * ours.stolen, 100.0 * QUIET, "%")
    yield from _cpu(name, results, kind)


def _cpu(name: str, results: dict[str, Result], kind: str) -> Iterator[Row]:
    """Yield what each node takes of a core: against what does the same without the rest, or against the core."""
    peers = {"can_bridge": ("rclpy", "bridge", "bare rclpy"), "compensator": ("rclpy", "answer", "bare rclpy")}
    for node in sorted({full.rpartition("/")[2] for full in results[kind].cpu}):
        other, part, peer = peers.get(node, ("", "", "a core"))
        limit = _share(results[other], part) if other in results else 100.0
        shares = [100.0 * used for full, used in results[kind].cpu.items() if full.endswith(node)]
        peer = peer if other in results else "a core"
        yield Row(f"{name}, CPU of {node}: {peer}", sum(shares), limit, "%", _ends(shares))


def _share(result: Result, part: str) -> float:
    return sum(100.0 * used for full, used in result.cpu.items() if full.endswith(f"/{part}"))


def _percents(result: Result, what: str) -> list[float]:
    """Return the share of cycles, in percent of each arm's, that were `what`: missed, late, incomplete or lost."""
    return [100.0 * getattr(arm, what) / arm.cycles for arm in result.arms]


def _latency(result: Result, share: float) -> tuple[float, str]:
    """Return the percentile in ms over all arms, and its range over parts of the time."""
    parts = [
        percentile(part, share) * 1e3 for arm in result.arms for part in np.array_split(arm.latency, PARTS) if len(part)
    ]
    return percentile(np.concatenate([arm.latency for arm in result.arms]), share) * 1e3, _ends(parts)


def _ends(values: Sequence[float]) -> str:
    return f"{min(values):.3g} to {max(values):.3g}" if len(values) > 1 else ""
