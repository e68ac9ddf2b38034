# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A CAN bus in virtual time, with a simulated device on it: the same frames as in real time, without threads or waits.

Time passes only while a thread waits for a frame or sleeps. Everything that is due meanwhile (replies, status
frames, frames of other senders) happens then, in order. Sending takes no time, unless the wire has a bit rate: then its
frames take turns by arbitration, and collide where two senders use one ID (`arbitration`).
"""

from __future__ import annotations

import heapq
import math
import random
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from exo_gravity.core.motors.frames import Frame
from exo_gravity.hardware.can_port import message_of
from exo_gravity.sim.device import SimulatedDevice

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

    retransmits: bool  #: whether it retransmits a frame after an error, which is the default of CAN controllers
    pending: deque[tuple[object, can.Message, list[int]]] = field(default_factory=deque)
    tec: int = 0  #: Transmit error counter.
    ready: float = -math.inf  #: s from which it may begin.
    off_until: float = -math.inf  #: s until which it is off the bus.


class Arbitration:
    """Carries the frames of a wire's controllers, one at a time.

    By the Bosch CAN Specification 2.0, part A, sections 6 to 8. A frame takes the time of its bits, with stuff bits.
    When the wire is idle, every controller with a frame to send begins, and the lowest ID wins. An ID is meant to have
    one sender. Two controllers that send one ID at once go on together until their bits differ:

    - The one that sends the recessive bit (1) and reads a dominant one has a bit error. It sends an error flag that
      ends the frame for both. Both count 8 in their transmit error counter (TEC), and send again as soon as the wire is
      idle: they meet again.
    - Above a TEC of 127 a controller is error passive: its error flag no longer destroys frames, so the other's gets
      through. After each frame of its own it lets others start first.
    - Above 255 it is off the bus. What it had to send is lost, and so is what it is given until it is restarted.

    A frame that goes through takes 1 off. Lost acknowledgements and receive error counters are not played.

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
                self._clock.later(duration, partial(self._finish, (), failing))
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
        """Deliver the frame that `senders` have sent, all the same bits; those that `failed` had the same ID."""
        sent = [controller.pending.popleft() for controller in senders]
        for controller in senders:
            controller.tec = max(0, controller.tec - 1)
        for controller in (*senders, *failed):
            if controller.tec >= PASSIVE_FROM:
                controller.ready = self._clock.monotonic() + SUSPENDED_BITS / self._bitrate
        self._is_busy = False
        self._clock.later(0.0, self._begin)
        for sender, message, _ in sent[:1]:
            self._deliver(sender, message)


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


TICK = 0.002  # s between two looks at the arm


class VirtualClock:
    """A clock whose time passes in `sleep` and `run`. It is a `Clock` of the hardware.

    start: its first time, s.
    """

    def __init__(self, start: float = 100.0) -> None:
        self._nanoseconds = round(start * 1e9)
        self.slept = 0.0  # s, with the whole computer
        self._events: list[tuple[int, int, Callable[[], None]]] = []  # a heap: when, in which order, what
        self._order = 0  # of the next event

    def monotonic(self) -> float:
        """Return the time in s."""
        return self._nanoseconds / 1e9

    def sleep(self, duration: float) -> None:
        """Let `duration` s pass."""
        self.run(duration)

    def suspended(self) -> float:
        """Return the time in s for which the computer has slept so far."""
        return self.slept

    def later(self, delay: float, function: Callable[[], None]) -> None:
        """Call `function` in `delay` s."""
        heapq.heappush(self._events, (self._after(delay), self._order, function))
        self._order += 1

    def every(self, period: float, function: Callable[[], object]) -> None:
        """Call `function` every `period` s from then on."""
        self.later(period, partial(self._repeat, period, function))

    def stall(self, duration: float) -> None:
        """Let `duration` s pass in which nothing happens: it is all late then."""
        self._nanoseconds = self._after(duration)

    def run(self, duration: float, is_done: Callable[[], object] = lambda: False) -> None:
        """Let `duration` s pass, or less: until `is_done()` after something has happened."""
        end = self._after(duration)
        while self._events and self._events[0][0] <= end:
            when, _, function = heapq.heappop(self._events)
            self._nanoseconds = max(when, self._nanoseconds)
            function()
            if is_done():
                return
        self._nanoseconds = max(end, self._nanoseconds)

    def _after(self, duration: float) -> int:
        return self._nanoseconds + max(0, math.ceil(duration * 1e9))

    def _repeat(self, period: float, function: Callable[[], object]) -> None:
        function()
        self.every(period, function)


class VirtualBus(can.BusABC):
    """One end of a `Wire`, for python-can's users."""

    def __init__(self, wire: Wire) -> None:
        self.channel_info = "wire in virtual time"
        self._wire = wire
        self._received: deque[can.Message] = deque()
        # python-can warns of a bus that is not shut down: nothing stays open here.
        self._is_shutdown, self._has_left = True, False

    def deliver(self, message: can.Message) -> None:
        """Keep a frame until it is read."""
        clock, batch = self._wire.clock, self._wire.batch
        if batch:
            clock.later(-clock.monotonic() % batch, partial(self._received.append, message))
        else:
            self._received.append(message)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        self._check()
        self._wire.carry(self, msg)

    def _recv_internal(self, timeout: float | None = None) -> tuple[can.Message | None, bool]:
        """Return the next frame, or None after `timeout` s; and True, because there is no filter."""
        self._check()
        if not self._received:
            self._wire.clock.run(timeout or 0.0, lambda: self._received)
        return self._received.popleft() if self._received else None, True

    def shutdown(self) -> None:
        """Leave the wire."""
        self._has_left = True
        with suppress(ValueError):  # it has left already
            self._wire.ends.remove(self)

    def _check(self) -> None:
        if self._has_left:
            raise can.CanOperationError("Cannot operate on a closed bus")
        if self in self._wire.broken:
            raise self._wire.error


