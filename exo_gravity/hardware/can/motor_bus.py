"""The AK motors of one arm, in MIT mode: command all, collect the replies until a deadline.

They are on one python-can bus or on several. All buses are sent their commands before the replies of all are awaited.
One that fails does not keep the others from theirs.

The wire formats of the boards (core/wire_formats) may differ. A motor of V1 and V2 boards replies only when commanded,
200-400 us later. A V3 board sends status frames on its own timer: the first one after a command is its reply.
Frames of other devices are ignored and counted by kind.

A motor obeys every sender. A command to one of our motors that we did not send is answered at once with our own, under
full damping: until then the other sender's torque acts, and no damping. What it moves the joint in between must not add
up, so for a while all our commands to that motor also hold the joint.

A zero command precedes the frames that switch a V1 or V2 board on or off: the motor remembers its last command, and
ENTER would carry it out. A command switches a V3 board on, so it gets none while the arm is off.

A motor that is `unsure` in a drive may have restarted or kept its power. A V1 or V2 board gets its command, which holds
it if it is on, and is ignored if it is off, but no ENTER. A V3 board gets nothing: its status frames come unasked.
"""

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Sequence

import can

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointMotor, JointSample
from exo_gravity.core.motors.wire_formats import COMMAND, EXTENDED, REPLY, Frame, WireFormat
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.core.safety.drive import OFF, Drive
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.hardware.can.can_port import CanPort, awaited
from exo_gravity.hardware.can.request_age import Requests
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock

EXIT_PERIOD = 0.5  # s between two EXIT frames to motors that are off, in case one was lost,
UNCONFIRMED_EXIT_PERIOD = 0.02  # s, and to motors that have not replied since the first EXIT
OFF_EFFORT = 0.2  # Nm that a V3 board may report when it is off: it reports unasked, so a frame alone proves nothing
LAST_REPLIES = 0.02  # s for which replies to the last frames are awaited
LISTEN_TIME = 0.12  # s before the first frame
LATE_REPLIES = 0.02  # s of it in which replies to the previous owner may still arrive
CORRECTION_PERIOD = 0.001  # s between two corrections of a motor: two correcting hosts must not fill the bus
CONTEST_TIME = 0.5  # s after a foreign command in which another one is expected; the hold fades meanwhile
HOLD_STIFFNESS = 60.0  # Nm/rad by which a contested motor holds its joint: the motor applies it without our delay,
HOLD_REACH = 0.15  # rad at most from where the joint is,
HOLD_SPEED = 0.3  # rad/s with which the held position follows the joint
FOREIGN_COMMAND = "foreign command"
AT_REST = JointSample(0.0, 0.0, 0.0, None, None, -math.inf)  # a joint whose bus is not open


