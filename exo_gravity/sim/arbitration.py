# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CAN controllers on a wire in virtual time: arbitration, collisions of two frames with one ID, error counters.

By the Bosch CAN Specification 2.0, part A, sections 6 to 8. A frame takes the time of its bits, stuff bits included.
When the wire is idle, every controller with a frame to send begins, and the lowest ID wins. An ID is meant to have one
sender. Two controllers that send one ID at once go on together until their bits differ:

- The one that sends the recessive bit (1) and reads a dominant one has a bit error. It sends an error flag that ends
  the frame for both. Both count 8 in their transmit error counter (TEC), and send again as soon as the wire is idle:
  they meet again.
- Above 127 a controller is error passive: its flag disturbs nobody, so the other's frame goes through, and after each
  of its own frames it lets others begin first.
- Above 255 it is off the bus. What it had to send is lost, and so is what it is given until it is restarted.

A frame that goes through takes 1 off. Lost acknowledgements and receive error counters are not played.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import can

ERROR_STEP = 8  # of a TEC at an error
PASSIVE_FROM, BUS_OFF_FROM = 128, 256  # values of a TEC
ERROR_FRAME_BITS = 6 + 6 + 8 + 3  # the flag, the other's flag that it causes, the delimiter, the interframe space
SUSPENDED_BITS = 8  # for which an error-passive controller waits after its frame
TAIL_BITS = 10 + 3  # of a frame after its CRC, never stuffed, and the interframe space
RESTART_TIME = 0.1  # s, `restart-ms 100` of SocketCAN
_RUN = 5  # equal bits, after which a stuff bit follows
_CRC_POLYNOMIAL = 0x4599


@dataclass
class CanController:
    """One CAN controller. pending: senders, frames and their bits, first in, first out."""

    retransmits: bool  #: It sends a frame again after an error, as all do unless they are told not to.
    pending: deque[tuple[object, can.Message, list[int]]] = field(default_factory=deque)
    tec: int = 0  #: Transmit error counter.
    ready: float = -math.inf  #: s from which it may begin.
    off_until: float = -math.inf  #: s until which it is off the bus.

    def suspend(self, end: float, bitrate: int) -> None:
        """Wait after a frame that it sent and that ended at `end` s, if it is error passive."""
        if self.tec >= PASSIVE_FROM:
            self.ready = end + SUSPENDED_BITS / bitrate


