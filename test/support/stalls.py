# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Judges what processes did, given what the machine did: nodes let the arm down when they get no processor.

Run with `-m test.support.stalls`, it wakes every `TICK` s on each processor: a virtual machine may halt one of them
alone. For each line on its standard input it prints the longest time in s between two wake-ups since the last line.
"""

import os
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from exo_gravity.core.safety.limits import READING

from . import ROOT

TICK = 0.005  # s
STALL = READING.reply_timeout  # s without a processor, after which a motor counts as silent


class Machine:
    """The machine that runs the nodes, and the longest times in s for which it stood still."""

    def __init__(self) -> None:
        pipe, command = subprocess.PIPE, [sys.executable, "-m", __name__]
        self._clock = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True, bufsize=1)
        self._gaps: list[float] = []
        self.longest_gap()  # returns once the process runs

    def longest_gap(self) -> float:
        """Return the longest time in s for which a processor stood still since the last call."""
        assert self._clock.stdin and self._clock.stdout
        self._clock.stdin.write("\n")
        self._gaps.append(float(self._clock.stdout.readline()))
        return self._gaps[-1]

    @contextmanager
    def keeps_up(self) -> Iterator[None]:
        """Judge what the block asserts of the nodes, unless the machine stood still meanwhile: then say that."""
        self.longest_gap()
        first = len(self._gaps)
        try:
            yield
        except AssertionError as error:
            self.longest_gap()
            gap = max(self._gaps[first:])
            if gap < STALL:
                raise
            warnings.warn(f"{stood_still(gap)}: not judged: {error}", stacklevel=3)

    def close(self) -> None:
        self._clock.communicate()


def stood_still(gap: float) -> str:
    """Return the verdict on what shows nothing, because the machine stood still for `gap` s."""
    return f"this machine stood still for {1000.0 * gap:.0f} ms"


class Wakeups(threading.Thread):
    """Notes the longest time between two wake-ups on one processor."""

    def __init__(self, processor: int) -> None:
        super().__init__(daemon=True)
        self._processor = processor
        self._longest, self._last = 0.0, time.monotonic()

    def run(self) -> None:
        os.sched_setaffinity(0, {self._processor})  # of this thread
        while True:
            time.sleep(TICK)
            now = time.monotonic()
            self._longest, self._last = max(self._longest, now - self._last), now

    def take(self) -> float:
        """Return the longest time in s since the last call; a wake-up that is still awaited counts too."""
        longest, self._longest = max(self._longest, time.monotonic() - self._last), 0.0
        return longest


if __name__ == "__main__":
    clocks = [Wakeups(processor) for processor in os.sched_getaffinity(0)]
    for clock in clocks:
        clock.start()
    for _ in sys.stdin:
        print(max(clock.take() for clock in clocks), flush=True)
