# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`make study NAME=faults`: play the rows of the fault matrix that need processes; print a table and write JSON.

    python -m test.faults.run [--only TEXT ...] [--output build/faults.json]

The JSON file is written after every row. The exit code is 1 if a row was unsafe or could not be played. One that is
unsafe while the machine itself stands still is played again; if it still does, the row is not judged. Interrupted, it
prints its table too, and the exit code is 130.
"""

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..support.ports import own_domain

os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))  # before rclpy is imported

from rich.console import Console
from rich.table import Table

from exo_gravity.sim.judge import Response

from ..support.stalls import Machine, stood_still
from .fault_case import Arm, FaultCase, Played, play
from .processes import CASES, ProcessRig

STALL = 0.03  # s for which the machine stood still, so that an unsafe result shows nothing about the nodes
ATTEMPTS = 3
INTERRUPTED = 130  # the shell's exit code after Ctrl-C
NOT_RUN = "not run"
LOG_LINES = 20


class Pool:
    """Keeps the `rig` of the last row for the next row of its arm; `log` is that of the last row that was unsafe."""

    def __init__(self, folder: Path, kind: type[ProcessRig] = ProcessRig) -> None:
        self.rig: ProcessRig | None = None
        self.log: list[str] = []
        self.folders: list[Path] = []  # of each rig so far
        self._folder, self._kind = folder, kind
        self._machine = Machine()

    def rig_of(self, arm: Arm) -> ProcessRig:
        """Return running nodes that have this arm."""
        if self.rig is not None and (self.rig.arm is not arm or self.rig.have_ended):
            self.end()
        if self.rig is None:
            self.folders.append(self._folder / str(len(self.folders)))
            self.folders[-1].mkdir()
            self.rig = self._kind(arm, self.folders[-1])
            self.rig.start()
        return self.rig

    def play(self, case: FaultCase) -> Played:
        """Play a row, again if it was unsafe while the machine stood still; in the end it is then not judged."""
        for _ in range(ATTEMPTS):
            self._machine.longest_gap()
            played = self._play(case)
            gap = self._machine.longest_gap()
            if not played.unsafe or gap < STALL:
                return played
        return played._replace(outcome=f"not judged, {stood_still(gap)}: {played.unsafe}", unsafe="")

    def _play(self, case: FaultCase) -> Played:
        try:
            rig = self.rig_of(case.arm)
            rig.bring_to(case.stage)
            played = play(case, rig)
        except (AssertionError, OSError, LookupError) as error:  # a process that is late, or gone
            reason = (str(error) or type(error).__name__).splitlines()[0]
            played = Played(NOT_RUN, Response(), f"{NOT_RUN}: {reason}")
        if case.ends_rig or played.unsafe:
            self.log = self.rig.nodes.log[-LOG_LINES:] if self.rig else []
            self.end()
        return played

    def end(self) -> None:
        """End the nodes."""
        rig, self.rig = self.rig, None
        if rig is not None:
            rig.close()

    def close(self) -> None:
        """End the nodes and what watches the machine."""
        self.end()
        self._machine.close()


@contextlib.contextmanager
def pool_of(kind: type[ProcessRig] = ProcessRig) -> Iterator[Pool]:
    """Yield a pool with a temporary folder. Signals that end this process let the nodes end first."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the nodes inherit it: nohup must not hide a row's SIGHUP
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Pool(Path(folder), kind)) as pool:
        yield pool


def main() -> int:
    """Play the rows; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m test.faults.run", description="Play the fault matrix.")
    parser.add_argument("--only", default=[""], nargs="+", metavar="TEXT", help="only rows whose name contains TEXT")
    parser.add_argument("--output", default=Path("build/faults.json"), type=Path, metavar="FILE", help="(%(default)s)")
    arguments = parser.parse_args()
    cases = [case for case in CASES if any(text in case.name for text in arguments.only)]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    console, results = Console(width=max(120, Console().width)), list[dict[str, Any]]()
    columns = ("reaction", "top_speed", "largest_step", "energy", "power", "damping", "off")
    grid = Table("fault", "result", "after s", "top rad/s", "step Nm", "J", "W", "damping", "off s", "verdict")
    try:
        with pool_of() as pool:
            for number, case in enumerate(cases, 1):
                played = pool.play(case)
                figures = {name: value and round(value, 3) for name, value in asdict(played.response).items()}
                results.append({"fault": case.name, "result": played.outcome, **figures, "unsafe": played.unsafe})
                arguments.output.write_text(json.dumps(results, indent=1) + "\n")
                verdict = played.unsafe or "safe"
                grid.add_row(case.name, played.outcome, *(str(figures[name]) for name in columns), verdict)
                said = f"[{number}/{len(cases)}] {case.name}: {played.outcome}, {verdict}"
                console.print("\n    ".join([said, *(pool.log if played.unsafe else ())]), markup=False)
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        console.print(grid)
    return int(any(result["unsafe"] for result in results))


if __name__ == "__main__":
    sys.exit(main())
