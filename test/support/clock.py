"""A clock that notices when the machine stands still."""

import time

BEAT = 0.005  # s


def beat(longest):
    """Beat for ever; keep in the shared number `longest` the longest time in s between two beats."""
    before = time.monotonic()
    while True:
        time.sleep(BEAT)
        now = time.monotonic()
        longest.value = max(longest.value, now - before)
        before = now
