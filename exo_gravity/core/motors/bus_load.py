"""The load that a control rate puts on the CAN bus, and the highest rate that fits.

In each cycle every motor gets a command of 8 bytes. V1 and V2 boards reply with 8 bytes, or 6 on older firmware; V3
boards send status frames of 8 bytes on their own timer, and have 29-bit IDs. A classic CAN frame with an 11-bit ID and
n bytes of data has (ISO 11898-1; Bosch, CAN Specification 2.0)

    1 start + 11 ID + 1 RTR + 1 IDE + 1 r0 + 4 length + 8 n data + 15 CRC     = 34 + 8 n bits, subject to stuffing
    1 CRC delimiter + 2 acknowledge + 7 end of frame + 3 interframe space     = 13 bits, never stuffed

A 29-bit ID adds 18 ID + 1 SRR + 1 r1 bits.
After 5 equal bits the sender inserts a stuff bit of the opposite value, which counts towards the next 5. A frame has at
most (34 + 8 n - 1) // 4 stuff bits (Davis et al. 2007, "Controller Area Network schedulability analysis", eq. 1). The
actual number depends on the bytes: the TYPICAL figures are means over this arm's frames, counted by `stuffed_bits`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from exo_gravity.core.errors import ParameterError

BITRATE = 1_000_000  # bit/s, of AK motors as delivered
COMMAND_BYTES = 8
# Mean bits of a frame over the poses, speeds and torques of an arm that is being carried.
TYPICAL_COMMAND = 124
TYPICAL_REPLY = {6: 101, 8: 118}  # by the bytes of the reply
TYPICAL_V3_COMMAND, TYPICAL_STATUS = 146, 141
STUFFED = 34  # bits without the data that are subject to stuffing
PLAIN = 13  # bits that are never stuffed
LONGER = 20  # bits of a frame with a 29-bit ID, more than of one with 11 bits
MAX_STATUS_RATE = 500.0  # Hz, of a V3 board
REPLY_SHARE = 0.8  # of a cycle in which replies are awaited


class Load(NamedTuple):
    """The load on one bus. share: of the bitrate, 1 when the bus is full. largest_rate: cycles/s that fill the bus."""

    bits_per_second: float
    share: float
    largest_rate: float


def frame_bits(data_bytes: int, is_extended: bool = False) -> int:
    """Return the bits of a frame with `data_bytes` (0..8), including the interframe space, without stuff bits."""
    return _stuffed(data_bytes, is_extended) + PLAIN


def worst_frame_bits(data_bytes: int, is_extended: bool = False) -> int:
    """Return the bits of a frame with `data_bytes` (0..8) and the largest possible number of stuff bits."""
    stuffed = _stuffed(data_bytes, is_extended)
    return stuffed + PLAIN + (stuffed - 1) // 4


def stuffed_bits(can_id: int, data: bytes, is_extended: bool = False) -> int:
    """Return the exact number of bits of one frame, including stuff bits and those in its CRC.

    can_id: 11 bits, or 29 if `is_extended`.
    """
    most = (1 << (29 if is_extended else 11)) - 1
    if not 0 <= can_id <= most:
        raise ParameterError("can_id", can_id, f"a whole number from 0 to {most}")
    if is_extended:
        bits = [0, *_bits(can_id >> 18, 11), 1, 1, *_bits(can_id & 0x3FFFF, 18), 0, 0, 0, *_bits(len(data), 4)]
    else:
        bits = [0, *_bits(can_id, 11), 0, 0, 0, *_bits(len(data), 4)]
    for byte in data:
        bits += _bits(byte, 8)
    bits += _bits(_crc(bits), 15)
    return frame_bits(len(data), is_extended) + _stuffing(bits)


@dataclass(frozen=True)
class Traffic:
    """The motors on one bus: `replying` of V1 and V2 boards, `reporting` of V3 boards.

    reply_bytes: 6 or 8. status_rate: status frames a second of each V3 board. bitrate: bit/s. Raises ParameterError.
    """

    replying: int
    reporting: int = 0
    reply_bytes: int = 8
    status_rate: float = MAX_STATUS_RATE
    bitrate: int = BITRATE

    def __post_init__(self) -> None:
        counts = (self.replying, self.reporting)
        if not all(isinstance(count, int) and count >= 0 for count in counts) or not any(counts):
            raise ParameterError("motors", list(counts), "whole numbers, at least 1 in total")
        if self.reply_bytes not in TYPICAL_REPLY:
            raise ParameterError("reply_bytes", self.reply_bytes, "6 or 8")
        if not isinstance(self.bitrate, int) or not 10_000 <= self.bitrate <= 1_000_000:
            raise ParameterError("can.options.bitrate", self.bitrate, "a whole number from 10000 to 1000000 bit/s")

    def load(self, rate: float, worst: bool = False) -> Load:
        """Return the bus load of `rate` cycles a second, for typical or for `worst` stuffing. Raises ParameterError."""
        if not rate > 0.0:
            raise ParameterError("rate", rate, "greater than 0 Hz")
        if worst:
            exchange = worst_frame_bits(COMMAND_BYTES) + worst_frame_bits(self.reply_bytes)
            command = status = worst_frame_bits(COMMAND_BYTES, is_extended=True)
        else:
            exchange = TYPICAL_COMMAND + TYPICAL_REPLY[self.reply_bytes]
            command, status = TYPICAL_V3_COMMAND, TYPICAL_STATUS
        cycle = self.replying * exchange + self.reporting * command
        unasked = self.reporting * self.status_rate * status  # bit/s
        used = rate * cycle + unasked
        return Load(used, used / self.bitrate, max(0.0, self.bitrate - unasked) / cycle)

    def check(self, rate: float) -> Load:
        """Return the typical load of `rate`. Raises ParameterError if it exceeds the capacity of the bus."""
        typical = self.load(rate)
        if typical.share > 1.0:
            motors, needed = self.replying + self.reporting, typical.bits_per_second / 1000.0
            raise ParameterError(
                "rate",
                rate,
                f"at most {int(typical.largest_rate)} Hz, the capacity of the CAN bus: {motors} motors need "
                f"{needed:.0f} kbit/s of its {self.bitrate / 1000.0:g}",
            )
        return typical

    def warning(self, rate: float) -> str:
        """Return why replies may be late at `rate` although they fit on the bus, or ''."""
        typical, worst = self.load(rate), self.load(rate, worst=True)
        if typical.share <= REPLY_SHARE and worst.share <= 1.0:
            return ""
        return (
            f"bus load {typical.share:.0%}, {worst.share:.0%} at worst: replies may be late; at most "
            f"{int(REPLY_SHARE * typical.largest_rate)} Hz leave them time"
        )


def load(rate: float, motors: int, reply_bytes: int = 8, worst: bool = False) -> Load:
    """Return the load of `rate` cycles a second with `motors` of V1 or V2 boards at 1 Mbit/s. Raises ParameterError."""
    return Traffic(motors, reply_bytes=reply_bytes).load(rate, worst)


def _stuffed(data_bytes: int, is_extended: bool) -> int:
    if not isinstance(data_bytes, int) or not 0 <= data_bytes <= 8:
        raise ParameterError("data_bytes", data_bytes, "a whole number from 0 to 8")
    return STUFFED + LONGER * is_extended + 8 * data_bytes


def _bits(value: int, width: int) -> list[int]:
    return [value >> place & 1 for place in reversed(range(width))]


def _crc(bits: list[int]) -> int:
    """Return CAN's CRC-15: polynomial 0x4599, initial value 0."""
    register = 0
    for bit in bits:
        turn = bit ^ register >> 14
        register = register << 1 & 0x7FFF
        if turn:
            register ^= 0x4599
    return register


def _stuffing(bits: list[int]) -> int:
    """Return the number of stuff bits; each one starts the next run of equal bits."""
    count, last, run = 0, None, 0
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            count, last, run = count + 1, 1 - bit, 1
    return count
