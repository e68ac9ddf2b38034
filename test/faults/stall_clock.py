# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A process that measures how long the machine stands still, next to tests that need it to keep up.

Run with `-m test.faults.stall_clock`, it wakes every `TICK` s on each processor: a virtual machine may halt one of
them alone. For each line on its standard input it prints the longest time in s between two wake-ups since the last such
line. It ends when its standard input closes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

from ..support import ROOT

TICK = 0.005  # s


class StallClock:
    """The running process."""

    def __init__(self) -> None:
        pipe = subprocess.PIPE
        command = [sys.executable, "-m", __name__]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True, bufsize=1)
        self.longest_gap()  # returns once the process runs

    def longest_gap(self) -> float:
        """Return the longest time in s between two wake-ups since the last call."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write("\n")
        return float(self._process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


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


def main() -> None:
    """Run the clock."""
    clocks = [Wakeups(processor) for processor in os.sched_getaffinity(0)]
    for clock in clocks:
        clock.start()
    for _ in sys.stdin:
        print(max(clock.take() for clock in clocks), flush=True)


if __name__ == "__main__":
    main()
