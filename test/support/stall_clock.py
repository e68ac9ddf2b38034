"""A process that measures how long the machine stands still, beside the tests that need it to keep up.

Run with `-m test.support.stall_clock`, it wakes every `TICK` s. For each line on its standard input it prints the
longest time in s between two wake-ups since the last such line. It ends when its standard input closes.
"""

from __future__ import annotations

import select
import subprocess
import sys
import time

from . import ROOT

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


def main() -> None:
    """Run the clock."""
    longest, before = 0.0, time.monotonic()
    while True:
        request, _, _ = select.select([sys.stdin], [], [], TICK)
        now = time.monotonic()
        longest, before = max(longest, now - before), now
        if request:
            if not sys.stdin.readline():
                return
            print(longest, flush=True)
            longest = 0.0


if __name__ == "__main__":
    main()
