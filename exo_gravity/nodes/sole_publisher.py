"""Detects a second publisher on a topic from the messages themselves.

Each publisher numbers its messages from 1, so from a single publisher the numbers rise. A second one shows at once,
without discovery, which still lists a killed publisher for 20 s. Not every middleware numbers messages: then a second
publisher goes undetected.
"""

from __future__ import annotations

from typing import Any


class SolePublisher:
    """Checks the `info` of each message of one topic, which rclpy passes to callbacks of two arguments."""

    def __init__(self) -> None:
        self._number = 0

    def is_another(self, info: dict[str, Any]) -> bool:
        """Return whether this message comes from a different publisher than the previous one."""
        number = info["publication_sequence_number"]
        previous, self._number = self._number, number or 0
        return number is not None and number <= previous
