# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated device: the arm, its motors and the wearer. CAN frames are its only connection to a controller.

`run` plays it in real time on python-can buses. `advance` and `exchange` play it without a bus, as fast as possible.
Physics catches up with the clock in steps of 1 ms before a frame is processed, so a motor always replies with the
present state of the arm. A reply is sent as long after its command as its firmware takes. V3 boards send status frames
on their own timer, only in `run`.

udp_multicast returns every frame to its sender, unmarked; most buses do not. An echo is known as no command: the first
byte of a reply is its ID.
"""

import heapq
import math
import operator
import random
import select
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.frames import EXTENDED, Frame
from exo_gravity.core.numbers import JOINT_COUNT, Torque, for_joints
from exo_gravity.hardware.can_port import POLL_TIME, message_of
from exo_gravity.sim.arm import STEP, SimulatedArm
from exo_gravity.sim.motors.ak import SimulatedMotor
from exo_gravity.sim.script import IDLE, TrialScript
from exo_gravity.sim.trunk_motion import TrunkMotion, TrunkState, minimum_jerk, motion_of

# The hand's compliance in Nm/rad, Nm s/rad and Nm/(rad s): of the order of a human arm's; least damping where the arm
# is lightest. Of the paper's arm; the least of each for another one.
STIFFNESS, DAMPING, INTEGRAL = (60.0, 80.0, 60.0, 30.0), (3.0, 6.0, 5.0, 2.0), (120.0, 160.0, 150.0, 80.0)
STRENGTH = 25.0  # Nm on any joint; an adult's arm and the robot, stretched out, need 15 to 20 Nm
MOVING = 0.75  # share of a move's duration in which the hand moves; then it holds the arm still

Course = list[tuple[float, float]]  # of each joint: position in rad, velocity in rad/s


class VirtualWearer:
    """Performs `script` once, with at most `strength` Nm on any joint.

    Move: a hand leads the joints along minimum-jerk paths (Flash and Hogan 1985) to the pose, holds them there for the
    last quarter of the time, and lets go. The hand is a spring, a damper and an integrator that takes over the arm's
    weight, all limited to the strength of a hand. Hold: no torque. Push: half a sine wave of the scripted torques.

    step: index of the current step, None before the first, len(steps) after the last.
    """

    def __init__(self, script: TrialScript, strength: float = STRENGTH) -> None:
        self.script = script
        self.strength = strength
        self.step: int | None = None
        self._elapsed = 0.0
        self._start: Sequence[float] = ()
        self._weight = np.zeros(0)  # Nm, that the hand has taken over

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (n,) in Nm on the joints, `elapsed` s after the start of the script.

        theta, velocity: (n,) rad and rad/s. Call it with increasing times: the hand remembers where it took hold and
        how much weight it has taken over. The torque is zero before the start (elapsed < 0) and after the end.
        """
        nothing = (0.0,) * len(theta)
        if elapsed < 0:
            return nothing
        index, since = self.script.at(elapsed)
        if index != self.step:
            self.step = index
            self._start = theta
            self._weight = np.zeros(len(theta))
        period, self._elapsed = elapsed - self._elapsed, elapsed
        if index == len(self.script.steps):
            return nothing
        step = self.script.steps[index]
        if step.action == "move":
            stiffness, damping, integral = (
                np.array(for_joints(tuning, len(theta))) for tuning in (STIFFNESS, DAMPING, INTEGRAL)
            )
            position, speed = np.transpose(path_between(self._start, step.value, since, MOVING * step.duration))
            error, limit = position - theta, self.strength
            self._weight = np.clip(self._weight + integral * error * period, -limit, limit)
            pull = stiffness * error + damping * (speed - velocity) + self._weight
            return tuple(np.clip(pull, -limit, limit).tolist())
        if step.action == "push":
            share = math.sin(math.pi * since / step.duration)
            return tuple(share * torque for torque in step.value)
        return nothing


def path_between(start: Sequence[float], end: Sequence[float], since: float, duration: float) -> Course:
    """Return where the joints are `since` s into a minimum-jerk move from `start` to `end`, (n,) rad, in `duration`."""
    way, pace, _ = minimum_jerk(since / duration)
    return [(a + way * (b - a), pace / duration * (b - a)) for a, b in zip(start, end, strict=True)]


