"""The load that a control rate puts on the CAN bus, and the highest rate that fits.

In each cycle every motor gets a command of 8 bytes. V1 and V2 boards reply with 8 bytes, or 6 on older firmware; V3
boards send status frames of 8 bytes on their own timer, and have 29-bit IDs. A classic CAN frame with an 11-bit ID and
n bytes of data has (ISO 11898-1; Bosch, CAN Specification 2.0)

    1 start + 11 ID + 1 RTR + 1 IDE + 1 r0 + 4 length + 8 n data + 15 CRC     = 34 + 8 n bits, subject to stuffing
    1 CRC delimiter + 2 acknowledge + 7 end of frame + 3 interframe space     = 13 bits, never stuffed

A 29-bit ID adds 18 ID + 1 SRR + 1 r1 bits.
After 5 equal bits the sender inserts a stuff bit of the opposite value, which is part of the next run. A frame has at
most (34 + 8 n - 1) // 4 stuff bits (Davis et al. 2007, "Controller Area Network schedulability analysis", eq. 1). The
actual number depends on the bytes (test/core/test_bus_load.py).
"""

from __future__ import annotations

from dataclasses import dataclass

from exo_gravity.core.errors import ParameterError

BITRATE = 1_000_000  # bit/s, of AK motors as delivered
# Bits of a frame of 8 bytes: the mean over the poses, speeds and torques of an arm that is being carried, and the most.
COMMAND, REPLY, V3_COMMAND, STATUS = (124, 135), (118, 135), (146, 160), (141, 160)
# Status frames a second that are to be set on V3 boards: the most they can send, because each cycle waits for one; on a
# slow bus fewer, or four boards would fill it.
MAX_STATUS_RATE, SLOW_STATUS_RATE = 500.0, 200.0
SLOW_BITRATE = 500_000  # bit/s, below which a bus is slow
REPLY_SHARE = 0.8  # of a cycle in which replies are awaited


@dataclass(frozen=True)
class Traffic:
    """The motors on one bus, and its bit rate. Raises ParameterError."""

    replying: int  #: motors of V1 and V2 boards
    reporting: int = 0  #: motors of V3 boards
    bitrate: int = BITRATE  #: bit/s

    def __post_init__(self) -> None:
        if not isinstance(self.bitrate, int) or not 10_000 <= self.bitrate <= 1_000_000:
            raise ParameterError("can.options.bitrate", self.bitrate, "a whole number from 10000 to 1000000 bit/s")

    @property
    def status_rate(self) -> float:
        """Status frames a second of each V3 board on this bus."""
        return MAX_STATUS_RATE if self.bitrate >= SLOW_BITRATE else SLOW_STATUS_RATE

    def load(self, rate: float, worst: bool = False) -> float:
        """Return the share of the bus that `rate` cycles a second take, for typical or for `worst` stuffing."""
        command, reply, v3_command, status = (bits[worst] for bits in (COMMAND, REPLY, V3_COMMAND, STATUS))
        cycle = self.replying * (command + reply) + self.reporting * v3_command
        return (rate * cycle + self.reporting * self.status_rate * status) / self.bitrate

    @property
    def largest_rate(self) -> float:
        """Cycles/s that fill the bus, for typical stuffing."""
        unasked = self.load(0.0)
        return max(0.0, 1.0 - unasked) / (self.load(1.0) - unasked)

    def is_crowded(self, rate: float) -> bool:
        """Return whether replies may be late at `rate` although they fit on the bus."""
        return self.load(rate) > REPLY_SHARE or self.load(rate, worst=True) > 1.0

    def check(self, rate: float) -> None:
        """Raise ParameterError if the typical load of `rate` exceeds the capacity of the bus."""
        if (share := self.load(rate)) > 1.0:
            motors, capacity = self.replying + self.reporting, self.bitrate / 1000.0
            fits = f"at most {int(self.largest_rate)} Hz, the capacity of the CAN bus"
            raise ParameterError(
                "rate", rate, f"{fits}: {motors} motors need {share * capacity:.0f} kbit/s of its {capacity:g}"
            )
