# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m test.lab.bag.fuzz --minutes 60: damaged recordings of every storage, each read and reported.

Bytes are cut off, flipped, zeroed, moved or repeated. The report may refuse a recording in one sentence (DataError) and
may do nothing else: another exception is printed with its seed, and the peak of memory is printed at the end.
"""

from __future__ import annotations

import argparse
import itertools
import random
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path

from rosbags.rosbag2 import CompressionMode, StoragePlugin

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.report.trial_report import analyse

from ...support import synthetic_bags as made

FORMS = [
    *itertools.product(StoragePlugin, (None, CompressionMode.FILE, CompressionMode.MESSAGE)),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
]
SETTINGS = "/right/compensator:\n  ros__parameters: {side: right, mode: one_g, use_imu: false}\n"


def content() -> list[made.Entry]:
    """Return the messages of a short trial with every topic that the reader decodes."""
    recording = made.trial(made.POSES, hold=2.5, rate=40.0)
    states = [made.status(0.5 * n, "active", state="active") for n in range(18)]
    tilts = [made.tilt(0.1 * n, 0.1) for n in range(90)]
    texts = [
        made.text_entry("/recorder/parameters", 0.0, SETTINGS),
        made.text_entry("/recorder/session", 0.0, '{"subject": "P01"}'),
        made.text_entry("/event_marker", 3.0, "cramp"),
    ]
    return [*made.messages(recording), *states, *tilts, *texts]


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return a file with one to three kinds of damage."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        size = max(len(changed), 1)
        at, count = rng.randrange(size), min(rng.choice((1, 8, 100, 5000)), size)
        kind = rng.randrange(5)
        if kind == 0:
            del changed[at:]
        elif kind == 1:
            for _ in range(rng.choice((1, 3, 30))):
                if changed:
                    changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        elif kind == 2:
            changed[at : at + count] = bytes(len(changed[at : at + count]))
        elif kind == 3:
            piece = changed[at : at + count]
            del changed[at : at + count]
            to = rng.randrange(max(len(changed), 1))
            changed[to:to] = piece
        else:
            changed[at:at] = changed[at : at + count]
    return bytes(changed)


def tried(bag: Path, seed: int) -> str:
    """Damage a copy of a bag by `seed`, report it; return '' or the exception that is no DataError."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        for file in sorted(bag.iterdir()):  # the same damage by the same seed
            data = file.read_bytes()
            is_hit = file.suffix != ".yaml" or rng.random() < 0.1
            if file.suffix != ".yaml" or rng.random() < 0.8:
                Path(folder, file.name).write_bytes(damaged(data, rng) if is_hit else data)
        try:
            report = analyse(read_bag(folder))
            _ = report.verdict, report.failures
        except DataError as error:
            return f"more than one line: {error}" if "\n" in str(error) else ""
        except Exception:
            return traceback.format_exc()
    return ""


def bags(folder: Path) -> list[Path]:
    """Write the recording in each storage; return the folders."""
    entries = content()
    return [
        made.write_bag(folder / f"bag_{n}", entries, plugin, compression)
        for n, (plugin, compression) in enumerate(FORMS)
    ]


def main() -> int:
    """Fuzz until the time is over; return 1 if anything went wrong."""
    parser = argparse.ArgumentParser(prog="test.lab.bag.fuzz", description="Damaged recordings, read and reported.")
    parser.add_argument("--minutes", type=float, default=60.0, help="for how long (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the first case (%(default)s)")
    options = parser.parse_args()
    end, found, seed = time.monotonic() + 60.0 * options.minutes, 0, options.seed
    with tempfile.TemporaryDirectory() as folder:
        made_bags = bags(Path(folder))
        while time.monotonic() < end:
            bag = made_bags[seed % len(made_bags)]
            if text := tried(bag, seed):
                found += 1
                print(f"seed {seed}, {FORMS[seed % len(FORMS)]}:\n{text}", flush=True)
            seed += 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{seed - options.seed} recordings, {found} tracebacks, peak {peak:.0f} MB of memory")
    return int(bool(found) or peak > 500.0)


if __name__ == "__main__":
    sys.exit(main())
