# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The control loop of one arm: get the efforts, decide, command all motors, collect replies; at a fixed rate.

What turns samples into efforts is a `Controller`: over ROS, in this process, or the tour of a calibration. Each cycle
asks it for the newest efforts, and gives it the samples that follow. Other threads use `call` to run a function between
two cycles. The loop is paced by absolute deadlines on the clock of its bus, so that the rate does not drift.

An exception anywhere lets the arm down: a controller without efforts has withdrawn them, an exception of the bus is a
silent bus, one in the state machine a fault. If the state machine keeps failing, the watchdog takes over from the
last noted command; without a watchdog, the loop lowers the arm without the state machine (`lower`).
"""

import contextlib
import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Protocol

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import REPLY_SHARE, JointSample
from exo_gravity.core.safety.command import CARRYING, NO_EFFORTS, Command, Efforts, FaultCode, Send, State
from exo_gravity.core.safety.limits import DAMPING, Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.safety.watch import RestTracker
from exo_gravity.core.vocabulary import NO_REASON, Status, Wait
from exo_gravity.hardware.motor_bus import MotorBus

EFFORT_WAIT = 0.5  # share of a cycle's idle time for which the loop may wait for late efforts
WORK_SMOOTHING = 0.02  # per cycle, of the measured work time
MAX_ERRORS = 3  # unexpected exceptions in a row after which the state machine is no longer trusted
SUSPENDED = 1.0  # s; less may be a thread that waited between two looks at a clock
LONGEST_ABSENCE = 5.0  # s without a sign of the owner, while the arm is carried; its longest request takes 2 s
HAND_OVER_TIME = 0.5  # s in which a watchdog that takes over has ended this process


@dataclass(frozen=True)
class Lowering:
    """How an arm is lowered without the state machine, in s."""

    fade: float = 10.0  #: in which the torque fades
    rest: float = 10.0  #: for which the joints must be at rest
    reply_timeout: float = 0.1  #: without a reply, after which a motor's position is not known


LOWERING = Lowering()


class Controller(Protocol):
    """Turns samples into efforts. Both methods are called on the thread of the loop."""

    def efforts(self, latest: float) -> Efforts:
        """Return the newest efforts; called before each exchange of frames.

        latest: until when it may wait for those that answer the last samples, s on the clock of the bus.
        """
        ...

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Take the newest sample of each joint; called after each exchange. An exception does not stop the control.

        now: s on the clock of the bus.
        """
        ...


