# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The motors of one arm, in MIT mode: command all, collect the replies until a deadline.

They are on one python-can bus or on several. All buses are sent their commands before the replies of all are awaited.
One that fails does not keep the others from theirs.

Families and wire formats of the motors (core/motors) may differ. Most motors reply only when commanded, 200-400 us
later. A V3 board of an AK motor sends status frames on its own timer: the first one after a command is its reply.
Frames of other devices are ignored and counted by kind.

A motor obeys every sender. A command to one of our motors that we did not send is answered at once with our own, under
full damping: until then the other sender's torque acts, and no damping. What it moves the joint in between must not add
up, so for a while all our commands to that motor also hold the joint.

What a motor is sent is the safety machine's decision (core/safety/watch.py): this only carries it out. A motor gets one
frame a cycle, whose reply is awaited: its reply has the ID of the command, and would collide with a second one. Motors
whose replies have an ID of their own may get more. While such a motor is off, its board is also asked for its settings
(core/motors/boards.py).
"""

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Sequence

import can

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.boards import Boards
from exo_gravity.core.motors.frames import (
    ALIAS,
    BROADCAST_ID,
    COMMAND,
    ELSEWHERE,
    EXTENDED,
    MALFORMED,
    OTHER,
    REPLY,
    SERVO,
    SETTING,
    Frame,
    WireFormat,
)
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointMotor, JointSample
from exo_gravity.core.numbers import rate_limited
from exo_gravity.core.safety.command import Command, Send
from exo_gravity.core.safety.limits import DAMPING, EQUIPMENT
from exo_gravity.hardware.can_port import CanPort, awaited
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.request_age import Requests

LISTEN_TIME = 0.12  # s before the first frame
CORRECTION_PERIOD = 0.001  # s between two corrections of a motor: two correcting hosts must not fill the bus
CONTEST_TIME = 0.5  # s after a foreign command in which another one is expected; the hold fades meanwhile
HOLD_STIFFNESS = 60.0  # Nm/rad by which a contested motor holds its joint: the motor applies it without our delay,
HOLD_REACH = 0.15  # rad at most from where the joint is,
HOLD_SPEED = 0.3  # rad/s with which the held position follows the joint,
WARMING = 1.0  # K/s by which the torque follows a motor's temperature at most: no reading makes it step
HOLD_STEP = 0.01  # s of this motion at most for each reply: after a stall of the loop the torque must not step
FOREIGN_COMMAND = "foreign command"
AT_REST = JointSample(0.0, 0.0, 0.0, None, None, -math.inf)  # a joint whose bus is not open


class MotorBus:
    """The motors of one arm, with different IDs. Not thread-safe: one thread owns it.

    ports: of the bus of each motor (n,), None if it is not open: such a joint counts as at rest, without torque, and is
        sent nothing.
    note: called with each command before its frames are sent.
    clock: of all times.

    Raises ParameterError if there are not as many ports as motors, as with a python-can bus in their place.
    """

    def __init__(
        self,
        ports: Sequence[CanPort | None],
        motors: Sequence[JointMotor],
        note: Callable[[Command], None] = lambda command: None,
        clock: Clock = COMPUTER_CLOCK,
    ) -> None:
        count = len(motors)
        if not isinstance(ports, Sequence) or len(ports) != count:
            raise ParameterError("ports", ports, f"the port or None for each of {count} motors")
        #: The newest reading of each joint, UNKNOWN before the first reply.
        self.samples: list[JointSample] = [UNKNOWN] * count
        self.ignored: Counter[str] = Counter()  #: count of frames that were not replies of these motors, by kind
        self.foreign_commands = 0  #: count of commands to these motors from another sender
        self.foreign_command = ""  #: the last of them, in words
        self.boards = Boards(motors)  #: what keeps them from serving this arm
        self.clock = clock
        self._now = clock.monotonic
        self._ports = tuple(ports)
        self._buses = list(dict.fromkeys(port for port in ports if port))
        self._failed: dict[CanPort, BusError] = {}  # in this cycle
        self.motors = tuple(motors)  #: (n,)
        self._joints = frozenset(joint for joint, port in enumerate(self._ports) if port)  # on these buses
        # The ID of each motor's replies by its own ID, on each bus, for each wire format.
        self._ids: dict[CanPort | None, dict[WireFormat, dict[int, int]]] = {}
        for port, motor in zip(self._ports, motors, strict=True):
            self._ids.setdefault(port, {}).setdefault(motor.wire_format, {})[motor.can_id] = motor.reply_id
        self.replies = tuple([motor.wire_format.replies for motor in motors])  #: whether each (n,) replies to commands
        self._asked = frozenset(joint for joint in self._joints if self.replies[joint])
        self._joint_of = {motor.can_id: joint for joint, motor in enumerate(motors)}
        self._aliased: set[int] = set()  # IDs of motors whose board obeys other IDs, too
        #: Whether the last command did not leave for each motor (n,), because its bus failed.
        self.unsent: Sequence[bool] = (False,) * len(motors)
        #: Whether each motor (n,) was sent nothing in the last cycle, to learn how old its replies are.
        self.held_back: Sequence[bool] = (False,) * len(motors)
        self._command = Command.off(count)  # last sent
        self._has_sent = False  # anything: another owner's motors are left alone
        self._corrected = [-math.inf] * count  # s
        self._contested = [-math.inf] * count  # s of the last foreign command to the motor
        self._held = [math.nan] * count  # rad
        self._warmth: list[float | None] = [None] * count  # degC, of motors whose torque depends on it
        self._note = note
        self._answered: set[int] = set()
        self._requests = [Requests() for _ in motors]

    @property
    def late_replies(self) -> str:
        """Which motor answers commands that are too old, as a sentence; '' if none does."""
        for motor, requests in zip(self.motors, self._requests, strict=True):
            if requests.late:
                return f"motor {motor.can_id} answers commands that are {1000.0 * requests.late:.0f} ms old or older"
        return ""

    @property
    def is_contested(self) -> bool:
        """Whether another sender commands these motors."""
        return self._now() - max(self._contested) < CONTEST_TIME

    def listen(self) -> None:
        """Listen before the first frame. Raises BusError if another host commands these motors."""
        self._failed.clear()
        end = self._now() + LISTEN_TIME
        self.receive_until(end - LISTEN_TIME + EQUIPMENT.late)
        self._answered.clear()
        self.foreign_commands = 0
        self.receive_until(end)
        self._raise_failure()
        replies = self._answered & self._asked
        if self.foreign_commands or replies:
            heard = self.foreign_command or f"motor {self.motors[min(replies)].can_id} replies to another host"
            raise BusError(
                f"CAN bus {' or '.join(port.name for port in self._buses)} is in use: {heard}; "
                "stop the other commander first"
            )

    def exchange(self, command: Command, deadline: float) -> bool:
        """Send every motor its part of `command`, then collect replies until all arrived or `deadline` (s).

        Returns whether all motors replied in time. Raises BusError if a bus fails, once the others have had their part.
        """
        self._failed.clear()
        self._note(command)
        for port in self._buses:  # replies that arrived after their cycle are not replies to this one
            try:
                for message in port.waiting():
                    self._take(port, message)
            except BusError as error:
                self._failed[port] = error
        self._command, self._has_sent = command, True
        now = self._now()
        frames: dict[CanPort | None, list[Frame]] = {port: [] for port in self._ports}
        held_back = [False] * len(self._ports)
        for joint, own in enumerate(self._ports):
            due = self._frames(joint, now)
            if due and self.replies[joint]:
                is_paused = not self._requests[joint].may_send(now, deadline - now)
                held_back[joint] = is_paused and command.send[joint] in (Send.COMMAND, Send.POLL)
                if held_back[joint]:
                    continue
                self._requests[joint].sent(now, len(due))
            frames[own] += due
            if command.send[joint] is Send.POLL:
                frames[own] += self.boards.question(joint, now)
        for own, all_due in frames.items():
            self._send(own, *all_due, may_be_lost=True)
        self.unsent = tuple([port in self._failed for port in self._ports])
        self.held_back = tuple(held_back)
        self._answered.clear()
        count = len(self._joints)
        self.receive_until(deadline, lambda: len(self._answered) == count)
        for port in self._buses:
            if port not in self._failed:
                port.confirm()
        if count < len(self.samples):
            missing = AT_REST._replace(time=max(self.samples[joint].time for joint in self._joints))
            self.samples[:] = (self.samples[i] if i in self._joints else missing for i in range(len(self.samples)))
        if self._failed:
            self._raise_failure()
        return len(self._answered) == count

    def receive_until(self, deadline: float, is_done: Callable[[], bool] = lambda: False) -> None:
        """Receive until `deadline` (s) or `is_done()`, and answer foreign commands. Raises BusError if all fail."""
        while not is_done() and (remaining := deadline - self._now()) > 0.0:
            if not (working := [port for port in self._buses if port not in self._failed]):
                self._raise_failure()
            ports, timeout = awaited(working, remaining)
            for port in ports:
                try:
                    if message := port.receive(timeout):
                        self._take(port, message)
                except BusError as error:
                    self._failed[port] = error

    def stop(self) -> None:
        """Send EXIT, twice, to the motors that were to be off; then close the bus. Never raises.

        Nothing is sent to others: another owner may have left them on.
        """
        off = (Send.POLL, Send.EXIT, Send.CLEAR_ERROR)
        left = [joint for joint, send in enumerate(self._command.send) if self._has_sent and send in off]
        for _ in range(2 if left else 0):
            self._failed.clear()
            self._answered.clear()
            for joint in left:
                self._send(self._ports[joint], *self.motors[joint].exit)
            with contextlib.suppress(BusError):
                self.receive_until(
                    self._now() + EQUIPMENT.late, lambda: self._answered >= self._asked.intersection(left)
                )
        self.close()

    def close(self) -> None:
        """Close the buses without any frame. Never raises."""
        for port in self._buses:
            port.close()

    def _send(self, port: CanPort | None, *frames: Frame, may_be_lost: bool = False) -> None:
        """Send frames on a bus, unless it is not open or has failed in this cycle."""
        if port and port not in self._failed:
            try:
                port.send(*frames, may_be_lost=may_be_lost)
            except BusError as error:
                self._failed[port] = error

    def _raise_failure(self) -> None:
        for error in self._failed.values():
            raise error

    def _frames(self, joint: int, now: float) -> tuple[Frame, ...]:
        """Return what a motor is sent of the present command."""
        send, motor = self._command.send[joint], self.motors[joint]
        if send is Send.COMMAND:
            return (self._command_frame(joint, now),)
        if send is Send.POLL:
            return (motor.idle,) if self.replies[joint] else ()
        if send is Send.EXIT:
            return motor.exit
        if send is Send.ENTER:
            return motor.enter
        if send is Send.CLEAR_ERROR:
            return motor.clear_error or ((motor.idle,) if self.replies[joint] else ())
        return (*motor.enter, motor.idle) if send is Send.CLEAR else ()

    def _sort(self, port: CanPort, message: can.Message) -> tuple[str, int]:
        """Return the kind of a frame, and the ID of its motor: BROADCAST_ID for all V3 boards of a bus, 0 for none."""
        if message.is_error_frame:
            return "error frame", 0
        if message.is_fd and not port.is_fd:
            return "FD frame", 0
        frame_id = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
        found = "foreign frame", 0
        for board, reply_ids in self._ids[port].items():
            kind, can_id = board.classify(frame_id, message.data, reply_ids, message.is_remote_frame)
            if kind in (COMMAND, ALIAS):
                if port.is_echo(message):
                    return "echo", 0
                is_obeyed = kind == COMMAND or can_id in self._aliased
                return (FOREIGN_COMMAND, can_id) if is_obeyed else ("foreign frame", 0)
            if kind == ELSEWHERE:  # unless it is the reply of another format's motor
                found = kind, can_id
            elif kind != OTHER:
                return kind, can_id
        return found

    def _take(self, port: CanPort, message: can.Message) -> None:
        kind, can_id = self._sort(port, message)
        if kind == SETTING:
            self.boards.told(self._joint_of[can_id], bytes(message.data), self._now())
            return
        if kind != REPLY:
            self.ignored[kind] += 1
            if kind == FOREIGN_COMMAND:
                v3 = [joint for joint, own in enumerate(self._ports) if own is port and not self.replies[joint]]
                for joint in v3 if can_id == BROADCAST_ID else [self._joint_of[can_id]]:
                    self._oppose(joint, bytes(message.data))
            elif kind in (MALFORMED, SERVO, ELSEWHERE):
                frame = message.arbitration_id, bytes(message.data)
                self.boards.heard(self._joint_of[can_id], kind, frame, self._now())
            return
        joint, now = self._joint_of[can_id], self._now()
        if len(message.data) == self.motors[joint].wire_format.alias_length:
            self._aliased.add(can_id)
        asked = self._requests[joint].replied(now) if self.replies[joint] else now
        sample = self.motors[joint].sample(message.data, asked)
        self.boards.take(joint, sample)
        if self.motors[joint].scale_slope and sample.temperature is not None:
            self._follow_temperature(joint, sample)
        self._answered.add(joint)
        if sample.time - self._contested[joint] < CONTEST_TIME:
            self._follow(joint, sample)
        else:
            self._held[joint] = sample.position
        self.samples[joint] = sample

    def _follow_temperature(self, joint: int, sample: JointSample) -> None:
        """Let the temperature that a motor's commands count with follow its reading, without a step."""
        last, most = self._warmth[joint], WARMING * max(0.0, sample.time - self.samples[joint].time)
        reading = float(sample.temperature or 0.0)
        self._warmth[joint] = reading if last is None else rate_limited(reading, last, most)

    def _follow(self, joint: int, sample: JointSample) -> None:
        """Let the held position of a contested joint follow it slowly, or at once if its motor does not hold it."""
        position = sample.position
        if self._hold(joint, sample.time):
            away = position - self._held[joint]
            passed = min(HOLD_STEP, sample.time - self.samples[joint].time)
            step = max(HOLD_SPEED * passed, abs(away) - HOLD_REACH)
            position = self._held[joint] + math.copysign(min(step, abs(away)), away)
        self._held[joint] = position

    def _hold(self, joint: int, now: float) -> float:
        """Return the share of its stiffness by which a contested motor holds its joint; it fades, without a step."""
        return max(0.0, 1.0 - (now - self._contested[joint]) / CONTEST_TIME) if self._command.powered else 0.0

    def _command_frame(self, joint: int, now: float) -> Frame:
        """Return the frame of the last command to a motor. If the motor is contested, it also holds the joint."""
        motor, effort, damping = self.motors[joint], self._command.effort[joint], self._command.damping[joint]
        if now - self._contested[joint] < CONTEST_TIME and (hold := self._hold(joint, now)):
            damping = max(DAMPING, damping)
            if not math.isnan(self._held[joint]):
                data = motor.command(effort, damping, hold * HOLD_STIFFNESS, self._held[joint], self._warmth[joint])
                if data[0] not in self._joint_of:  # or its echo would look like a reply
                    return motor.command_id, data
        return motor.command_id, motor.command(effort, damping, temperature=self._warmth[joint])

    def _oppose(self, joint: int, foreign: bytes) -> None:
        """Answer a foreign command with our last one, under the motor's full damping; hold the joint meanwhile."""
        now = self._now()
        motor = self.motors[joint]
        self.foreign_commands += 1
        self._contested[joint] = now
        self.foreign_command = f"another sender commands motor {motor.can_id} (frame [{foreign.hex(' ')}])"
        if self._command.send[joint] not in (Send.COMMAND, Send.ENTER):
            return
        if foreign in [data for _, data in motor.set_zero]:
            self._held[joint] = math.nan  # not held in this contest: a reply may still count from the old zero
        command = self._command_frame(joint, now)
        is_exit = foreign in motor.wire_format.stops
        if is_exit or now - self._corrected[joint] >= CORRECTION_PERIOD:
            self._send(self._ports[joint], *(motor.enter if is_exit else ()), command)
            self._corrected[joint] = now
