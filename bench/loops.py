# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the loop: every rate, against the same law without ROS and on bare rclpy.

The kinds of loop take turns, so that other load on the machine affects all of them alike; a row compares run by run.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.safety.start import START_GATE

from .loop import BOTH_ARMS, ONE_ARM, SEVEN_JOINTS, LoopRun, run_loop
from .table import Row
from .timing import percentile

RATES = (
    *(("one arm", ONE_ARM, rate) for rate in (200, 500, 1000)),
    *(("both arms", BOTH_ARMS, rate) for rate in (200, 500)),
    ("seven joints on CAN FD", SEVEN_JOINTS, 500),
)
QUICK_RATES = (RATES[1], RATES[3])
KINDS = ("nodes", "one process", "python", "rclpy")
PEERS = {"python": "Python without ROS", "rclpy": "bare rclpy"}
TURNS, SECONDS, QUICK_SECONDS = 3, 10.0, 5.0

Turn = dict[str, LoopRun]  # a run of each kind that carried the arm
Figure = Callable[[LoopRun], float]
Progress = Callable[[str], None]


def measure_loops(quick: bool, progress: Progress) -> Iterator[Row]:
    """Yield the rows of every rate, then of the start."""
    starts: list[float] = []
    for arms, file, rate in QUICK_RATES if quick else RATES:
        name, turns = f"loop, {arms}, {rate} Hz", []
        for number in range(1 if quick else TURNS):
            progress(f"{name}, turn {number + 1}")
            turns.append(run_turn(rate, file, QUICK_SECONDS if quick else SECONDS, progress))
        yield from rows_of(name, rate, turns, "nodes")
        yield from rows_of(f"{name}, one process", rate, turns, "one process")
        starts += [turn["nodes"].start for turn in turns if "nodes" in turn]
    if starts:
        least = START_GATE.calm + GUIDANCE.time + GUIDANCE.watch
        what = "start, launch to active: the checks and the begin of the torque"
        yield Row.of_values(what, starts, [least] * len(starts), "s")


def run_turn(rate: int, file: str, seconds: float, progress: Progress) -> Turn:
    """Run every kind of loop once; one that does not carry the arm is left out."""
    turn: Turn = {}
    for kind in KINDS:
        try:
            turn[kind] = run_loop(kind, rate, file, seconds)
        except RuntimeError as error:
            progress(f"  {kind}: {error}")
    return turn


def rows_of(name: str, rate: int, turns: Sequence[Turn], kind: str) -> Iterator[Row]:
    """Yield the table's rows of the loop `name` at `rate` (Hz): runs of `kind` next to those of its peers."""
    allowed = 1.0 if rate == 1000 else 0.1  # % of the cycles
    ran = [turn for turn in turns if kind in turn]
    if not ran:
        yield Row(f"{name}, missed (it did not run): limit", 100.0, allowed, "%")
        return

    def limited(what: str, figure: Figure, limit: float, unit: str) -> Row:
        return Row.of_values(f"{name}, {what}", [figure(turn[kind]) for turn in ran], [limit] * len(ran), unit)

    def compared(what: str, figure: Figure, unit: str, of: str, theirs: Figure | None = None) -> Iterator[Row]:
        both = [turn for turn in ran if of in turn]
        if both:
            peer = [(theirs or figure)(turn[of]) for turn in both]
            yield Row.of_values(f"{name}, {what}", [figure(turn[kind]) for turn in both], peer, unit)

    peers = PEERS | ({"nodes": "two processes"} if kind == "one process" else {})
    for share in (50, 99, 99.9):
        for of, peer in peers.items():
            yield from compared(f"p{share:g}: {peer}", latency(share), "ms", of)
    yield limited("p99: one period", latency(99), 1e3 / rate, "ms")
    for share in (99, 99.9):
        yield limited(f"spacing p{share:g}: one period", spacing(share), 1e3 / rate, "ms")
    for what in ("missed", "late", "incomplete", "lost"):
        yield limited(f"{what}: limit", percent(what), allowed, "%")
        for of, peer in peers.items():
            yield from compared(f"{what}: {peer}", percent(what), "%", of)
    bridge = ("bridge", "compensator") if kind == "one process" else ("bridge",)
    counterparts = {"can_bridge": bridge, "compensator": ("compensator",)}
    for node in sorted({full_name.rpartition("/")[2] for full_name in ran[0][kind].cpu}):
        if node in counterparts:
            theirs = cpu(*counterparts[node])
            yield from compared(f"CPU of {node}: bare rclpy", cpu(node), "%", "rclpy", theirs)
        else:
            yield limited(f"CPU of {node}: a core", cpu(node), 100.0, "%")


def latency(share: float) -> Figure:
    """Return the figure: the percentile in ms over all arms."""
    return lambda run: percentile(np.concatenate([arm.latency for arm in run.arms]), share) * 1e3


def spacing(share: float) -> Figure:
    """Return the figure: the percentile in ms over all arms."""
    return lambda run: percentile(np.concatenate([arm.spacing for arm in run.arms]), share) * 1e3


def percent(what: str) -> Figure:
    """Return the figure: the share of the cycles in percent that were `what`: missed, late, incomplete or lost."""
    return lambda run: float(np.mean([100.0 * getattr(arm, what) / arm.cycles for arm in run.arms]))


def cpu(*parts: str) -> Figure:
    """Return the figure: percent of a core of the processes with these names, of one arm or two."""
    return lambda run: 100.0 * sum(share for name, share in run.cpu.items() if name.rpartition("/")[2] in parts)
