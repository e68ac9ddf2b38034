# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.cohort [--recordings 200]: what `report` of a folder takes, and what becomes of bad recordings.

Generates trials of 20 subjects, a day each, of which one is no recording and one is cut short; reports them twice, and
prints a table in Markdown. Exit code 1 if a row is missing, or if the second run reads more than what failed.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from exo_gravity.lab.trial.session import Session

from .recordings import write_recording

SUBJECTS = 20
SECONDS, RATE = 60, 100  # of each recording, Hz
BEGIN, DAY = 1_700_000_000, 86_400  # s
CUT = 0.6  # of the file that is left
PROGRAM = "import sys; from exo_gravity.tools.report import main; sys.exit(main(sys.argv[1:]))"


def generate(folder: Path, count: int) -> None:
    """Write `count` recordings below `folder`; the first is damaged, the second is cut short."""
    for number in range(count):
        day, subject = divmod(number, SUBJECTS)
        session = json.dumps(asdict(Session(f"P{subject:02d}")))
        write_recording(folder / f"P{subject:02d}" / str(day) / "bag", SECONDS, RATE, BEGIN + day * DAY, session)
    damaged, cut = (folder / f"P{subject:02d}" / "0" / "bag" for subject in (0, 1))
    (damaged / "bag.mcap").write_text("no recording")
    data = (cut / "bag.mcap").read_bytes()
    (cut / "bag.mcap").write_bytes(data[: round(CUT * len(data))])
    (cut / "metadata.yaml").unlink()


def reported(folder: Path, output: Path) -> tuple[float, str]:
    """Report the folder; return the time in s and what was printed."""
    begin = time.perf_counter()
    command = [sys.executable, "-c", PROGRAM, str(folder), "--output", str(output)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return time.perf_counter() - begin, done.stdout


def main() -> int:
    """Generate, report twice, and print the table."""
    parser = argparse.ArgumentParser(prog="bench.cohort", description="Report many generated recordings.")
    parser.add_argument("--recordings", type=int, default=200, metavar="N", help="(default: %(default)s)")
    count = parser.parse_args().recordings
    with tempfile.TemporaryDirectory() as name:
        folder, output = Path(name, "trials"), Path(name, "out")
        generate(folder, count)
        size = sum(file.stat().st_size for file in folder.rglob("*.mcap")) / 1e6
        first, text = reported(folder, output)
        second, again = reported(folder, output)
        with (output / "cohort.csv").open(encoding="utf-8") as file:
            rows = [(row["recording"], row["joint"]) for row in csv.DictReader(file)]
    known = int(re.findall(r"(\d+) recordings had not changed", again)[0])
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"| {count} recordings of {SECONDS} s at {RATE} Hz, {size:.0f} MB | |\n|---|---|")
    print(f"| first run | {first:.1f} s |\n| second run, {known} not read again | {second:.1f} s |")
    print(f"| largest process | {memory:.0f} MB |\n| rows of cohort.csv | {len(rows)}, each once: {_once(rows)} |")
    print(f"| not reported | {text.count('Not reported:')} |")
    joints = len({joint for _, joint in rows if joint})
    expected = joints * (count - 1) + 1  # one row says why the damaged one has none
    is_whole = len({recording for recording, _ in rows}) == count and len(rows) == expected and _once(rows)
    return int(not (is_whole and known == count - 1))


def _once(rows: list[tuple[str, str]]) -> bool:
    return len(set(rows)) == len(rows)


if __name__ == "__main__":
    sys.exit(main())