# time: wall clock in s. position, velocity: of the joints, rad and rad/s. torque: of the motors on the joints, Nm.
# damping: Nm s/rad, the part of that torque that is proportional to the velocity. weight: Nm that would hold the joints
# against gravity. wearer: Nm of the wearer on the joints. frames: received by each motor so far. step: of the wearer's
# script, -1 before it. on: whether each motor is on.
def record_of(count: int) -> np.dtype:
    """Return the type of a record of an arm with `count` joints.

    The file is a sequence of records, of which `record_of` is the only description. They leave the process every
    `FLUSH_PERIOD`; what was written stays when the process is frozen or killed.
    """
    return np.dtype(
        [
            ("time", "<f8"),
            ("position", "<f4", (count,)),
            ("velocity", "<f4", (count,)),
            ("torque", "<f4", (count,)),
            ("damping", "<f4", (count,)),
            ("weight", "<f4", (count,)),
            ("wearer", "<f4", (count,)),
            ("frames", "<u4", (count,)),
            ("step", "<i4"),
            ("on", "?", (count,)),
        ]
    )


RECORD = record_of(JOINT_COUNT)  # of the paper's arm
FLUSH_PERIOD = 0.02  # s


class TruthRecords:
    """The records: in memory and by simulated time, for a judge in the same process, or in the file at `path`.

    Raises ParameterError if the file cannot be created.
    """

    def __init__(self, path: str | Path = "") -> None:
        self._rows: list[tuple[Any, ...]] = []
        self._offset = 0.0  # of the records' time to the simulated one, s
        self._flushed = 0.0
        try:
            self._file = open(path, "wb", buffering=0) if path else None  # noqa: SIM115, as long as the process runs
        except OSError as error:
            raise ParameterError("truth", str(path), f"a file that can be written ({error.strerror})") from None

    def synchronise(self, now: float) -> None:
        """Note that the simulated time `now` (s) is the present time."""
        if self._file:
            self._offset = time.time() - now

    def note(self, now: float, *state: Any) -> None:
        """Append the `state` of the arm at the simulated time `now` (s): the fields of RECORD from position on."""
        stamp = now + self._offset
        self._rows.append((stamp, *state))
        if self._file and abs(stamp - self._flushed) >= FLUSH_PERIOD:
            self._flushed = stamp
            self._file.write(self.records.tobytes())
            self._rows.clear()

    @property
    def records(self) -> np.ndarray:
        """The records that are in memory, (n,) of RECORD."""
        return np.array(self._rows, record_of(len(self._rows[0][1])) if self._rows else RECORD)


MAX_CATCH_UP = 0.05  # s of physics simulated at once; after a longer stall the rest of the time is lost
IDLE_PERIOD = 0.005  # s after which physics advances even without a frame


