"""The wire: how much of a CAN bus a control rate takes, and the largest rate that fits.

Each cycle sends every motor one command of 8 bytes, and each answers with 8, or 6 on older firmware. A classic CAN
frame with an 11-bit ID and n bytes of data has (ISO 11898-1; Bosch, CAN Specification 2.0, part A)

    1 start + 11 ID + 1 RTR + 1 IDE + 1 r0 + 4 length + 8 n data + 15 CRC     = 34 + 8 n bits, subject to stuffing
    1 CRC delimiter + 2 acknowledge + 7 end of frame + 3 interframe space     = 13 bits, never stuffed

After 5 equal bits the sender stuffs in one of the other kind, which counts for the next 5: at most (34 + 8 n - 1) // 4
stuff bits (Davis et al. 2007, "Controller Area Network schedulability analysis", eq. 1). How many there are depends on
the bytes: `TYPICAL_BITS` is the mean over this arm's frames, as `stuffed_bits` counts them.
"""

from __future__ import annotations

from typing import NamedTuple

from exo_gravity.core.errors import ParameterError

BITRATE = 1_000_000  # bit/s of the AK motors, not to be changed on them
COMMAND_BYTES = 8
# Mean bits of a command, and of a reply by its bytes, over the poses, speeds and torques of an arm that is carried.
TYPICAL_COMMAND = 124
TYPICAL_REPLY = {6: 101, 8: 118}
STUFFED = 34  # bits besides the data that stuffing looks at
PLAIN = 13  # bits that it does not


class Load(NamedTuple):
    """What a rate asks of one bus. bits_per_second; share of the bitrate; largest_rate: cycles/s that would fill it."""

    bits_per_second: float
    share: float
    largest_rate: float


def frame_bits(data_bytes: int) -> int:
    """Return the bits on the wire of a frame with `data_bytes` (0..8), interframe space included, without stuffing."""
    if not isinstance(data_bytes, int) or not 0 <= data_bytes <= 8:
        raise ParameterError("data_bytes", data_bytes, "a whole number from 0 to 8")
    return STUFFED + 8 * data_bytes + PLAIN


def worst_frame_bits(data_bytes: int) -> int:
    """Return the most bits that a frame with `data_bytes` (0..8) can take, with all the stuffing there can be."""
    return frame_bits(data_bytes) + (STUFFED + 8 * data_bytes - 1) // 4


def stuffed_bits(can_id: int, data: bytes) -> int:
    """Return the bits on the wire of one frame, its stuff bits counted.

    can_id: 11 bits. Exact: the CRC (15 bits, 0x4599) is computed.
    """
    if not 0 <= can_id < 2048:
        raise ParameterError("can_id", can_id, "a whole number from 0 to 2047")
    bits = [0, *_bits(can_id, 11), 0, 0, 0, *_bits(len(data), 4)]
    for byte in data:
        bits += _bits(byte, 8)
    bits += _bits(_crc(bits), 15)
    return frame_bits(len(data)) + _stuffing(bits)


def load(rate: float, motors: int, reply_bytes: int = 8, worst: bool = False) -> Load:
    """Return what `rate` cycles a second with `motors` on one bus ask of it: typically, or with the `worst` stuffing.

    reply_bytes: 6 or 8. Raises ParameterError.
    """
    if not rate > 0.0:
        raise ParameterError("rate", rate, "a number above 0 Hz")
    if not isinstance(motors, int) or motors < 1:
        raise ParameterError("motors", motors, "a whole number from 1")
    if reply_bytes not in TYPICAL_REPLY:
        raise ParameterError("reply_bytes", reply_bytes, "6 or 8")
    if worst:
        exchange = worst_frame_bits(COMMAND_BYTES) + worst_frame_bits(reply_bytes)
    else:
        exchange = TYPICAL_COMMAND + TYPICAL_REPLY[reply_bytes]
    cycle = motors * exchange
    return Load(rate * cycle, rate * cycle / BITRATE, BITRATE / cycle)


def check_rate(rate: float, motors: int, reply_bytes: int = 8) -> Load:
    """Return the typical load of `rate`, or raise ParameterError if it is more than the bus has."""
    typical = load(rate, motors, reply_bytes)
    if typical.share > 1.0:
        raise ParameterError("rate", rate, f"at most {int(typical.largest_rate)} Hz: more does not fit on the wire")
    return typical


def _bits(value: int, width: int) -> list[int]:
    return [value >> place & 1 for place in reversed(range(width))]


def _crc(bits: list[int]) -> int:
    """CRC-15 of CAN: the polynomial 0x4599, from 0."""
    register = 0
    for bit in bits:
        turn = bit ^ register >> 14
        register = register << 1 & 0x7FFF
        if turn:
            register ^= 0x4599
    return register


def _stuffing(bits: list[int]) -> int:
    """Return how many bits the sender stuffs in; a stuffed bit begins the next run."""
    count, last, run = 0, None, 0
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            count, last, run = count + 1, 1 - bit, 1
    return count