class MotorBus:
    """The motors of one arm, with different IDs. Not thread-safe: one thread owns it.

    bus: of all motors; or the port of each (4,), None if it is not open: such a joint counts as at rest, without
        torque, and is sent nothing.
    powered: whether the motors are already on.
    note: called with each drive, and whether a motor may be on, before its frames are sent.
    reopen: opens `bus` again after a failure.
    clock: of all times.
    """

    def __init__(
        self,
        bus: can.BusABC | Sequence[CanPort | None],
        motors: Sequence[JointMotor],
        powered: bool = False,
        note: Callable[[Drive, bool], None] = lambda drive, powered: None,
        reopen: Callable[[], can.BusABC] | None = None,
        clock: Clock = COMPUTER_CLOCK,
    ) -> None:
        #: The newest reading of each joint, UNKNOWN before the first reply.
        self.samples: list[JointSample] = [UNKNOWN] * JOINT_COUNT
        self.ignored: Counter[str] = Counter()  #: count of frames that were not replies of these motors, by kind
        self.foreign_commands = 0  #: count of commands to these motors from another sender
        self.foreign_command = ""  #: the last of them, in words
        self.clock = clock
        self._now = clock.monotonic
        self._ports = [CanPort(bus, clock, reopen)] * JOINT_COUNT if isinstance(bus, can.BusABC) else list(bus)
        self._buses = list(dict.fromkeys(port for port in self._ports if port))
        self._failed: dict[CanPort, BusError] = {}  # in this cycle
        self._motors = tuple(motors)
        self._joints = frozenset(joint for joint, port in enumerate(self._ports) if port)  # on these buses
        ids: dict[tuple[CanPort | None, WireFormat], list[int]] = {}
        for port, motor in zip(self._ports, motors, strict=True):
            ids.setdefault((port, motor.wire_format), []).append(motor.can_id)
        self._ids = [(port, board, frozenset(can_ids)) for (port, board), can_ids in ids.items()]
        self._asked = frozenset(joint for joint in self._joints if motors[joint].wire_format.replies)
        self._joint_of = {motor.can_id: joint for joint, motor in enumerate(motors)}
        self._powered = powered
        self._unsure: Sequence[bool] = (False,) * JOINT_COUNT  # of the last powered drive
        self._unconfirmed = set(self._joints) if powered else set()  # not known to be off
        self._drive = OFF  # last sent
        self._corrected = [-math.inf] * JOINT_COUNT  # s
        self._contested = [-math.inf] * JOINT_COUNT  # s of the last foreign command to the motor
        self._held = [math.nan] * JOINT_COUNT  # rad
        self._note = note
        self._exit_sent = -math.inf
        self._is_confirming = False  # replies now follow an EXIT
        self._answered: set[int] = set()
        self._requests = [Requests() for _ in motors]

    @property
    def late_replies(self) -> str:
        """Which motor answers commands that are too old, as a sentence; '' if none does."""
        for motor, requests in zip(self._motors, self._requests, strict=True):
            if requests.late:
                return f"motor {motor.can_id} answers commands that are {1000.0 * requests.late:.0f} ms old or older"
        return ""

    @property
    def may_be_powered(self) -> bool:
        """Whether a motor may be on: it was switched on or found on, and has not replied since it was sent EXIT."""
        return bool(self._unconfirmed)

    @property
    def is_contested(self) -> bool:
        """Whether another sender commands these motors."""
        return self._now() - max(self._contested) < CONTEST_TIME

    def listen(self) -> None:
        """Listen before the first frame. Raises BusError if another host commands these motors."""
        self._failed.clear()
        end = self._now() + LISTEN_TIME
        self.receive_until(end - LISTEN_TIME + LATE_REPLIES)
        self._answered.clear()
        self.foreign_commands = 0
        self.receive_until(end)
        self._raise_failure()
        replies = self._answered & self._asked
        if self.foreign_commands or replies:
            heard = self.foreign_command or f"motor {self._motors[min(replies)].can_id} replies to another host"
            names = " or ".join(port.name for port in self._buses)
            raise BusError(f"CAN bus {names} is in use: {heard}; stop the other commander first")

    def exchange(self, drive: Drive, deadline: float) -> bool:
        """Send every motor its part of `drive`, then collect replies until all arrived or `deadline` (s).

        Switches the motors on or off when `drive.powered` changes. Returns whether all motors replied in time. Raises
        BusError if a bus fails, once the others have had their part.
        """
        self._failed.clear()
        if drive.powered:
            self._unsure = drive.unsure
            self._unconfirmed.update(joint for joint in self._joints if not drive.unsure[joint])
        self._note(drive, self.may_be_powered)
        self._is_confirming = not self._powered and self._exit_sent > -math.inf
        for port in self._buses:  # replies that arrived after their cycle are not replies to this one
            try:
                for message in port.waiting():
                    self._take(port, message)
            except BusError as error:
                self._failed[port] = error
        if drive.powered and not self._powered:
            self._powered, self._exit_sent = True, -math.inf
            if not any(drive.unsure):
                self._send_commands(OFF, must=True)
                for joint, motor in enumerate(self._motors):
                    self._send(self._ports[joint], *motor.enter)
        self._send_commands(drive)
        if not drive.powered:
            self._switch_off()
        self._answered.clear()
        count = len(self._joints)
        self.receive_until(deadline, lambda: len(self._answered) == count)
        for port in self._buses:
            if port not in self._failed:
                port.confirm()
        if count < JOINT_COUNT:
            missing = AT_REST._replace(time=max(self.samples[joint].time for joint in self._joints))
            self.samples[:] = (self.samples[i] if i in self._joints else missing for i in range(JOINT_COUNT))
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

    def set_zero(self) -> None:
        """Make the present pose every motor's zero; only while they are off. They are silent for up to 1.5 s."""
        if self._powered:
            raise BusError("set_zero: refused while the motors are on")
        frames = [motor.set_zero for motor in self._motors]
        if not all(frames):
            raise BusError(f"set_zero: motor {self._motors[frames.index(())].can_id} has a board without such a frame")
        self._send_commands(OFF, must=True)
        for joint, own in enumerate(frames):
            self._send(self._ports[joint], *own)
        self._raise_failure()

    def stop(self) -> None:
        """Send the last frames, a zero command and EXIT, twice; then close the bus. Never raises.

        Motors whose replies do not show that they are off stay noted as powered. Nothing is sent to motors that were
        never switched on or off: another owner may have left them on.
        """
        for _ in range(2 if self.may_be_powered or self._exit_sent > -math.inf else 0):
            self._is_confirming = True
            for joint, motor in enumerate(self._motors):
                for frame in (*self._zero_command(joint), *motor.exit):
                    self._failed.clear()  # each is tried
                    self._send(self._ports[joint], frame)
            self._failed.clear()
            self._powered, self._exit_sent = False, self._now()
            end = self._exit_sent + LAST_REPLIES
            with contextlib.suppress(BusError):
                self.receive_until(end, lambda: not self._unconfirmed)
        if not self._unconfirmed:
            self._note(OFF, False)
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

    def _switch_off(self) -> None:
        period = UNCONFIRMED_EXIT_PERIOD if self._unconfirmed else EXIT_PERIOD
        if self._powered or self._now() - self._exit_sent > period:
            for joint, motor in enumerate(self._motors):
                zero = () if joint in self._asked else self._zero_command(joint)
                self._send(self._ports[joint], *zero, *motor.exit)
            if self._failed:
                return  # no reply confirms an EXIT that was not sent
            self._exit_sent = self._now()
        self._powered = False

    def _zero_command(self, joint: int) -> tuple[Frame, ...]:
        """Return a command without torque and gains; none for a V3 board that may be off: it would switch it on."""
        if joint not in self._asked and (joint not in self._unconfirmed or self._unsure[joint]):
            return ()
        return ((self._motors[joint].command_id, self._motors[joint].command(0.0, 0.0)),)

    def _send_commands(self, drive: Drive, must: bool = False) -> None:
        """Send each motor its command. Unless they `must` be sent, those whose replies are awaited get none."""
        self._drive = drive
        now = self._now()
        frames: dict[CanPort | None, list[Frame]] = {port: [] for port in self._ports}
        for joint, motor in enumerate(self._motors):
            if joint not in self._asked and (drive.unsure[joint] or not drive.powered):
                continue
            if joint in self._asked:
                if not self._requests[joint].may_send(now) and not (must or drive.enter[joint]):
                    continue
                self._requests[joint].sent(now, 1)
            command = self._command(joint, now)
            frames[self._ports[joint]] += (command, *motor.enter, command) if drive.enter[joint] else (command,)
        for port, own in frames.items():
            self._send(port, *own, may_be_lost=True)

    def _sort(self, port: CanPort, message: can.Message) -> tuple[str, int]:
        """Return REPLY or FOREIGN_COMMAND with the motor's ID, or the kind of a frame that does not matter with 0."""
        if message.is_error_frame:
            return "error frame", 0
        if message.is_remote_frame or message.is_fd:
            return "remote or FD frame", 0
        frame_id = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
        for own, board, can_ids in self._ids:
            if own is not port:
                continue
            kind, can_id = board.classify(frame_id, message.data, can_ids)
            if kind == REPLY:
                return kind, can_id
            if kind == COMMAND:
                return ("echo", 0) if port.is_echo(message) else (FOREIGN_COMMAND, can_id)
        return "foreign frame", 0

    def _take(self, port: CanPort, message: can.Message) -> None:
        kind, can_id = self._sort(port, message)
        if kind != REPLY:
            self.ignored[kind] += 1
            if kind == FOREIGN_COMMAND:
                self._oppose(self._joint_of[can_id], bytes(message.data))
            return
        joint = self._joint_of[can_id]
        now = self._now()
        asked = self._requests[joint].replied(now) if joint in self._asked else now
        sample = self._motors[joint].sample(message.data, asked)
        self._answered.add(joint)
        if self._is_confirming and (joint in self._asked or abs(sample.effort) < OFF_EFFORT):
            self._unconfirmed.discard(joint)
        if sample.time - self._contested[joint] < CONTEST_TIME:
            self._follow(joint, sample)
        else:
            self._held[joint] = sample.position
        self.samples[joint] = sample

    def _follow(self, joint: int, sample: JointSample) -> None:
        """Let the held position of a contested joint follow it slowly, or at once if its motor does not hold it."""
        position = sample.position
        if self._hold(joint, sample.time):
            away = position - self._held[joint]
            step = max(HOLD_SPEED * (sample.time - self.samples[joint].time), abs(away) - HOLD_REACH)
            position = self._held[joint] + math.copysign(min(step, abs(away)), away)
        self._held[joint] = position

    def _hold(self, joint: int, now: float) -> float:
        """Return the share of its stiffness by which a contested motor holds its joint; it fades, without a step."""
        return max(0.0, 1.0 - (now - self._contested[joint]) / CONTEST_TIME) if self._drive.powered else 0.0

    def _command(self, joint: int, now: float) -> Frame:
        """Return the last drive's command to a motor. If the motor is contested, it also holds the joint."""
        motor, effort, damping = self._motors[joint], self._drive.effort[joint], self._drive.damping[joint]
        if now - self._contested[joint] < CONTEST_TIME and (hold := self._hold(joint, now)):
            damping = max(DAMPING, damping)
            if not math.isnan(self._held[joint]):
                data = motor.command(effort, damping, hold * HOLD_STIFFNESS, self._held[joint])
                if data[0] not in self._joint_of:  # or its echo would look like a reply
                    return motor.command_id, data
        return motor.command_id, motor.command(effort, damping)

    def _oppose(self, joint: int, foreign: bytes) -> None:
        """Answer a foreign command with our last one, under the motor's full damping; hold the joint meanwhile."""
        now = self._now()
        motor = self._motors[joint]
        self.foreign_commands += 1
        self._contested[joint] = now
        self.foreign_command = f"another sender commands motor {motor.can_id} (frame [{foreign.hex(' ')}])"
        if not (self._powered and self._drive.powered) or self._drive.unsure[joint]:
            return
        if foreign in [data for _, data in motor.set_zero]:
            self._held[joint] = math.nan  # not held in this contest: a reply may still count from the old zero
        command = self._command(joint, now)
        is_exit = foreign in [data for _, data in motor.exit]
        if is_exit or now - self._corrected[joint] >= CORRECTION_PERIOD:
            self._send(self._ports[joint], *((command, *motor.enter) if is_exit else ()), command)
            self._corrected[joint] = now
