# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The log of all nodes as it grows, for a program that waits for one of its lines."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable


class NodeLog:
    """Called by the launcher with each line."""

    def __init__(self) -> None:
        self._lines: list[tuple[float, str]] = []
        self._changed = threading.Condition()

    def __call__(self, node: str, line: str) -> None:
        """Take one line of the log of `node`."""
        with self._changed:
            self._lines.append((time.monotonic(), f"{node}: {line}"))
            self._changed.notify()

    def time_of_first(self, state: str) -> float:
        """Return the time (monotonic s) of the first line in which a node says its `state`, infinity without one."""
        said = re.compile(rf": (INFO|WARN) {state}\b")
        return next((time for time, line in self._lines if said.search(line)), float("inf"))

    def find(self, text: str) -> str:
        """Return the first line that contains `text`, or ''."""
        return next((line for _, line in self._lines if text in line), "")

    def last(self, count: int, of: str = "") -> list[str]:
        """Return the last lines that contain `of`."""
        return [line for _, line in self._lines if of in line][-count:]

    def wait_for(self, text: str, count: int, timeout: float, has_died: Callable[[], object]) -> None:
        """Wait until `count` lines contain `text`. Raises RuntimeError after `timeout` s or once `has_died()`."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while sum(text in line for _, line in self._lines) < count:
                self._changed.wait(0.5)
                if has_died() or time.monotonic() > deadline:
                    raise RuntimeError(f"the arm was not carried: {self.last(10)}")
