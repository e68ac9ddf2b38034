"""The AK motors of one arm on one python-can bus, in MIT mode: command all, collect the replies until a deadline.

The wire formats of the boards (core/wire_formats) may differ. A motor of V1 and V2 boards replies only when commanded,
200-400 us later. A V3 board sends status frames on its own timer: the first one after a command counts as its reply.
Frames of other devices are ignored and counted by kind.

A motor obeys every sender. A command to one of our motors that we did not send is answered at once with our own.

A zero command precedes the frames that switch a V1 or V2 board on or off: the motor remembers its last command, and
ENTER would carry it out. A command switches a V3 board on, so it gets none while the arm is off.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import chain

import can

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.wire_formats import REPLY, Frame
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import OFF, Drive
from exo_gravity.core.safety.limits import UNKNOWN, JointSample
from exo_gravity.hardware.can.can_port import CanPort, open_bus
from exo_gravity.hardware.can.frame_filter import FOREIGN_COMMAND, FrameFilter

__all__ = ["MotorBus", "open_bus"]

MAX_STALE_FRAMES = 256  # frames read before each cycle: the capacity of udp_multicast, more than any cycle produces
EXIT_PERIOD = 0.5  # s between two EXIT frames to motors that are off, in case one was lost,
UNCONFIRMED_EXIT_PERIOD = 0.02  # s, and to motors that have not replied since the first EXIT
OFF_EFFORT = 0.2  # Nm that a V3 board may report when it is off: it reports unasked, so a frame alone proves nothing
LAST_REPLIES = 0.02  # s for which replies to the last frames are awaited
LISTEN_TIME = 0.12  # s before the first frame
SETTLING_TIME = 0.02  # s of it in which late replies to the previous owner may still arrive
CORRECTION_PERIOD = 0.001  # s between two corrections of a motor: two correcting hosts must not fill the bus
CONTEST_TIME = 0.5  # s after a foreign command in which another one is expected


class MotorBus:
    """Four motors on one bus. Not thread-safe: one thread owns it.

    powered: whether the motors are already on. note: called with each drive before its frames are sent. reopen: opens
    the bus again after a failure.
    samples: the newest JointSample of each joint, UNKNOWN before the first reply; times are `time.monotonic`.
    ignored: count of frames that were not replies of these motors, by kind.
    foreign_commands: count of commands to these motors from another sender; foreign_command describes the last one.
    """

    def __init__(
        self,
        bus: can.BusABC,
        motors: Sequence[JointMotor],
        powered: bool = False,
        note: Callable[[Drive], None] = lambda drive: None,
        reopen: Callable[[], can.BusABC] | None = None,
    ) -> None:
        ids = [motor.can_id for motor in motors]
        if len(motors) != JOINT_COUNT or len(set(ids)) != JOINT_COUNT:
            raise ParameterError("can_id", ids, "4 different IDs")
        self.samples: list[JointSample] = [UNKNOWN] * JOINT_COUNT
        self.ignored: Counter[str] = Counter()
        self.foreign_commands = 0
        self.foreign_command = ""
        self._port = CanPort(bus, reopen)
        self._filter = FrameFilter(motors, self._port.marks_echoes)
        self._motors = tuple(motors)
        self._asked = frozenset(joint for joint, motor in enumerate(motors) if motor.wire_format.replies)
        self._joint_of = {motor.can_id: joint for joint, motor in enumerate(motors)}
        self._powered = powered
        self._unconfirmed = set(range(JOINT_COUNT)) if powered else set()  # not known to be off
        self._ids = tuple(motor.command_id for motor in motors)
        self._commands: list[Frame | None] = [None] * JOINT_COUNT  # last sent
        self._corrected = [-math.inf] * JOINT_COUNT  # s
        self._foreign_time = -math.inf
        self._note = note
        self._exit_sent = -math.inf
        self._is_confirming = False  # replies now follow an EXIT
        self._answered: set[int] = set()

    @property
    def may_be_powered(self) -> bool:
        """Whether a motor may be on: it was switched on, and has not replied since it was sent EXIT."""
        return self._powered or bool(self._unconfirmed)

    @property
    def is_contested(self) -> bool:
        """Whether another sender commands these motors."""
        return time.monotonic() - self._foreign_time < CONTEST_TIME

    def listen(self) -> None:
        """Listen before the first frame. Raises BusError if another host commands these motors."""
        end = time.monotonic() + LISTEN_TIME
        self.receive_until(end - LISTEN_TIME + SETTLING_TIME)
        self._answered.clear()
        self.foreign_commands = 0
        self.receive_until(end)
        replies = self._answered & self._asked
        if self.foreign_commands or replies:
            heard = self.foreign_command or f"motor {self._motors[min(replies)].can_id} replies to another host"
            raise BusError(f"CAN bus {self._port.name} is in use: {heard}; stop the other commander first")

    def exchange(self, drive: Drive, deadline: float) -> bool:
        """Send every motor its part of `drive`, then collect replies until all arrived or `deadline` (monotonic s).

        Switches the motors on or off when `drive.powered` changes. Returns whether all motors replied in time. Raises
        BusError if the bus fails.
        """
        self._note(drive._replace(powered=drive.powered or self.may_be_powered))
        self._is_confirming = not self._powered and self._exit_sent > -math.inf
        self._drain()
        if drive.powered:
            self._switch_on()
        self._send_commands(drive)
        if not drive.powered:
            self._switch_off()
        self._answered.clear()
        while len(self._answered) < JOINT_COUNT:
            remaining = deadline - time.monotonic()
            message = self._port.receive(max(0.0, remaining))
            if message is not None:
                self._take(message)
            if remaining <= 0.0:
                break
        self._port.confirm()
        return len(self._answered) == JOINT_COUNT

    def receive_until(self, deadline: float, is_done: Callable[[], bool] = lambda: False) -> None:
        """Receive until `deadline` (monotonic s) or `is_done()`, and answer foreign commands. Raises BusError."""
        while not is_done() and (remaining := deadline - time.monotonic()) > 0.0:
            message = self._port.receive(remaining)
            if message is not None:
                self._take(message)

    def set_zero(self) -> None:
        """Make the present pose every motor's zero; only while they are off. They are silent for up to 1.5 s."""
        if self._powered:
            raise BusError("set_zero: refused while the motors are on")
        frames = [motor.wire_format.set_zero(motor.can_id) for motor in self._motors]
        if not all(frames):
            raise BusError(f"set_zero: motor {self._motors[frames.index(())].can_id} has a board without such a frame")
        self._send_commands(OFF)
        self._send_each(frames)

    def stop(self) -> bool:
        """Send the last frames, a zero command and EXIT, twice; then close the bus. Never raises.

        Returns whether the motors are off, as far as their replies show. If not, they stay noted as powered.
        """
        for _ in range(2):
            self._is_confirming = True
            for joint, motor in enumerate(self._motors):
                for frame in (*self._zero_command(joint), *motor.exit):
                    try:
                        self._send(frame)
                    except BusError:
                        self.ignored["unsent"] += 1
            self._powered, self._exit_sent = False, time.monotonic()
            end = self._exit_sent + LAST_REPLIES
            with contextlib.suppress(BusError):
                self.receive_until(end, lambda: not self._unconfirmed)
        if not self._unconfirmed:
            self._note(OFF)
        self._port.close()
        return not self._unconfirmed

    def close(self) -> None:
        """Close the bus without any frame. Never raises."""
        self._port.close()

    def _switch_on(self) -> None:
        if not self._powered:
            self._powered, self._exit_sent = True, -math.inf
            self._unconfirmed = set(range(JOINT_COUNT))
            self._send_commands(OFF)
            self._send_each([motor.enter for motor in self._motors])

    def _switch_off(self) -> None:
        period = UNCONFIRMED_EXIT_PERIOD if self._unconfirmed else EXIT_PERIOD
        if self._powered or time.monotonic() - self._exit_sent > period:
            for joint, motor in enumerate(self._motors):
                zero = () if joint in self._asked else self._zero_command(joint)
                self._send_each((zero, motor.exit))
            self._exit_sent = time.monotonic()
        self._powered = False

    def _zero_command(self, joint: int) -> tuple[Frame, ...]:
        """Return a command without torque and gains; none for a V3 board that is off, which it would switch on."""
        if joint not in self._asked and joint not in self._unconfirmed and self._exit_sent > -math.inf:
            return ()
        return ((self._ids[joint], self._motors[joint].command(0.0, 0.0)),)

    def _send_commands(self, drive: Drive) -> None:
        for joint, motor in enumerate(self._motors):
            if not drive.powered and joint not in self._asked:
                continue
            command = self._commands[joint] = self._ids[joint], motor.command(drive.effort[joint], drive.damping[joint])
            if drive.enter[joint]:
                self._send_each([(command, *motor.enter)])
            self._send(command)

    def _send_each(self, frames: Iterable[Sequence[Frame]]) -> None:
        for frame in chain.from_iterable(frames):
            self._send(frame)

    def _send(self, frame: Frame) -> None:
        self._filter.sent(frame)
        self._port.send(frame)

    def _drain(self) -> None:
        """Read replies that arrived after their cycle, so that they do not count for this one."""
        for _ in range(MAX_STALE_FRAMES):
            message = self._port.waiting()
            if message is None:
                return
            self._take(message)

    def _take(self, message: can.Message) -> None:
        kind, can_id = self._filter.sort(message)
        if kind != REPLY:
            self.ignored[kind] += 1
            if kind == FOREIGN_COMMAND:
                self._oppose(self._joint_of[can_id], bytes(message.data))
            return
        joint = self._joint_of[can_id]
        reply = self._motors[joint].joint_reply(message.data)
        self._answered.add(joint)
        if self._is_confirming and (joint in self._asked or abs(reply.torque) < OFF_EFFORT):
            self._unconfirmed.discard(joint)
        self.samples[joint] = JointSample(*reply[1:], time.monotonic())

    def _oppose(self, joint: int, foreign: bytes) -> None:
        """Send our last command again after a foreign one, so that the motor obeys it for less than a millisecond."""
        now = time.monotonic()
        motor, command = self._motors[joint], self._commands[joint]
        self.foreign_commands += 1
        self._foreign_time = now
        self.foreign_command = f"another sender commands motor {motor.can_id} (frame [{foreign.hex(' ')}])"
        if not self._powered or command is None:
            return
        is_exit = foreign in [data for _, data in motor.exit]
        if is_exit or now - self._corrected[joint] >= CORRECTION_PERIOD:
            self._send_each([(command, *motor.enter) if is_exit else (), (command,)])
            self._corrected[joint] = now
