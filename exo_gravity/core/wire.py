"""The load that a control rate puts on the CAN bus, and the highest rate that fits.

In each cycle every motor gets a command of 8 bytes and replies with 8 bytes, or 6 on older firmware. A classic CAN
frame with an 11-bit ID and n bytes of data has (ISO 11898-1; Bosch, CAN Specification 2.0, part A)

    1 start + 11 ID + 1 RTR + 1 IDE + 1 r0 + 4 length + 8 n data + 15 CRC     = 34 + 8 n bits, subject to stuffing
    1 CRC delimiter + 2 acknowledge + 7 end of frame + 3 interframe space     = 13 bits, never stuffed

After 5 equal bits the sender inserts a stuff bit of the opposite value, which counts towards the next 5. A frame has at
most (34 + 8 n - 1) // 4 stuff bits (Davis et al. 2007, "Controller Area Network schedulability analysis", eq. 1). The
actual number depends on the bytes: `TYPICAL_COMMAND` and `TYPICAL_REPLY` are means over this arm's frames, counted by
`stuffed_bits`.
"""

from __future__ import annotations

from typing import NamedTuple

from exo_gravity.core.errors import ParameterError

BITRATE = 1_000_000  # bit/s, fixed in the AK motors
COMMAND_BYTES = 8
# Mean bits of a frame over the poses, speeds and torques of an arm that is being carried.
TYPICAL_COMMAND = 124
TYPICAL_REPLY = {6: 101, 8: 118}  # by the bytes of the reply
STUFFED = 34  # bits without the data that are subject to stuffing
PLAIN = 13  # bits that are never stuffed


class Load(NamedTuple):
    """The load on one bus. share: of the bitrate, 1 when the bus is full. largest_rate: cycles/s that fill the bus."""

    bits_per_second: float
    share: float
    largest_rate: float


def frame_bits(data_bytes: int) -> int:
    """Return the bits of a frame with `data_bytes` (0..8), including the interframe space, without stuff bits."""
    if not isinstance(data_bytes, int) or not 0 <= data_bytes <= 8:
        raise ParameterError("data_bytes", data_bytes, "a whole number from 0 to 8")
    return STUFFED + 8 * data_bytes + PLAIN


def worst_frame_bits(data_bytes: int) -> int:
    """Return the bits of a frame with `data_bytes` (0..8) and the largest possible number of stuff bits."""
    return frame_bits(data_bytes) + (STUFFED + 8 * data_bytes - 1) // 4


def stuffed_bits(can_id: int, data: bytes) -> int:
    """Return the exact number of bits of one frame, including stuff bits and those in its CRC.

    can_id: 11 bits.
    """
    if not 0 <= can_id < 2048:
        raise ParameterError("can_id", can_id, "a whole number from 0 to 2047")
    bits = [0, *_bits(can_id, 11), 0, 0, 0, *_bits(len(data), 4)]
    for byte in data:
        bits += _bits(byte, 8)
    bits += _bits(_crc(bits), 15)
    return frame_bits(len(data)) + _stuffing(bits)


def load(rate: float, motors: int, reply_bytes: int = 8, worst: bool = False) -> Load:
    """Return the bus load of `rate` cycles a second with `motors` on one bus, for typical or for `worst` stuffing.

    reply_bytes: 6 or 8. Raises ParameterError.
    """
    if not rate > 0.0:
        raise ParameterError("rate", rate, "greater than 0 Hz")
    if not isinstance(motors, int) or motors < 1:
        raise ParameterError("motors", motors, "a whole number, at least 1")
    if reply_bytes not in TYPICAL_REPLY:
        raise ParameterError("reply_bytes", reply_bytes, "6 or 8")
    if worst:
        exchange = worst_frame_bits(COMMAND_BYTES) + worst_frame_bits(reply_bytes)
    else:
        exchange = TYPICAL_COMMAND + TYPICAL_REPLY[reply_bytes]
    cycle = motors * exchange
    return Load(rate * cycle, rate * cycle / BITRATE, BITRATE / cycle)


def check_rate(rate: float, motors: int, reply_bytes: int = 8) -> Load:
    """Return the typical load of `rate`. Raises ParameterError if it exceeds the capacity of the bus."""
    typical = load(rate, motors, reply_bytes)
    if typical.share > 1.0:
        raise ParameterError("rate", rate, f"at most {int(typical.largest_rate)} Hz, the capacity of the CAN bus")
    return typical


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