class SimulatedDevice:
    """An arm with one motor per joint, on a trunk that moves, and optionally a wearer who moves both.

    motors: shoulder to elbow, with different CAN IDs. side: 'left' or 'right'. The trunk's tilt and the faults, also
    those of each motor, may be set from any thread.
    """

    def __init__(self, arm: SimulatedArm, motors: Sequence[SimulatedMotor], side: str = "right") -> None:
        ids, count = [motor.joint.can_id for motor in motors], len(arm.positions)
        if not len(ids) == len(set(ids)) == count:
            raise ParameterError("can_id", ids, f"{count} different IDs, one per joint")
        self.arm, self.motors, self.side = arm, tuple(motors), side
        self.pitch = self.roll = 0.0  #: rad, of the trunk
        self.is_fd: Sequence[bool] = (False,) * len(motors)  #: whether each motor sends CAN FD frames
        self.bus_silent = False  #: frames pass in neither direction, and the motors keep their last commands
        self.cut_off: Sequence[bool] = (False,) * count  #: the same for each motor
        self.mute: Sequence[bool] = (False,) * count  #: whether a motor's replies are lost, while it obeys
        self.encoder_error: Sequence[float] = (0.0,) * count  #: rad, added to the angle that a motor reads
        self.truth: TruthRecords | None = None  #: receives every physics step
        self.slip = 0.0  #: s that `run` has lost against real time
        #: s since the motors were switched on, between two passes of `run`, and in which no command arrived
        self.longest_stall = self.longest_silence = 0.0
        self.trunk_motion: TrunkMotion | None = None  #: of the wearer's current step; None if that moves no trunk
        self._joints_of_id: dict[int, list[int]] = {}
        for joint, motor in enumerate(motors):
            for can_id in motor.received_ids:
                self._joints_of_id.setdefault(can_id, []).append(joint)
        self._random = random.Random(0)  # of the delays of replies
        self._steps = 0
        self._clock = 0.0  # s elapsed, of which `time` is the part in whole steps
        self.wearer = VirtualWearer(IDLE)  #: who performs a script, none at first
        self._script_start = math.inf  # simulated s
        self._trunk_step: int | None = None  # the step that `trunk_motion` belongs to
        self._base = TrunkState()  # the arm's base moves like this
        self._frames = [0] * count  # received by each motor
        self._power_returns = [math.inf] * len(motors)  # simulated s

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self._steps * STEP

    @property
    def powered(self) -> bool:
        """Whether any motor is on."""
        return any(motor.entered for motor in self.motors)

    @property
    def disconnected(self) -> bool:
        """Whether a simulated fault keeps a motor from replying."""
        return self.bus_silent or any(self.cut_off) or any(motor.unplugged for motor in self.motors)

    @property
    def trunk(self) -> TrunkState:
        """The trunk's tilt and motion."""
        return self._base if self.trunk_motion else TrunkState(self.pitch, self.roll)

    def unplug(self, joint: int, duration: float = math.inf) -> None:
        """Take the power of a motor away for `duration` s; it comes back switched off."""
        self.motors[joint].unplugged = True
        self._power_returns[joint] = self.time + duration

    def start(self, wearer: VirtualWearer, delay: float = 0.0) -> None:
        """Let `wearer` start the script in `delay` s; replaces any other wearer."""
        self.wearer, self._script_start = wearer, self.time + delay
        self._trunk_step, self.trunk_motion = None, None

    def advance(self, duration: float) -> None:
        """Advance by `duration` s in whole steps; a remainder is kept for the next call."""
        self._clock += duration
        self._move_base(self.trunk)
        if self.truth:
            self.truth.synchronise(self._clock)
        for _ in range(int((self._clock - self.time) / STEP + 1e-6)):
            self._step(self.arm.positions, self.arm.velocities)

    def exchange(self, can_id: int, data: bytes) -> Frame | None:
        """Pass the frame `data` with arbitration ID `can_id` to the motors; return (ID, data) of the reply, if any."""
        return next((reply for _, reply in self.replies(can_id, data)), None)

    def replies(self, can_id: int, data: bytes, among: Collection[int] | None = None) -> list[tuple[int, Frame]]:
        """Pass a frame to the motors that obey its ID; return those that reply, each with (ID, data).

        among: the motors, from 0 on, that the frame reaches; None for all.
        """
        replies, arm = [], self.arm
        for joint in self._joints_of_id.get(can_id, ()):
            if (among is not None and joint not in among) or self.bus_silent or self.cut_off[joint]:
                continue
            motor = self.motors[joint]
            self._frames[joint] += 1
            position = arm.motor_positions[joint] + self.encoder_error[joint]
            reply = motor.receive(data, position, arm.motor_velocities[joint], self.time, can_id)
            if reply is not None and not self.mute[joint]:
                replies.append((joint, (motor.reply_id, reply)))
        return replies

    def status(self, joint: int) -> Frame | None:
        """Return the present status frame of a V3 board; None if it cannot send, and for other boards."""
        if self.bus_silent or self.cut_off[joint] or self.mute[joint]:
            return None
        arm = self.arm
        position = arm.motor_positions[joint] + self.encoder_error[joint]
        return self.motors[joint].status(position, arm.motor_velocities[joint])

    def run(
        self,
        bus: can.BusABC | Sequence[can.BusABC],
        should_stop: Callable[[], bool],
        on_idle: Callable[[float], None] = lambda now: None,
    ) -> None:
        """Play the device in real time until `should_stop()`. Raises BusError when a bus fails.

        bus: of all motors, or that of each (n,). on_idle(now), `now` in monotonic s, is called whenever no reply is
        due, at the latest 5 ms after the last frame.
        """
        bus_of = list(bus) if isinstance(bus, Sequence) else [bus] * len(self.motors)
        buses = list(dict.fromkeys(bus_of))
        reached = {bus: [joint for joint, own in enumerate(bus_of) if own is bus] for bus in buses}
        outbox: list[tuple[float, int, Frame]] = []  # a heap of replies: when due, joint, frame
        last = heard = time.monotonic()
        was_on = False
        reporting = [joint for joint, motor in enumerate(self.motors) if not motor.joint.wire_format.replies]
        periods = {joint: 1.0 / self.motors[joint].firmware.status_rate for joint in reporting}  # of V3 boards, s
        reports = {joint: last + self._random.uniform(0.0, period) for joint, period in periods.items()}  # next
        while not should_stop():
            due = min(last + IDLE_PERIOD, *reports.values(), outbox[0][0] if outbox else math.inf)
            source, wait = _next(buses, max(0.0, due - time.monotonic()))
            frame, age = self._receive(source, wait)
            now = time.monotonic()
            is_on = self.powered
            if is_on and not was_on:
                self.longest_stall, self.longest_silence, heard = 0.0, 0.0, now
            elif is_on:
                self.longest_stall = max(self.longest_stall, now - last)
                self.longest_silence = max(self.longest_silence, now - heard)
            was_on, heard = is_on, now if frame else heard
            self.slip += max(0.0, now - last - MAX_CATCH_UP)
            self.advance(min(now - last, MAX_CATCH_UP))
            last = now
            for joint, reply in self.replies(*frame, reached[source]) if frame else ():
                delays = self.motors[joint].firmware.reply_delay
                delay = self._random.uniform(*delays) - min(age, delays[0])
                heapq.heappush(outbox, (now + delay, joint, reply))
            while outbox and outbox[0][0] <= time.monotonic():
                _, joint, reply = heapq.heappop(outbox)
                _send(bus_of[joint], reply, self.is_fd[joint])
            for joint, period in periods.items():
                if reports[joint] <= last:
                    following = reports[joint] + period
                    reports[joint] = following if following > last else last + period  # missed ones are not made up
                    if frame := self.status(joint):
                        _send(bus_of[joint], frame, self.is_fd[joint])
            if not outbox:
                on_idle(last)

    def command_of(self, message: can.Message) -> Frame | None:
        """Return the frame of a message, None for one that is no command.

        No command are an error frame, CAN FD that the boards do not know, and a reply, which begins with its own ID.
        """
        frame_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        is_unknown = message.is_error_frame or (message.is_fd and not any(self.is_fd))
        return None if is_unknown or list(message.data[:1]) == [frame_id] else (frame_id, bytes(message.data))

    def _receive(self, bus: can.BusABC, timeout: float) -> tuple[Frame | None, float]:
        """Return the next command, or None, and its age in s. A remote frame is returned without data."""
        try:
            message = bus.recv(timeout)
        except can.CanOperationError as error:
            # On udp_multicast a datagram without a CAN frame raises while it is unpacked: that is not a bus failure.
            if error.__cause__ is None or isinstance(error.__cause__, OSError):
                raise BusError(f"receiving on {bus.channel_info} failed: {error}") from error
            return None, 0.0
        frame = self.command_of(message) if message else None
        if message is None or frame is None or frame[0] not in self._joints_of_id:
            return None, 0.0
        return frame, max(0.0, time.time() - message.timestamp)

    def _follow_trunk(self, elapsed: float) -> None:
        """Move the trunk, and load the hand, as the wearer's script says, `elapsed` s after its start."""
        script = self.wearer.script
        index, since = script.at(elapsed)
        if elapsed >= 0.0 and index != self._trunk_step:
            self._trunk_step = index
            step = script.steps[index] if index < len(script.steps) else None
            self.trunk_motion = motion_of(step, self.pitch, self.roll) if step else None
            if step and step.action == "load":
                self.arm.carry(step.value[0])
        if self.trunk_motion:
            state = self.trunk_motion.at(since)
            self.pitch, self.roll = state.pitch, state.roll
            self._move_base(state)

    def _move_base(self, state: TrunkState) -> None:
        if state != self._base:
            self._base = state
            self.arm.move_base(*self.arm.config.felt(self.side, state))

    def _step(self, theta: list[float], velocity: list[float]) -> None:
        now, arm = self.time, self.arm
        for joint, returns in enumerate(self._power_returns):
            if now >= returns:
                self._power_returns[joint] = math.inf
                self.motors[joint].unplugged = False
        angles, speeds = (arm.motor_positions, arm.motor_velocities) if arm.is_elastic else (theta, velocity)
        at = zip(self.motors, angles, speeds, strict=True)
        torque = [motor.advance(angle, speed, STEP) for motor, angle, speed in at]
        elapsed = now - self._script_start
        given = self.wearer.torque(elapsed, theta, velocity)
        self._follow_trunk(elapsed)
        damping = [motor.damping for motor in self.motors]
        if self.truth:
            on = [motor.entered for motor in self.motors]
            step = -1 if self.wearer.step is None else self.wearer.step
            self.truth.note(now, theta, velocity, torque, damping, arm.weight, given, tuple(self._frames), step, on)
        each = zip(damping, self.motors, torque, strict=True)
        prompt = [own if own and motor.damps_at_once(pull) else 0.0 for own, motor, pull in each]
        arm.step(list(map(operator.add, torque, given)), of_motors=torque, damping=prompt)
        self._steps += 1


def _next(buses: list[can.BusABC], timeout: float) -> tuple[can.BusABC, float]:
    """Return the bus to read next, and the time in s to wait for its frame; every bus has its turn.

    Buses with sockets are awaited together, for at most `timeout` s.
    """
    if len(buses) == 1:
        return buses[0], timeout
    buses.append(buses.pop(0))
    try:
        ready = select.select(buses, (), (), timeout)[0]
    except (OSError, ValueError, NotImplementedError):  # one has no socket
        return buses[0], min(timeout, POLL_TIME)
    return (ready or buses)[0], 0.0


def _send(bus: can.BusABC, frame: Frame, is_fd: bool) -> None:
    try:
        bus.send(message_of(frame, is_fd))
    except can.CanError as error:
        raise BusError(f"sending on {bus.channel_info} failed: {error}") from error
