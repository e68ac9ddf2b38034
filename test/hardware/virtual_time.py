"""A CAN bus in virtual time, with a simulated device on it: the same frames as in real time, without threads or waits.

Time passes only while a thread waits for a frame or sleeps. Everything that is due meanwhile (replies, status
frames, frames of other senders) happens then, in order. Sending takes no time.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import math
import os
import random
import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from exo_gravity.core.motors.wire_formats import EXTENDED, ID_BITS, Frame
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.sim import SimulatedDevice

INTERFACE = os.environ.get("EXO_TEST_CAN_INTERFACE", "")
REPLY_DELAY = (200e-6, 400e-6)  # s, as of the simulated device in real time
TICK = 0.002  # s between two looks at the arm


class VirtualClock:
    """A clock whose time passes in `sleep` and `run`."""

    def __init__(self) -> None:
        self._nanoseconds = 100 * 10**9
        self.slept = 0.0  # s, with the whole computer
        self._events: list[tuple[int, int, Callable[[], None]]] = []  # a heap: when, in which order, what
        self._order = itertools.count()

    def monotonic(self) -> float:
        return self._nanoseconds / 1e9

    def sleep(self, duration: float) -> None:
        self.run(duration)

    def suspended(self) -> float:
        return self.slept

    def later(self, delay: float, function: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self._after(delay), next(self._order), function))

    def every(self, period: float, function: Callable[[], None]) -> Callable[[], None]:
        """Call `function` every `period` s; return a function that ends it."""
        is_ended: list[bool] = []

        def call() -> None:
            if not is_ended:
                function()
                self.later(period, call)

        self.later(period, call)
        return lambda: is_ended.append(True)

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


class VirtualBus(can.BusABC):
    """One end of a `Wire`, for python-can's users."""

    def __init__(self, wire: Wire) -> None:
        self.channel_info = "wire in virtual time"
        self._wire = wire
        self._received: deque[can.Message] = deque()
        self._is_shutdown = False

    def deliver(self, message: can.Message) -> None:
        clock, batch = self._wire.clock, self._wire.batch
        if batch:
            clock.later(-clock.monotonic() % batch, partial(self._received.append, message))
        else:
            self._received.append(message)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check()
        self._wire.carry(self, msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._check()
        if not self._received:
            self._wire.clock.run(timeout or 0.0, lambda: self._received)
        return self._received.popleft() if self._received else None

    def shutdown(self) -> None:
        self._is_shutdown = True
        self._wire.leave(self)

    def _check(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("Cannot operate on a closed bus")
        if self in self._wire.broken:
            raise self._wire.error


class EchoingBus(VirtualBus, UdpMulticastBus):
    """One end of a `Wire` that echoes, known by its type as udp_multicast is."""


class Responder:
    """Answers each frame on `wire` with those that `answer` returns, at once. received: all frames."""

    def __init__(self, wire: Wire, answer: Callable[[can.Message], list[can.Message]] = lambda message: []) -> None:
        self.received: list[can.Message] = []
        self._wire, self._answer = wire, answer
        wire.ends.append(self)

    def deliver(self, message: can.Message) -> None:
        self.received.append(message)
        for reply in self._answer(message):
            self._wire.carry(self, reply)


class Played:
    """A simulated device on `wire`; `look` is called after every step of it."""

    def __init__(self, wire: Wire, device: SimulatedDevice, look: Callable[[], None]) -> None:
        self._wire, self._device, self._look = wire, device, look
        self._last = wire.clock.monotonic()
        self._random = random.Random(0)
        wire.ends.append(self)
        wire.clock.every(TICK, self.catch_up)
        for joint, motor in enumerate(device.motors):
            if not motor.joint.wire_format.replies:
                wire.clock.every(1.0 / motor.firmware.status_rate, partial(self._report, joint))

    def deliver(self, message: can.Message) -> None:
        if message.is_error_frame or message.is_fd:
            return
        self.catch_up()
        frame_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        if reply := self._device.exchange(frame_id, bytes(message.data)):
            self._wire.clock.later(self._random.uniform(*REPLY_DELAY), partial(self._send, reply))

    def _report(self, joint: int) -> None:
        self.catch_up()
        if status := self._device.status(joint):
            self._send(status)

    def _send(self, frame: Frame) -> None:
        self._wire.carry(self, message_of(frame))

    def catch_up(self) -> None:
        """Let the device's time pass until now."""
        now = self._wire.clock.monotonic()
        self._device.advance(now - self._last)
        self._last = now
        self._look()


class Wire:
    """A CAN bus in virtual time. echoes: whether it returns each frame to its sender too, unmarked, as udp_multicast.

    refusal: what opening it raises, None if it can be opened. opened: how many ends were opened. loss: share of the
    frames that are lost. batch: s between two deliveries of the CAN adapters, 0 if they deliver at once.
    """

    def __init__(self, clock: VirtualClock | None = None, echoes: bool = False) -> None:
        self.clock = clock or VirtualClock()
        self.ends: list[VirtualBus | Responder | Played] = []
        self.refusal: Exception | None = None
        self.opened = 0
        self.loss = self.batch = 0.0
        self._random = random.Random(1)
        self.broken: set[VirtualBus] = set()
        self.error: Exception = OSError()
        self._echoes = echoes

    def open(self, *_: object) -> VirtualBus:
        """Open another end."""
        if self.refusal:
            raise self.refusal
        self.opened += 1
        bus = EchoingBus(self) if self._echoes else VirtualBus(self)
        self.ends.append(bus)
        return bus

    def play(self, device: SimulatedDevice, look: Callable[[], None] = lambda: None) -> Played:
        """Connect a simulated device; call `look` after every step of it."""
        return Played(self, device, look)

    def break_down(self, error: Exception) -> None:
        """Let every end that is open now raise `error` from now on."""
        self.broken = {end for end in self.ends if isinstance(end, VirtualBus)}
        self.error = error

    def repeat(self, message: can.Message, period: float) -> Callable[[], None]:
        """Let another sender send `message` every `period` s; return a function that ends it."""
        return self.clock.every(period, partial(self.carry, None, message))

    def carry(self, sender: object, message: can.Message) -> None:
        if self.loss and self._random.random() < self.loss:
            return
        for end in tuple(self.ends):
            if end is not sender or (self._echoes and isinstance(end, VirtualBus)):
                end.deliver(message)

    def leave(self, end: VirtualBus) -> None:
        if end in self.ends:
            self.ends.remove(end)


class RealWire:
    """The bus that EXO_TEST_CAN_INTERFACE and EXO_TEST_CAN_CHANNEL name, used like a `Wire`, in real time."""

    clock = COMPUTER_CLOCK

    def __init__(self) -> None:
        self._options: dict[str, Any] = {
            "interface": INTERFACE,
            "channel": os.environ["EXO_TEST_CAN_CHANNEL"],
            "fd": True,
        }
        self._ends: list[can.BusABC] = []
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def open(self) -> can.BusABC:
        self._ends.append(can.Bus(**self._options))
        return self._ends[-1]

    def play(self, device: SimulatedDevice) -> None:
        self._start(lambda bus: device.run(bus, self._stop.is_set))

    def repeat(self, message: can.Message, period: float) -> None:
        self._start(lambda bus: [bus.send(message) for _ in iter(lambda: self._stop.wait(period), True)])

    def close(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for end in self._ends:
            end.shutdown()

    def _start(self, run: Callable[[can.BusABC], object]) -> None:
        self._threads.append(threading.Thread(target=run, args=(self.open(),)))
        self._threads[-1].start()


@contextlib.contextmanager
def wire_for_test() -> Iterator[Wire | RealWire]:
    """A wire in virtual time, or the bus that the environment names."""
    wire = RealWire() if INTERFACE else Wire()
    yield wire
    if isinstance(wire, RealWire):
        wire.close()


def message_of(frame: Frame) -> can.Message:
    """Return the message of a frame, whose ID contains `EXTENDED` if it has 29 bits."""
    frame_id, data = frame
    return can.Message(arbitration_id=frame_id & ID_BITS, data=data, is_extended_id=frame_id >= EXTENDED)
