# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Processes that load the CAN bus or the processors.

python -m test.faults.load frames JSON    send random frames; the JSON has bus, count, rate (1/s), ids and seed
python -m test.faults.load spin SECONDS   keep one processor busy
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from typing import Any

import can

from ..support import ROOT


def start_frames(
    bus: Mapping[str, Any], count: int, rate: float, ids: Iterable[int], seed: int = 1
) -> subprocess.Popen[bytes]:
    """Start to send `count` frames of random length and content, `rate` a second, under random `ids`."""
    settings = {"bus": bus, "count": count, "rate": rate, "ids": list(ids), "seed": seed}
    return _start("frames", json.dumps(settings))


def start_spin(seconds: float) -> subprocess.Popen[bytes]:
    """Start to keep one processor busy for `seconds` s."""
    return _start("spin", str(seconds))


def _start(*arguments: str) -> subprocess.Popen[bytes]:
    # In a new session, and so in a new autogroup, the load does not run at the nodes' priority.
    return subprocess.Popen([sys.executable, "-m", __name__, *arguments], cwd=ROOT, start_new_session=True)


def send_frames(bus: Mapping[str, Any], count: int, rate: float, ids: list[int], seed: int) -> None:
    rng = random.Random(seed)
    with can.Bus(**bus) as wire:
        start = time.monotonic()
        for number in range(count):
            data = rng.randbytes(rng.randrange(9))
            wire.send(can.Message(arbitration_id=rng.choice(ids), data=data, is_extended_id=rng.random() < 0.2))
            time.sleep(max(0.0, start + number / rate - time.monotonic()))


def spin(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


if __name__ == "__main__":
    if sys.argv[1] == "frames":
        send_frames(**json.loads(sys.argv[2]))
    else:
        spin(float(sys.argv[2]))
