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
from functools import partial
from typing import Any

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from exo_gravity.core.motors.frames import Frame
from exo_gravity.hardware.can_port import message_of
from exo_gravity.sim.arbitration import Arbitration
from exo_gravity.sim.device import SimulatedDevice

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

    def every(self, period: float, function: Callable[[], None]) -> Callable[[], None]:
        """Call `function` every `period` s; return a function that ends it."""
        ended: list[bool] = []
        self.later(period, partial(self._repeat, period, function, ended))
        return partial(ended.append, True)

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

    def _repeat(self, period: float, function: Callable[[], None], ended: Sequence[bool]) -> None:
        if not ended:
            function()
            self.later(period, partial(self._repeat, period, function, ended))


class VirtualBus(can.BusABC):
    """One end of a `Wire`, for python-can's users."""

    def __init__(self, wire: Wire) -> None:
        self.channel_info = "wire in virtual time"
        self._wire = wire
        self._received: deque[can.Message] = deque()
        self._is_shutdown = False

    def deliver(self, message: can.Message) -> None:
        """Keep a frame for `recv`."""
        clock, batch = self._wire.clock, self._wire.batch
        if batch:
            clock.later(-clock.monotonic() % batch, partial(self._received.append, message))
        else:
            self._received.append(message)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        self._check()
        self._wire.carry(self, msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame, None if there is none within `timeout` s."""
        self._check()
        if not self._received:
            self._wire.clock.run(timeout or 0.0, lambda: self._received)
        return self._received.popleft() if self._received else None

    def shutdown(self) -> None:
        """Leave the wire."""
        self._is_shutdown = True
        self._wire.leave(self)

    def _check(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("Cannot operate on a closed bus")
        if self in self._wire.broken:
            raise self._wire.error


class EchoingBus(VirtualBus, UdpMulticastBus):
    """One end of a `Wire` that echoes, known by its type as udp_multicast is."""


class Played:
    """A simulated device on `wire`, whose time passes with the clock's.

    look: called after every step of the device.
    tick: s between two steps at most; None to step only before a frame is answered.
    joints: whose motors are on this wire, from 0 on; () for all.
    first: what plays the device's other motors on another wire, and lets its time pass.
    """

    def __init__(
        self,
        wire: Wire,
        device: SimulatedDevice,
        look: Callable[[], None],
        tick: float | None,
        joints: Sequence[int] = (),
        first: Played | None = None,
    ) -> None:
        self._wire, self._device, self._look, self._first = wire, device, look, first
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
            self._look()

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
        look: Callable[[], None] = lambda: None,
        tick: float | None = TICK,
        joints: Sequence[int] = (),
        first: Played | None = None,
    ) -> Played:
        """Connect a simulated device; see `Played`."""
        return Played(self, device, look, tick, joints, first)

    def break_down(self, error: Exception) -> None:
        """Let every end that is open now raise `error` from now on."""
        self.broken = {end for end in self.ends if isinstance(end, VirtualBus)}
        self.error = error

    def repeat(self, message: can.Message, period: float) -> Callable[[], None]:
        """Let another sender send `message` every `period` s; return a function that ends it."""
        return self.clock.every(period, partial(self.carry, None, message))

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

    def leave(self, end: VirtualBus) -> None:
        """Disconnect an end."""
        if end in self.ends:
            self.ends.remove(end)
