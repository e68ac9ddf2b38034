"""Whether all messages of a topic come from one publisher.

Each publisher counts its own messages, from 1: of one alone the numbers rise. They tell two publishers apart at once,
and need no discovery, which still knows a killed publisher for 20 s. Not every middleware counts: then this sees
nothing.
"""

from __future__ import annotations


class SolePublisher:
    """Looks at the `info` of each message of one topic, as rclpy hands it to callbacks of two arguments."""

    def __init__(self):
        self._number = 0

    def another(self, info: dict) -> bool:
        """Return whether this message comes from another publisher than the one before it."""
        number = info["publication_sequence_number"]
        before, self._number = self._number, number or 0
        return number is not None and number <= before
