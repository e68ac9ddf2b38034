"""`make faults`: every row of the fault matrix on the simulated device, with real processes; a table and JSON.

    run.py [--only TEXT] [--start N] [--output build/faults.json]

Exits with 1 if a row is unsafe: too late, a joint above 1 rad/s, a torque step above 50 Nm/s times the period, a motor
switched on again, or an exception printed.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))

from rich.console import Console
from rich.table import Table

from ..faults.judge import SPEED, seen
from ..faults.rows import ROWS

WATCHED = 3.0  # s for which an arm that may stay carried is watched
CALM = 1.0  # s for which one that was let down must stay down, its inputs being well again
DOWN = 40.0  # s until it must be down


def play(row, stage):
    """Do `row` to the carried arm on `stage`; return its line of the table. On a punctual stage it may be too late."""
    stage.carry()
    said, told = stage.watcher.said, len(stage.log)
    since = time.time()
    row.do(stage)
    if row.within is None:
        end = time.monotonic() + WATCHED
        stage.watcher.until(lambda: time.monotonic() > end or said("can_bridge", "fault"))
    if row.within is not None or said("can_bridge", "letting down") or said("can_bridge", "fault"):
        down = stage.listener.switched_off
        stage.watcher.until(lambda: (stage.over and down()) or said("can_bridge", "fault"), DOWN)
    result = _result(row, stage)
    row.undo(stage)
    if not result.startswith("active"):  # a motor that could not be reached is switched off once it can
        stage.watcher.until(stage.listener.switched_off, DOWN)
    end = time.monotonic() + CALM
    stage.watcher.until(lambda: time.monotonic() > end)
    return _line(row, stage, since, result, stage.log[told:])


def _result(row, stage):
    if stage.over:
        return "stopped"
    status = stage.watcher.diagnostics["/right/can_bridge"].message
    return status.split(": ")[1] if status.startswith("fault") else status


def _line(row, stage, since, result, log):
    frames = list(stage.listener.frames)
    whole = seen(frames, since, 1.0 / stage.rate)
    carried = result.startswith("active")
    wrong = [
        text
        for bad, text in (
            (not carried and whole.reaction is None, "not let down"),
            (carried and row.within is not None, "stayed carried"),
            (stage.punctual and row.within is not None and (whole.reaction or 0.0) > row.within, "too late"),
            (whole.speed > SPEED, "too fast"),
            (whole.excess > 0.0, "torque step"),
            (whole.armed, "armed again"),
            (any("Traceback" in line for line in log), "exception"),
        )
        if bad
    ]
    return {
        "fault": row.name,
        "result": result,
        "reaction_ms": None if carried else round((whole.reaction or 0.0) * 1000),
        "limit_ms": row.within and round(row.within * 1000),
        "top_speed_rad_s": round(whole.speed, 2),
        "torque_step_nm": round(whole.step, 3),
        "latched": "held" if carried else "yes" if not whole.armed else "NO",
        "unsafe": ", ".join(wrong),
    }


class Theatre:
    """Keeps a stage as long as it can be used again."""

    def __init__(self, folder, punctual=True):
        self._folder, self._punctual = Path(folder), punctual
        self._stage, self._count = None, 0

    def play(self, row):
        if self._stage is not None and (type(self._stage) is not row.on or self._stage.over):
            self.close()
        if self._stage is None:
            self._count += 1
            folder = self._folder / str(self._count)
            folder.mkdir()
            self._stage = row.on(folder, self._punctual)
        try:
            line = play(row, self._stage)
        except BaseException:
            self.close()  # wherever it stands
            raise
        if row.spent or line["unsafe"]:  # a dead compensator, or who knows what
            stage = self._stage
            self.close()
            line["log"] = stage.log[-20:] if line["unsafe"] else []
        return line

    def close(self):
        if self._stage is not None:
            self._stage.close()
            self._stage = None


def main():
    """Play all rows; exit with 1 if one is unsafe."""
    parser = argparse.ArgumentParser(prog="make faults", description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", metavar="TEXT", help="only rows whose name contains TEXT")
    parser.add_argument("--start", default=1, type=int, metavar="N", help="begin with the Nth of them")
    parser.add_argument("--output", default="build/faults.json", type=Path)
    arguments = parser.parse_args()
    rows = [row for row in ROWS if arguments.only in row.name][arguments.start - 1 :]
    console = Console(width=max(120, Console().width))
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        theatre = Theatre(folder)
        try:
            for number, row in enumerate(rows, 1):
                console.print(f"[{number}/{len(rows)}] {row.name} ...", end=" ", markup=False)
                lines.append(theatre.play(row))
                console.print(lines[-1]["result"], lines[-1]["unsafe"] or "safe", markup=False)
                for entry in lines[-1].pop("log", ()):
                    console.print("    ", entry, markup=False)
        finally:
            theatre.close()
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(lines, indent=1) + "\n")
    console.print(table(lines))
    sys.exit(1 if any(line["unsafe"] for line in lines) else 0)


def table(lines):
    """Return the lines as a table."""
    grid = Table("fault", "what came of it", "after ms", "top rad/s", "step Nm", "latched", "verdict")
    for line in lines:
        cells = (line["reaction_ms"], line["top_speed_rad_s"], line["torque_step_nm"], line["latched"])
        shown = ["-" if cell is None else str(cell) for cell in cells]
        grid.add_row(line["fault"], line["result"], *shown, line["unsafe"] or "safe")
    return grid


if __name__ == "__main__":
    main()
