# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m test.faults.soak [--minutes 60] [--seed 1]: both arms, live changes, an active wearer, harmless faults.

Each minute the operator changes the right arm's load at random, while it is free and while its wearer reaches, shakes,
throws, pushes or holds it; in every second minute, by chance, a fault strikes it, judged as in the fault matrix. The
arm must be carried again each time. The left arm is also carried, and a recorder runs throughout.

The exit code is 1 if a fault was unsafe, a live change let the motors move an arm faster than MOVED, an arm was let
down without a cause or not carried again, a change was refused, the recording has losses or ends early, or a node's
memory grew by more than MAX_GROWTH. It is a cause that the computer stood still for STALL, or that for less than IDLE
of the time its processors were idle or busy with what has a lower priority. Nodes that ended then are started again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..support.ports import own_domain

os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))  # before rclpy is imported

import numpy as np
from rich.console import Console

from exo_gravity.core.motors.frames import EXIT
from exo_gravity.lab.bag.reader import read_bag

from .actions import END_SILENCE, SILENCE, foreign_frames, pause, send_signal, simulator
from .cases import CASES
from .fault_case import ALL_JOINTS, PROCESS_REACTION, FaultCase, in_turn
from .live_arm import MINUTE, NODES, STALL, LiveArm, SoakRig
from .runner import Result, RigPool
from .stall_clock import StallClock
from .virtual import AK_ERROR

WARM_UP = 5  # min until memory counts: caches and buffers fill
MAX_GROWTH = 5.0  # MB, from then until the end
LINES = 40  # of the nodes' logs, shown where the soak breaks off
MAX_GAP = 1.0  # s between two recorded joint states of an arm
LIVE, LIVE_BEFORE_FAULT = 45.0, 15.0  # s of a minute after which no further change and act begin


HARMLESS = [f"second publisher of {what}" for what in ("joint states", "the tilt", "efforts")]  # rows of the matrix
FAULTS = (  # after which the same nodes run on
    *(replace(case, rig=SoakRig, outcomes=()) for case in CASES if case.name in HARMLESS),
    FaultCase("arm disabled", lambda rig: rig.probe.enable(False), SoakRig),
    FaultCase("foreign EXIT to motor 2, once", foreign_frames(EXIT), SoakRig, steps_from=0.05),
    FaultCase(
        "motor 2 reports an error",
        simulator(fault__error=[0, AK_ERROR, 0, 0]),
        SoakRig,
        clear=simulator(fault__error=[0] * 4),
    ),
    FaultCase("bus silent for 1 s", in_turn(SILENCE, pause(1.0), END_SILENCE), SoakRig, unreached=ALL_JOINTS),
    FaultCase(
        "compensator frozen",
        send_signal("compensator", signal.SIGSTOP),
        SoakRig,
        PROCESS_REACTION,
        clear=send_signal("compensator", signal.SIGCONT),
    ),
)


class Soak:
    """The soak.

    results: of the faults that were judged. memory: (minutes, nodes) MB for each start of the nodes. recordings: of
    each start.
    """

    def __init__(self, seed: int, console: Console) -> None:
        self._dice, self._console = random.Random(seed), console
        self.live = LiveArm(self._dice)
        self.results: list[Result] = []
        self.memory: list[list[list[float]]] = []
        self.recordings: list[Path] = []

    def run(self, minutes: float, folder: Path) -> None:
        """Run it, to the end or until something went wrong after which the nodes do not run.

        Nodes that ended while the computer stood still are started again.
        """
        with contextlib.closing(StallClock()) as clock, RigPool(folder, shipped_timeouts=False) as pool:
            start = time.monotonic()
            for minute in range(round(minutes)):
                rig = None
                try:
                    rig = self._carrying(pool)
                    self._run_minute(minute, start + minute * MINUTE, rig, pool, clock)
                except AssertionError as error:  # also a Timeout
                    stall = max(self.live.stall, clock.longest_gap())
                    if rig and rig.has_lost_a_node and stall > STALL:
                        self.live.stalls.append(f"the computer stood still for {stall:.3f} s, and a node ended")
                        self._print(f"      {self.live.stalls[-1]}")
                        continue
                    self.live.trouble.append(f"{self.live.last}: {describe(error)}")
                    log = pool.rig.nodes[0].log[-LINES:] if pool.rig else []
                    self._print("\n".join([self.live.trouble[-1], *log]))
                    break
                if pool.rig is rig and not rig.has_lost_a_node:
                    self.memory[-1].append(rig.memory())
                    rig.forget()
                    rig.wait(start + (minute + 1) * MINUTE - time.monotonic())
                    assert not rig.has_lost_a_node or clock.longest_gap() > STALL, "a node ended between two minutes"
                elif self.live.trouble or any(result["unsafe"] for result in self.results):
                    break

    def _carrying(self, pool: RigPool) -> SoakRig:
        """Return nodes that carry the arms: those that run, or new ones."""
        before, rig = pool.rig, pool.rig_for(SoakRig)
        assert isinstance(rig, SoakRig)
        if rig is not before:
            self.memory.append([])
            self.recordings.append(rig.folder / "bag")
        rig.bring_to("active")
        return rig

    def _run_minute(self, minute: int, start: float, rig: SoakRig, pool: RigPool, clock: StallClock) -> None:
        live, fault = self.live, self._dice.choice(FAULTS) if self._dice.random() < 0.5 else None
        seen, news = live.seen.copy(), (len(live.trouble), len(live.stalls))
        live.live(rig, start + (LIVE_BEFORE_FAULT if fault else LIVE), clock)
        parts = [f"{what} {count}" for what, count in (live.seen - seen).items()]
        lines: list[str] = []
        if fault and len(live.stalls) == news[1] and not rig.has_lost_a_node:  # else an arm may be on its way down
            clock.longest_gap()
            result = pool.run(fault)
            stall = clock.longest_gap()
            lines += result.pop("log", ())
            parts.append(f"{fault.name}: {result['result']}, {result['unsafe'] or 'safe'}")
            if result["unsafe"] and stall > STALL:
                live.stalls.append(f"the computer stood still for {stall:.3f} s: {parts[-1]}")
            else:
                self.results.append(result)
        lines = [*live.trouble[news[0] :], *live.stalls[news[1] :], *lines]
        self._print(f"{minute + 1:3d} {', '.join(parts)}; at most {live.fastest:.2f} rad/s")
        for line in lines:
            self._print(f"      {line}")

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, soft_wrap=True)