class EchoingBus(VirtualBus, UdpMulticastBus):
    """One end of a `Wire` that echoes, known by its type as udp_multicast is."""


class Played:
    """A simulated device on `wire`, whose time passes with the clock's.

    tick: s between two steps at most; None to step only before a frame is answered.
    joints: whose motors are on this wire, from 0 on; () for all.
    first: what plays the device's other motors on another wire, and lets its time pass.
    """

    def __init__(
        self,
        wire: Wire,
        device: SimulatedDevice,
        tick: float | None,
        joints: Sequence[int] = (),
        first: Played | None = None,
    ) -> None:
        self._wire, self._device, self._first = wire, device, first
        self._joints = joints or range(len(device.motors))
        self._last = wire.clock.monotonic()
        self._random = random.Random(0)
        wire.ends.append(self)
        if tick:
            wire.clock.every(tick, self.catch_up)
        for joint in self._joints:
            if not device.motors[joint].joint.wire_format.replies:
                wire.clock.every(1.0 / device.motors[joint].firmware.status_rate, partial(self._report, joint))

    def deliver(self, message: can.Message) -> None:
        """Let the device receive a frame, and send its reply."""
        command = self._device.command_of(message)
        if command is None:
            return
        self.catch_up()
        for joint, reply in self._device.replies(*command, self._joints):
            delay = self._random.uniform(*self._device.motors[joint].firmware.reply_delay)
            self._wire.clock.later(delay, partial(self._send, joint, reply))

    def catch_up(self) -> None:
        """Let the device's time pass until now."""
        now = self._wire.clock.monotonic()
        if self._first:
            self._first.catch_up()
        elif now > self._last:
            self._device.advance(now - self._last)
            self._last = now

    def _report(self, joint: int) -> None:
        self.catch_up()
        if status := self._device.status(joint):
            self._send(joint, status)

    def _send(self, joint: int, frame: Frame) -> None:
        motor = self._device.motors[joint]
        self._wire.carry(self, message_of(frame, self._device.is_fd[joint]), motor, motor.firmware.retransmits)


class Wire:
    """A CAN bus in virtual time.

    clock: by default one of its own, which begins at `start` s.
    echoes: whether it returns each frame to its sender too, unmarked, as udp_multicast.
    bitrate: bit/s; 0: frames take no time, and none collide: there is no `arbitration`.

    refusal: what opening it raises, None if it can be opened. opened: how many ends were opened. loss: share of the
    frames that are lost. commands_lost, replies_lost: arbitration IDs of frames that are lost on their way from a host,
    or from a device. batch: s between two deliveries of the CAN adapters, 0 if they deliver at once.
    """

    def __init__(
        self, clock: VirtualClock | None = None, echoes: bool = False, start: float = 100.0, bitrate: int = 0
    ) -> None:
        self.clock = clock or VirtualClock(start)
        self.ends: list[Any] = []  # each with `deliver(message)`
        self.refusal: Exception | None = None
        self.opened = 0
        self.loss = self.batch = 0.0
        self.commands_lost: set[int] = set()
        self.replies_lost: set[int] = set()
        self._random = random.Random(1)
        self.broken: set[VirtualBus] = set()
        self.error: Exception = OSError()
        self._echoes = echoes
        self.arbitration = Arbitration(self.clock, bitrate, self._deliver) if bitrate else None

    def open(self, *_: object) -> VirtualBus:
        """Open another end."""
        if self.refusal:
            raise self.refusal
        self.opened += 1
        bus = EchoingBus(self) if self._echoes else VirtualBus(self)
        self.ends.append(bus)
        return bus

    def play(
        self,
        device: SimulatedDevice,
        tick: float | None = TICK,
        joints: Sequence[int] = (),
        first: Played | None = None,
    ) -> Played:
        """Connect a simulated device; see `Played`."""
        return Played(self, device, tick, joints, first)

    def break_down(self, error: Exception) -> None:
        """Let every end that is open now raise `error` from now on."""
        self.broken = {end for end in self.ends if isinstance(end, VirtualBus)}
        self.error = error

    def carry(
        self, sender: object, message: can.Message, controller: Hashable = None, retransmits: bool = True
    ) -> None:
        """Deliver a frame to every end but its sender's, unless it is lost.

        controller: what sends it, if `sender` is a device with several.
        retransmits: whether that sends it again after an error.
        """
        lost = self.commands_lost if isinstance(sender, VirtualBus) else self.replies_lost
        if message.arbitration_id in lost or (self.loss and self._random.random() < self.loss):
            return
        if self.arbitration:
            self.arbitration.send(controller or sender, sender, message, retransmits)
        else:
            self._deliver(sender, message)

    def _deliver(self, sender: object, message: can.Message) -> None:
        for end in tuple(self.ends):
            if end is not sender or (self._echoes and isinstance(end, VirtualBus)):
                end.deliver(message)
