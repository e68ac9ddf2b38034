# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`make study NAME=mutations`: does the fault matrix see a defect? Each of these defects must turn a row unsafe.

    python -m test.faults.mutations [--only TEXT ...] [--busy]

The rows that are meant to see a defect are played with it (injected/defects.py): those in virtual time here, the others
with nodes that have it. The exit code is 1 if a defect is not seen.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress

from rich.console import Console

from .cases import CASES
from .injected import injected
from .injected.defects import DEFECTS, Defect
from .run import run_all
from .virtual import play
from .virtual_cases import ROWS


def unsafe_in_virtual_time(defect: Defect) -> dict[str, str]:
    """Play the rows of `defect` in virtual time; return what was unsafe by row, the first one that was."""
    with defect.here():
        for case in ROWS:
            with suppress(RuntimeError):  # the arm is not carried: that shows nothing
                if case.name in defect.rows and (unsafe := play(case, is_fresh=True).unsafe):
                    return {case.name: unsafe}
    return {}


def unsafe_rows(defect: Defect, console: Console, shipped_timeouts: bool) -> dict[str, str]:
    """Play the rows of `defect`; return what was unsafe by row. A row that could not run shows nothing."""
    rows = [case for case in CASES if case.name in defect.rows]
    if not rows:
        return unsafe_in_virtual_time(defect)
    with injected(EXO_TEST_DEFECT=defect.name):
        results = list(run_all(rows, console, shipped_timeouts))
    return {row["fault"]: row["unsafe"] for row in results if row["unsafe"] and row["result"] != "not run"}


def main() -> int:
    """Try each defect; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m test.faults.mutations", description="Try deliberate defects.")
    parser.add_argument("--only", default=[""], nargs="+", metavar="TEXT", help="only defects whose name contains TEXT")
    parser.add_argument("--busy", action="store_true", help="for a busy machine: long time-outs, reactions not judged")
    arguments = parser.parse_args()
    console = Console(width=max(120, Console().width))
    unseen = 0
    for defect in DEFECTS:
        if any(text in defect.name for text in arguments.only):
            rows = unsafe_rows(defect, console, not arguments.busy)
            seen = "; ".join(f"{row}: {failure}" for row, failure in rows.items())
            unseen += not seen
            missed = f"NOT SEEN by {', '.join(defect.rows)}"
            console.print(f"{defect.name}: {seen or missed}", markup=False, soft_wrap=True)
    console.print(f"{unseen} defects not seen" if unseen else "every defect was seen")
    return int(bool(unseen))


if __name__ == "__main__":
    sys.exit(main())