def describe(error: AssertionError) -> str:
    """Return the error and the lines of the tests that led to it."""
    calls = traceback.extract_tb(error.__traceback__)
    return f"{error}; in {', '.join(call.line or call.name for call in calls[1:])}"


def find_failures(soak: Soak) -> dict[str, Any]:
    """Return what failed, by subject."""
    failed: dict[str, Any] = {r["fault"]: r["unsafe"] for r in soak.results if r["unsafe"]}
    if soak.live.trouble:
        failed["without a cause"] = soak.live.trouble
    for sizes in soak.memory:
        if len(sizes) > WARM_UP:
            growth = np.subtract(sizes[-1], sizes[WARM_UP])
            failed |= {
                f"memory of {node}": f"+{mb:.1f} MB" for node, mb in zip(NODES, growth, strict=True) if mb > MAX_GROWTH
            }
    for number, recording in enumerate(soak.recordings, 1):
        bag = read_bag(recording)
        losses = [note for note in (*bag.notes, *bag.problems) if "lost" in note or "cut short" in note]
        is_last = number == len(soak.recordings)  # an earlier one ends where a node has ended
        if losses or (is_last and bag.is_partial):
            failed[f"recording {number}"] = [*bag.notes, *bag.problems]
        for arm in bag.recordings:
            if (gap := float(np.diff(arm.time).max())) > MAX_GAP:
                failed[f"recording {number} of {arm.name}"] = f"no joint states for {gap:.1f} s"
    return failed


def main() -> int:
    """Run the soak; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m test.faults.soak", description="Strike both arms for an hour.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("build/soak.json"), metavar="FILE", help="(%(default)s)")
    options = parser.parse_args()
    console = Console(width=150, highlight=False)
    soak = Soak(options.seed, console)
    with tempfile.TemporaryDirectory() as folder:
        soak.run(options.minutes, Path(folder))
        failed = find_failures(soak)
    for node, *sizes in zip(NODES, *max(soak.memory, key=len), strict=True) if any(soak.memory) else ():
        console.print(f"{node}: {min(sizes[WARM_UP:] or sizes):.1f} MB after the start, {sizes[-1]:.1f} MB at the end")
    seen = {**soak.live.seen, "faults": len(soak.results), "while the computer stood still": len(soak.live.stalls)}
    seen["starts of the nodes"] = len(soak.recordings)
    report = {"seen": seen, "fastest": soak.live.fastest, "results": soak.results, "memory": soak.memory}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps({**report, "failed": failed}, indent=1) + "\n")
    console.print("; ".join(f"{what}: {count}" for what, count in seen.items()), markup=False)
    fastest = f"{soak.live.fastest:.2f} rad/s by live changes"
    if soak.results:
        fastest += f", {max(result['driven_rad_s'] or 0.0 for result in soak.results):.2f} rad/s after faults"
    console.print(f"the motors caused at most {fastest}; failed: {failed or 'nothing'}", markup=False)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