class Arbitration:
    """Carries the frames of a wire's controllers, one at a time.

    clock: a `VirtualClock`, of all times.
    bitrate: bit/s.
    deliver: called with a frame's sender and the frame when it has arrived.

    collisions: how often two frames with one ID met.
    bus_offs: how often a controller left the bus.
    tec: the highest transmit error counter that a controller has had.
    """

    def __init__(self, clock: Any, bitrate: int, deliver: Callable[[object, can.Message], None]) -> None:
        self.collisions = self.bus_offs = self.tec = 0
        self._clock, self._bitrate, self._deliver = clock, bitrate, deliver
        self._controllers: dict[Hashable, CanController] = {}
        self._is_busy = False

    def send(self, name: Hashable, sender: object, message: can.Message, retransmits: bool) -> None:
        """Let the controller `name` send a frame of `sender` when it can."""
        controller = self._controllers.setdefault(name, CanController(retransmits))
        if self._clock.monotonic() >= controller.off_until:
            controller.pending.append((sender, message, frame_bits(message)))
            self._clock.later(0.0, self._begin)

    def _begin(self) -> None:
        """Let those begin that have a frame to send and may."""
        now = self._clock.monotonic()
        waiting = [controller for controller in self._controllers.values() if controller.pending]
        if self._is_busy or not waiting:
            return
        rivals = [controller for controller in waiting if now >= controller.ready]
        if not rivals:
            self._clock.later(min(controller.ready for controller in waiting) - now, self._begin)
            return
        self._is_busy = True
        streams = [(controller.pending[0][2], controller) for controller in rivals]
        failed: list[CanController] = []
        while (at := _first_difference([bits for bits, _ in streams])) is not None:
            kept = [(bits, controller) for bits, controller in streams if not bits[at]]
            ids = {_arbitration_id(controller) for _, controller in kept}
            lost = [controller for bits, controller in streams if bits[at]]
            failing = [controller for controller in lost if _arbitration_id(controller) in ids]
            self.collisions += bool(failing)
            if any(controller.tec < PASSIVE_FROM for controller in failing):
                failing += [controller for _, controller in kept]
                self._fail(failing, now)
                duration = (at + 1 + ERROR_FRAME_BITS) / self._bitrate  # an error frame ends theirs
                for controller in failing:
                    controller.suspend(now + duration, self._bitrate)
                self._clock.later(duration, self._become_idle)
                return
            self._fail(failing, now)
            failed += failing
            streams = kept
        bits, senders = streams[0][0], [controller for _, controller in streams]
        self._clock.later((len(bits) + TAIL_BITS) / self._bitrate, partial(self._finish, senders, failed))

    def _fail(self, controllers: Sequence[CanController], now: float) -> None:
        """Count an error of each one's frame; some leave the bus for that."""
        for controller in controllers:
            controller.tec += ERROR_STEP
            self.tec = max(self.tec, controller.tec)
            if not controller.retransmits:
                controller.pending.popleft()
            if controller.tec >= BUS_OFF_FROM:
                controller.pending.clear()
                controller.tec, controller.off_until = 0, now + RESTART_TIME
                self.bus_offs += 1

    def _finish(self, senders: Sequence[CanController], failed: Sequence[CanController]) -> None:
        """Deliver the frame that `senders` have sent, all the same bits, and whose ID those that failed have too."""
        sent = [controller.pending.popleft() for controller in senders]
        for controller in senders:
            controller.tec = max(0, controller.tec - 1)
        for controller in (*senders, *failed):
            controller.suspend(self._clock.monotonic(), self._bitrate)
        self._is_busy = False
        self._clock.later(0.0, self._begin)
        sender, message, _ = sent[0]
        self._deliver(sender, message)

    def _become_idle(self) -> None:
        self._is_busy = False
        self._begin()


def _arbitration_id(controller: CanController) -> tuple[int, bool, bool]:
    message = controller.pending[0][1]
    return message.arbitration_id, message.is_extended_id, message.is_remote_frame


def _first_difference(streams: Sequence[Sequence[int]]) -> int | None:
    """Return the first place at which streams of bits differ; None if none does."""
    return next((at for at, bits in enumerate(zip(*streams, strict=False)) if len(set(bits)) > 1), None)


def _bits(value: int, width: int) -> list[int]:
    return [value >> place & 1 for place in reversed(range(width))]


def frame_bits(message: can.Message) -> list[int]:
    """Return the bits of a frame until the end of its CRC, with its stuff bits; 0 is dominant."""
    frame_id, data = message.arbitration_id, b"" if message.is_remote_frame else bytes(message.data)
    remote = int(message.is_remote_frame)
    if message.is_extended_id:
        head = [*_bits(frame_id >> 18, 11), 1, 1, *_bits(frame_id & 0x3FFFF, 18), remote, 0, 0]
    else:
        head = [*_bits(frame_id, 11), remote, 0, 0]
    bits = [0, *head, *_bits(message.dlc, 4), *(bit for byte in data for bit in _bits(byte, 8))]
    crc = 0
    for bit in bits:
        crc = (crc << 1 & 0x7FFF) ^ (_CRC_POLYNOMIAL if bit ^ crc >> 14 else 0)
    stuffed: list[int] = []
    run = 0
    for bit in (*bits, *_bits(crc, 15)):
        run = run + 1 if stuffed and stuffed[-1] == bit else 1
        stuffed.append(bit)
        if run == _RUN:
            stuffed.append(1 - bit)
            run = 1
    return stuffed
