# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Ends of a wire that tests need, and the real bus that may take the place of a wire in virtual time."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import can

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.hardware.can.can_port import CanPort
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.sim import SimulatedDevice
from exo_gravity.sim.virtual_time import Wire

INTERFACE = os.environ.get("EXO_TEST_CAN_INTERFACE", "")


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


def motor_bus(wire: Wire | RealWire, joints: Sequence[JointMotor]) -> MotorBus:
    """Return the bridge's end of a bus with all these motors."""
    return MotorBus([CanPort(wire.open(), wire.clock)] * len(joints), joints, clock=wire.clock)
