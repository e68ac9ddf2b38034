"""How regularly the simulated device runs in real time: evidence that a fault was caused by a busy computer."""

from __future__ import annotations


class GapMeter:
    """Measures gaps in s while the motors are on; both start again when the motors are switched on.

    longest_stall: between two passes of the device's loop. longest_silence: in which no command arrived.
    """

    def __init__(self) -> None:
        self.longest_stall = 0.0
        self.longest_silence = 0.0
        self._powered = False
        self._last_pass = 0.0
        self._last_command = 0.0

    def note(self, now: float, powered: bool, commanded: bool) -> None:
        """Note one pass at `now` s: whether a motor was on before it, and whether a command arrived in it."""
        if powered and not self._powered:
            self.longest_stall = self.longest_silence = 0.0
            self._last_pass = self._last_command = now
        if powered:
            self.longest_stall = max(self.longest_stall, now - self._last_pass)
            self.longest_silence = max(self.longest_silence, now - self._last_command)
        if commanded:
            self._last_command = now
        self._powered = powered
        self._last_pass = now
