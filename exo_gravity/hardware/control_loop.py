"""The control thread of one arm: get the efforts, decide, command all motors, collect replies; at a fixed rate.

Each cycle fetches the newest efforts from `get_efforts`. Other threads use `call` to run a function on the control
thread between two cycles. The loop is paced by absolute monotonic deadlines, so that the rate does not drift.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from exo_gravity.core.drive import CARRYING, NOTHING, Drive, State
from exo_gravity.core.errors import BusError
from exo_gravity.core.faults import FaultCode
from exo_gravity.core.limits import JointSample
from exo_gravity.core.safety import SafetyMachine
from exo_gravity.hardware.motor_bus import MotorBus

EFFORT_WAIT = 0.5  # share of a cycle's idle time for which the loop may wait for late efforts
SMOOTHING = 0.02  # per cycle, of the measured work time
REPLY_WAIT = 0.8  # share of a cycle in which replies are awaited; the rest is for publishing them
MAX_ERRORS = 3  # unexpected exceptions in a row after which the state machine is no longer trusted
LAST_RESORT = 3.0  # s of damping alone after that


class EffortCommand(NamedTuple):
    """effort: (4,) Nm, or None to withdraw. answered: monotonic s, when the joint states that it answers were taken."""

    effort: Sequence[float] | None
    answered: float


NO_COMMAND = EffortCommand(None, -math.inf)


class ControlLoop:
    """Owns `bus` and `safety` from `start` until its thread has ended.

    get_efforts(latest) is called before every exchange and returns the newest efforts, for which it may wait until
    `latest` (monotonic s). on_cycle(now, samples) is called after every exchange.
    cycles, late, incomplete: counts of all cycles, of those that began more than a period late, and of those in which
    not every motor replied in time.
    """

    def __init__(
        self,
        bus: MotorBus,
        safety: SafetyMachine,
        period: float,
        on_cycle: Callable[[float, Sequence[JointSample]], None],
        get_efforts: Callable[[float], EffortCommand] = lambda latest: NO_COMMAND,
    ) -> None:
        self.cycles = self.late = self.incomplete = 0
        self.safety = safety
        self._bus = bus
        self._period = period
        self._on_cycle = on_cycle
        self._get_efforts = get_efforts
        self._work = period  # s per cycle, without waiting for efforts; smoothed
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)

    def start(self) -> None:
        """Start the thread. The state machine starts in its present state, DISABLED unless a `call` changed it."""
        self._thread.start()

    def call(self, function: Callable[[], Any]) -> Future[Any]:
        """Run `function` on the control thread between two cycles; the future has its result."""
        future: Future[Any] = Future()
        self._calls.put((function, future))
        return future

    @property
    def samples(self) -> Sequence[JointSample]:
        """The newest reading of each joint."""
        return tuple(self._bus.samples)

    @property
    def ignored(self) -> dict[str, int]:
        """Count of frames that were not replies of this arm's motors, by kind."""
        return dict(self._bus.ignored)

    def set_zero(self) -> None:
        """Make the present pose the motors' zero. Use it within a `call`, and only while they are off."""
        self._bus.set_zero()

    def trip(self, code: FaultCode, reason: str) -> None:
        """Let the arm down for a fault detected outside the loop."""
        self.call(lambda: self.safety.trip(code, reason, time.monotonic()))

    def trip_if_carried(self, code: FaultCode, reason: str) -> None:
        """Let the arm down for something that is a fault only while torque is applied."""
        if self.safety.state in CARRYING:
            self.trip(code, reason)

    def stop(self) -> None:
        """Let the arm down, send the last frames, close the bus; return when that is done."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        deadline = time.monotonic()
        errors = 0
        try:
            while errors < MAX_ERRORS and not self._finished():
                try:
                    self._cycle(deadline)
                    errors = 0
                except Exception as error:  # whatever happened, the arm must come down
                    errors += 1
                    self.safety.trip(FaultCode.INTERNAL_ERROR, f"{type(error).__name__}: {error}", time.monotonic())
                deadline = self._wait(deadline + self._period)
            if errors:
                self._damp()
        finally:
            self._bus.stop()

    def _finished(self) -> bool:
        return self._stopping and self.safety.state in (State.DISABLED, State.FAULT)

    def _cycle(self, due: float) -> None:
        efforts = self._get_efforts(due + EFFORT_WAIT * (self._period - self._work))
        self._run_calls()
        now = time.monotonic()
        if self._stopping:
            self.safety.disable(now)
        drive = self.safety.step(now, tuple(self._bus.samples), *efforts)
        try:
            complete = self._bus.exchange(drive, now + REPLY_WAIT * self._period)
        except BusError as error:
            self.safety.trip(FaultCode.BUS_ERROR, str(error), now)
            complete = False
        self.cycles += 1
        self.incomplete += not complete
        self._on_cycle(time.monotonic(), self._bus.samples)
        self._work += SMOOTHING * (time.monotonic() - now - self._work)

    def _run_calls(self) -> None:
        while True:
            try:
                function, future = self._calls.get_nowait()
            except Empty:
                return
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)

    def _wait(self, deadline: float) -> float:
        """Sleep until `deadline`; return it, or the present time if that is more than a period late."""
        remaining = deadline - time.monotonic()
        if remaining > 0.0:
            time.sleep(remaining)
        elif remaining < -self._period:
            self.late += 1
            return time.monotonic()
        return deadline

    def _damp(self) -> None:
        """Apply damping alone, without the state machine, for as long as an arm takes to come down: the last resort."""
        end = time.monotonic() + LAST_RESORT
        while time.monotonic() < end:
            try:
                self._bus.exchange(Drive(NOTHING, self.safety.limits.damping, True), time.monotonic() + self._period)
            except BusError:
                time.sleep(self._period)
