"""The control thread of one arm: decide, command all motors, collect their replies, hand them on; at a fixed rate.

Other threads reach it in two ways only: `ask` puts the newest efforts into a mailbox, `order` runs a function on the
control thread between two cycles. Paced by absolute monotonic deadlines, so that the rate does not drift.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any

from exo_gravity.core.errors import BusError
from exo_gravity.core.limits import JointSample
from exo_gravity.core.safety import CARRYING, NOTHING, Drive, SafetyMachine, State
from exo_gravity.hardware.motor_bus import MotorBus

PATIENCE = 0.5  # share of the time that its work leaves of a cycle, for which it may wait for efforts
SMOOTHING = 0.02  # of the time that the work takes, a cycle
COLLECTING = 0.8  # share of a cycle in which replies are awaited; the rest is for handing them on
BLUNDERS = 3  # unforeseen errors in a row after which the machine itself is not trusted any more
LAST_RESORT = 3.0  # s of plain damping then


class ControlLoop:
    """Owns `bus` and `safety` from `start` until its thread has ended.

    before_cycle(latest) is called before every exchange, to `ask` for the newest efforts, for which it may wait until
    `latest` (monotonic s); on_cycle(now, samples) after it.
    cycles, late, incomplete count all cycles, those that began more than a period late, and those in which not every
    motor replied in time.
    """

    def __init__(
        self,
        bus: MotorBus,
        safety: SafetyMachine,
        period: float,
        on_cycle: Callable[[float, Sequence[JointSample]], None],
        before_cycle: Callable[[float], None] = lambda latest: None,
    ):
        self.cycles = self.late = self.incomplete = 0
        self.safety = safety
        self._bus = bus
        self._period = period
        self._on_cycle = on_cycle
        self._before_cycle = before_cycle
        self._work = period  # s that a cycle takes without its waiting for efforts
        self._asked: tuple[Sequence[float] | None, float] = (None, -math.inf)
        self._orders: SimpleQueue[tuple[Callable[[], Any], Future]] = SimpleQueue()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)

    def start(self) -> None:
        """Start the thread; the machine begins where it is, DISABLED unless `order`ed otherwise."""
        self._thread.start()

    def ask(self, effort: Sequence[float] | None, answers: float) -> None:
        """Ask for `effort` (4,) Nm, computed from joint states taken at `answers` (monotonic s). None withdraws."""
        self._asked = (effort, answers)

    def order(self, function: Callable[[], Any]) -> Future:
        """Run `function` on the control thread between two cycles; the future has its result."""
        future: Future = Future()
        self._orders.put((function, future))
        return future

    @property
    def samples(self) -> Sequence[JointSample]:
        """The newest reading of each joint."""
        return tuple(self._bus.samples)

    @property
    def ignored(self) -> dict[str, int]:
        """How many frames were no reply of this arm's motors, by kind."""
        return dict(self._bus.ignored)

    def set_zero(self) -> None:
        """Make the present pose the motors' zero; to be `order`ed, and only while they are off."""
        self._bus.set_zero()

    def trip(self, code: str, reason: str) -> None:
        """Let the arm down for a fault seen from outside."""
        self.order(lambda: self.safety.trip(code, reason, time.monotonic()))

    def trip_if_carried(self, code: str, reason: str) -> None:
        """The same, for what is a fault only once torque flows."""
        if self.safety.state in CARRYING:
            self.trip(code, reason)

    def stop(self) -> None:
        """Let the arm down, send the last frames, close the bus; returns when that is done."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        deadline = time.monotonic()
        blunders = 0
        try:
            while blunders < BLUNDERS and not self._finished():
                try:
                    self._cycle(deadline)
                    blunders = 0
                except Exception as error:  # whatever it is, the arm must come down
                    blunders += 1
                    self.safety.trip("internal_error", f"{type(error).__name__}: {error}", time.monotonic())
                deadline = self._wait(deadline + self._period)
            if blunders:
                self._damp()
        finally:
            self._bus.stop()

    def _finished(self) -> bool:
        return self._stopping and self.safety.state in (State.DISABLED, State.FAULT)

    def _cycle(self, due: float) -> None:
        self._before_cycle(due + PATIENCE * (self._period - self._work))
        self._obey()
        now = time.monotonic()
        if self._stopping:
            self.safety.disable(now)
        drive = self.safety.step(now, tuple(self._bus.samples), *self._asked)
        try:
            complete = self._bus.exchange(drive, now + COLLECTING * self._period)
        except BusError as error:
            self.safety.trip("bus_error", str(error), now)
            complete = False
        self.cycles += 1
        self.incomplete += not complete
        self._on_cycle(time.monotonic(), self._bus.samples)
        self._work += SMOOTHING * (time.monotonic() - now - self._work)

    def _obey(self) -> None:
        while True:
            try:
                function, future = self._orders.get_nowait()
            except Empty:
                return
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)

    def _wait(self, deadline: float) -> float:
        """Sleep until `deadline`; return it, or the present where that is already more than a period late."""
        remaining = deadline - time.monotonic()
        if remaining > 0.0:
            time.sleep(remaining)
        elif remaining < -self._period:
            self.late += 1
            return time.monotonic()
        return deadline

    def _damp(self) -> None:
        """The last resort, without the machine: damping alone, for as long as an arm takes to come down."""
        end = time.monotonic() + LAST_RESORT
        while time.monotonic() < end:
            try:
                self._bus.exchange(Drive(NOTHING, self.safety.limits.damping, True), time.monotonic() + self._period)
            except BusError:
                time.sleep(self._period)
