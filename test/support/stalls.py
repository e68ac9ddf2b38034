# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Judges what processes did, given what the machine did: nodes let the arm down when they get no processor."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from exo_gravity.core.safety.limits import READING

from ..faults.stall_clock import StallClock

STALL = READING.reply_timeout  # s without a processor, after which a motor counts as silent


class Machine:
    """The machine that runs the nodes, and the longest times in s for which it stood still."""

    def __init__(self) -> None:
        self._clock = StallClock()
        self._gaps: list[float] = []
        self.close = self._clock.close

    @contextmanager
    def keeps_up(self, excuses: Callable[[], object] = lambda: True) -> Iterator[None]:
        """Judge what the block asserts of the nodes, unless the machine meanwhile stood still: then say that instead.

        What follows the block must hold in either case. excuses: what must have come of a stall, so that it excuses.
        """
        self._gaps.append(self._clock.longest_gap())
        first = len(self._gaps)
        try:
            yield
        except AssertionError as error:
            self._gaps.append(self._clock.longest_gap())
            gap = max(self._gaps[first:])
            if gap < STALL or not excuses():
                raise
            warnings.warn(f"this machine stood still for {1000.0 * gap:.0f} ms: not judged: {error}", stacklevel=3)
