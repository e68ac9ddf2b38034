# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.long_recording [--minutes 60]: time and memory of reading a long recording of two arms at 500 Hz.

Prints a table in Markdown: all samples, one of 10, and the whole report. Exit code 1 if any takes more than 1.5 GB.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from exo_gravity.lab.bag.content import JOINT_STATE
from exo_gravity.lab.bag.layout import TYPES, layout_of

RATE = 500  # Hz
BEGIN = 1_700_000_000  # s since 1970
LIMIT = 1500.0  # MB
NAMES = ("joint_1", "joint_2", "joint_3", "joint_4")
MEASURE = """
import resource, sys, time
begin = time.perf_counter()
{work}
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(time.perf_counter() - begin, memory)
"""
READ = "from exo_gravity.lab.bag.reader import read_bag; read_bag({bag!r}, {every})"
REPORT = (
    "import contextlib, io\nfrom exo_gravity.tools.report import main\n"
    "with contextlib.redirect_stdout(io.StringIO()): main([{bag!r}, '--output', {output!r}])"
)


def write(path: Path, minutes: float) -> None:
    """Write the recording: both arms move slowly to and fro, and rest."""
    made = TYPES.types
    header = made["std_msgs/msg/Header"](made["builtin_interfaces/msg/Time"](0, 0), "")
    none, numbers = np.empty(0), np.arange(float(len(NAMES)))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds = []
        for side in ("right", "left"):
            names = [f"{side}_{name}" for name in NAMES]
            for topic, arrays in (("joint_states", (numbers,) * 3), ("effort_commands", (none, none, numbers))):
                message = bytearray(TYPES.serialize_cdr(made[JOINT_STATE](header, names, *arrays), JOINT_STATE))
                layout = layout_of(bytes(message), JOINT_STATE)
                connection = writer.add_connection(f"/{side}/{topic}", JOINT_STATE, typestore=TYPES)
                kinds.append((connection, np.frombuffer(message, layout.numbers), message))
        for index in range(round(60.0 * minutes * RATE)):
            at = BEGIN * 10**9 + index * 10**9 // RATE
            angle = 0.3 * np.sin(min(index / RATE % 15.0, 3.0))
            for connection, values, message in kinds:
                values["header.stamp.sec"], values["header.stamp.nanosec"] = divmod(at, 10**9)
                for field in {"position", "effort"} & {*(values.dtype.names or ())}:
                    values[field] = angle
                writer.write(connection, at, bytes(message))


def measured(work: str) -> tuple[float, float]:
    """Run a program; return its time in s and its memory in MB."""
    program = MEASURE.format(work=work)
    done = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=True)
    seconds, memory = map(float, done.stdout.split())
    return seconds, memory


def main() -> int:
    """Write, read, report, and print the table."""
    parser = argparse.ArgumentParser(prog="bench.long_recording", description="Read a long recording.")
    parser.add_argument("--minutes", type=float, default=60.0, help="of the recording (default: %(default)g)")
    minutes = parser.parse_args().minutes
    with tempfile.TemporaryDirectory() as folder:
        bag, output = f"{folder}/bag", f"{folder}/report"
        write(Path(bag), minutes)
        size = sum(file.stat().st_size for file in Path(bag).iterdir()) / 1e6
        works = {
            "read": READ.format(bag=bag, every=1),
            "read, one sample of 10": READ.format(bag=bag, every=10),
            "report": REPORT.format(bag=bag, output=output),
        }
        print(f"| two arms, {RATE} Hz, {minutes:g} minutes, {size:.0f} MB | time (s) | memory (MB) |\n|---|---|---|")
        largest = 0.0
        for name, work in works.items():
            seconds, memory = measured(work)
            largest = max(largest, memory)
            print(f"| {name} | {seconds:.0f} | {memory:.0f} |", flush=True)
    return int(largest > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