class NoController:
    """Asks for nothing: of an arm that is only let down."""

    def efforts(self, latest: float) -> Efforts:
        """Return no efforts."""
        return NO_EFFORTS

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Ignore the samples."""


class ControlLoop:
    """Owns `bus`, and the state machine of its arm, until it has ended. Its clock is that of the bus.

    It begins by finding out whether a motor is on (`SafetyMachine.probe`).

    `start` repeats `cycle` on a thread. A loop that was not started is run by its owner, one `cycle` after another.

    limits: of the arm.
    period: s of a cycle.
    controller: what the arm is carried by.
    hand_over: requests the watchdog, for a reason, to end this process and let the arm down; returns whether one is
        there.
    """

    def __init__(
        self,
        bus: MotorBus,
        limits: Limits,
        period: float,
        controller: Controller,
        hand_over: Callable[[str], bool] = lambda reason: False,
    ) -> None:
        #: The state machine, for a `call`, or between two cycles.
        self.safety = SafetyMachine(limits, period, bus.motors)
        #: s of a cycle; it may change between two cycles.
        self.period = period
        #: Counts of all cycles, of those that began more than a period late, and of those in which not every motor
        #: replied in time.
        self.cycles = self.late = self.incomplete = 0
        #: Count of exceptions in the controller's `take`, and the last one.
        self.cycle_errors, self.cycle_error = 0, ""
        #: The exception that ended the control, if any.
        self.failure: BaseException | None = None
        #: What else a start waits for, apart from the motors' boards: set from outside, false if there is nothing.
        self.setup_error = NO_REASON
        #: s, of the owner's last sign of life; inf if it gives none. One that stands still could not let the arm down.
        self.attended = math.inf
        #: Its counts may be read, and it may be used within a `call`.
        self.bus = bus
        self._clock = bus.clock
        self._now = bus.clock.monotonic
        self.controller = controller
        self._hand_over = hand_over
        self.safety.probe(self._now())
        self._due = self._now()  # of the next cycle
        self._errors = 0  # in a row
        self._command = Command.off(len(bus.samples))  # last decided
        self._foreign_commands = 0  # so far
        self._suspended = bus.clock.suspended()  # s, so far
        self._work = period  # s per cycle, without waiting for efforts; smoothed
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        self._is_stopping = self._has_ended = False
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def cycle(self) -> bool:
        """Run one cycle, and wait until the next one is due; return False once the loop has ended."""
        if self._has_ended:
            return False
        try:
            if not (self._is_stopping and self.is_off):
                try:
                    self._control(self._due)
                    self._errors = 0
                except Exception as error:
                    self._errors += 1
                    if self._errors == MAX_ERRORS:
                        raise
                    self.safety.trip(FaultCode.INTERNAL_ERROR, f"{type(error).__name__}: {error}", self._now())
                self._due = self._wait(self._due + self.period)
                return True
        except BaseException as error:  # whatever happened, the arm must come down
            self.failure = error
            if self._command.powered:  # the watchdog ends this process; without one, the arm is lowered here
                with contextlib.suppress(Exception):
                    if self._hand_over(f"the control loop failed: {type(error).__name__}: {error}"):
                        self._clock.sleep(HAND_OVER_TIME)
                lower(self.bus, self._command, self.period)
        self.bus.stop()
        self._has_ended = True
        return False

    def call(self, function: Callable[[], Any]) -> Future[Any]:
        """Run `function` between two cycles; the future has its result. If it is cancelled before, it never runs."""
        future: Future[Any] = Future()
        self._calls.put((function, future))
        return future

    @property
    def samples(self) -> Sequence[JointSample]:
        """The newest reading of each joint."""
        return tuple(self.bus.samples)

    @property
    def is_off(self) -> bool:
        """Whether the arm is down and its motors have confirmed that they are off."""
        return self.safety.is_off

    def trip(self, code: FaultCode, reason: str) -> None:
        """Let the arm down for a fault detected outside the loop."""
        self.call(lambda: self.safety.trip(code, reason, self._now()))

    def stop(self, timeout: float | None = None) -> bool:
        """Let the arm down, send the last frames, close the bus; return whether that was done within `timeout` s.

        The thread keeps trying to reach a motor that does not reply, because it may still be on. Without a thread, the
        remaining cycles run here, whatever `timeout` is.
        """
        self._is_stopping = True
        if self._thread.ident is None:
            self._run()
        else:
            self._thread.join(timeout)
            if self._thread.is_alive():
                return False
        while not self._calls.empty():
            self._calls.get()[1].cancel()
        return True

    def _run(self) -> None:
        self._due = self._now()
        while self.cycle():
            pass

    def _control(self, due: float) -> None:
        # While another sender commands the motors, receiving comes first.
        latest = due if self.bus.is_contested else due + EFFORT_WAIT * (self.period - self._work)
        try:
            efforts = self.controller.efforts(latest)
        except Exception as error:
            reason = f"efforts cannot be received: {type(error).__name__}: {error}"
            self.safety.trip(FaultCode.INTERNAL_ERROR, reason, self._now())
            efforts = NO_EFFORTS
        while not self._calls.empty():  # only this thread takes from it
            function, future = self._calls.get()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)
        now = self._now()
        if (suspended := self._clock.suspended() - self._suspended) > SUSPENDED:
            self._suspended += suspended
            self.safety.watch.require_sign_check()  # the motors may have lost their power meanwhile
            self.safety.trip(FaultCode.MOTOR_SILENT, f"the computer was suspended for {suspended:.0f} s", now)
        if now - self.attended > LONGEST_ABSENCE and self.safety.state in CARRYING:
            reason = f"no service and no timer of the node has run for {LONGEST_ABSENCE:g} s"
            self.safety.trip(FaultCode.INTERNAL_ERROR, reason, now)
        if self._is_stopping:
            self.safety.disable(now)
        if self.safety.state is State.CHECKING:
            boards = self.bus.boards.setup_error(now, 1.0 / self.period)
            self.safety.setup_error = self.setup_error or (Status(Wait.BOARD_SETUP, boards) if boards else NO_REASON)
        command = self._command = self.safety.step(now, tuple(self.bus.samples), efforts)
        try:
            complete = self.bus.exchange(command, now + REPLY_SHARE * self.period)
        except BusError as error:
            self.safety.trip(FaultCode.BUS_ERROR, str(error), now)
            complete = False
        self.safety.unsent, self.safety.held_back = self.bus.unsent, self.bus.held_back
        if (late := self.bus.late_replies) and self.safety.state in CARRYING:
            self.safety.trip(FaultCode.REPLIES_LATE, late, self._now())
        if self.bus.foreign_commands > self._foreign_commands:
            self._foreign_commands = self.bus.foreign_commands
            self.safety.trip(FaultCode.FOREIGN_COMMAND, self.bus.foreign_command, self._now())
        self.cycles += 1
        self.incomplete += not complete
        try:
            self.controller.take(self._now(), self.bus.samples)
        except Exception as error:
            self.cycle_errors += 1
            self.cycle_error = f"{type(error).__name__}: {error}"
        self._work += WORK_SMOOTHING * (self._now() - now - self._work)

    def _wait(self, deadline: float) -> float:
        """Wait until `deadline`; return it, or the present time if that is more than a period late.

        While another sender commands the motors, this receives instead, to answer each foreign command at once.
        """
        if self.bus.is_contested:
            with contextlib.suppress(BusError):
                self.bus.receive_until(deadline)
        remaining = deadline - self._now()
        if remaining > 0.0:
            self._clock.sleep(remaining)
        elif remaining < -self.period:
            self.late += 1
            return self._now()
        return deadline


def lower(bus: MotorBus, command: Command, period: float) -> None:
    """Lower an arm whose motors receive `command`, without the state machine; return once each has replied to EXIT.

    The torque fades slowly under full damping, also of a motor that does not reply: it may obey. The damping stays
    until the joints have been at rest for a while: a joint under damping creeps, and would fall if it were switched off
    before it hangs. No motor is switched on. No exception ends this.
    """
    clock, start, exits = bus.clock, bus.clock.monotonic(), 0
    rest = RestTracker(len(bus.samples))
    confirmed = [False] * len(command.effort)
    while not all(confirmed):
        now, joints = clock.monotonic(), tuple(bus.samples)
        silent = [now - joint.time > LOWERING.reply_timeout for joint in joints]
        rest.step(now, joints, silent)
        left = max(0.0, 1.0 - (now - start) / LOWERING.fade)
        is_down = exits or command.is_unproven or (not left and not any(silent) and now - rest.since >= LOWERING.rest)
        if is_down:
            exits += 1
            send = (Send.EXIT,) * len(joints)
        else:
            send = tuple(
                [Send.COMMAND if bus.replies[i] or not silent[i] else Send.NOTHING for i in range(len(joints))]
            )
        effort = tuple([left * torque for torque in command.effort])
        with contextlib.suppress(Exception):
            bus.exchange(Command(effort, (DAMPING,) * len(effort), send, True), now + period)
        if exits > 1:  # a reply after the second EXIT is none to the command before the first
            samples = zip(confirmed, bus.samples, strict=True)
            confirmed = [was or sample.time >= now for was, sample in samples]
        clock.sleep(max(0.0, now + period - clock.monotonic()))
    with contextlib.suppress(Exception):
        bus.exchange(Command.off(len(effort)), clock.monotonic() + period)
