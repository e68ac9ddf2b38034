"""The simulated device: the arm, its four motors and whoever wears it, joined to the world by CAN frames alone.

`run` plays it in real time on a python-can bus. `advance` and `exchange` play it without a bus, as fast as it goes.
Physics is caught up to the clock in steps of 1 ms before any frame is looked at, so a motor always answers from where
the arm is now; a reply leaves 200 to 400 us after its command, as measured on AK motors.
"""

from __future__ import annotations

import heapq
import operator
import random
import time
from collections import deque
from collections.abc import Callable, Sequence

import can

from exo_gravity.core.arm import JOINT_COUNT
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.tilt import Tilt
from exo_gravity.sim.arm import STEP, SimulatedArm
from exo_gravity.sim.motor import SimulatedMotor
from exo_gravity.sim.virtual_wearer import VirtualWearer

REPLY_DELAY = (200e-6, 400e-6)  # s
MAX_CATCH_UP = 0.05  # s of physics made up for at once
_IDLE = 0.002  # s without a frame after which physics goes on all the same
_ECHOES_AWAITED = 512  # twice the frames that a udp_multicast socket keeps unread

Frame = tuple[int, bytes]


class SimulatedDevice:
    """An arm with four motors, on a trunk that tilts, perhaps with a wearer who moves it.

    motors: shoulder to elbow, CAN IDs all different. side: 'left' or 'right'. seed: of the reply delays.

    To be set live, from any thread: `pitch` and `roll` of the trunk in rad; `bus_silent` (no frame comes through in
    either direction, and the motors go on with what they were last told); and each motor's own faults.
    To be read: `time`, s simulated; `slip`, s by which `run` has fallen behind for good.
    """

    def __init__(self, arm: SimulatedArm, motors: Sequence[SimulatedMotor], side: str = "right", seed: int = 0):
        ids = [motor.joint.can_id for motor in motors]
        if len(ids) != JOINT_COUNT or len(set(ids)) != JOINT_COUNT:
            raise ParameterError("can_id", ids, f"{JOINT_COUNT} different IDs, one a joint")
        self.arm = arm
        self.motors = tuple(motors)
        self.side = side
        self.pitch = 0.0
        self.roll = 0.0
        self.bus_silent = False
        self.slip = 0.0
        self._joint_of_id = {can_id: joint for joint, can_id in enumerate(ids)}
        self._random = random.Random(seed)
        self._steps = 0
        self._clock = 0.0  # s of time passed, of which `time` is the part in whole steps
        self._trial: tuple[VirtualWearer, float] | None = None
        self._tilted: tuple[float, float] | None = None

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self._steps * STEP

    @property
    def elapsed(self) -> float | None:
        """Time in s since the wearer's protocol began, below 0 before it; None without a wearer."""
        trial = self._trial
        return None if trial is None else self.time - trial[1]

    def start(self, wearer: VirtualWearer, delay: float = 0.0) -> None:
        """Let `wearer` begin with the protocol `delay` s from now, in place of any other."""
        self._trial = (wearer, self.time + delay)

    def advance(self, duration: float) -> None:
        """Let `duration` s pass, in whole steps; what is left over counts next time."""
        self._clock += duration
        tilt = (self.pitch, self.roll)
        if tilt != self._tilted:
            self.arm.set_gravity(Tilt.of(self.side, *tilt).direction)
            self._tilted = tilt
        steps = int((self._clock - self.time) / STEP + 1e-6)
        while steps > 0:
            count = steps if self._steady(steps * STEP) else 1
            self._step(self.arm.positions, self.arm.velocities, count)
            steps -= count

    def exchange(self, can_id: int, data: bytes) -> Frame | None:
        """Give the motors the frame `data` with arbitration ID `can_id`; return (ID, data) of the reply, if any."""
        joint = self._joint_of_id.get(can_id)
        if joint is None or self.bus_silent:
            return None
        motor, arm = self.motors[joint], self.arm
        reply = motor.receive(data, arm.positions[joint], arm.velocities[joint], self.time)
        return None if reply is None else (motor.reply_id, reply)

    def run(
        self, bus: can.BusABC, should_stop: Callable[[], bool], aside: Callable[[float], None] = lambda now: None
    ) -> None:
        """Play the device on `bus` in real time until `should_stop()`. Raises BusError when the bus fails.

        aside(now) is called, `now` in monotonic s, whenever all commands are answered: without any, every 2 ms.
        """
        outbox: list[tuple[float, Frame]] = []
        echoes = _Echoes()
        last = time.monotonic()
        while not should_stop():
            due = min(outbox[0][0], last + _IDLE) if outbox else last + _IDLE
            frame, age = _receive(bus, max(0.0, due - time.monotonic()))
            now = time.monotonic()
            self._catch_up(now - last)
            last = now
            if frame and not echoes.take(frame) and (reply := self.exchange(*frame)):
                heapq.heappush(outbox, (now - age + self._random.uniform(*REPLY_DELAY), reply))
            while outbox and outbox[0][0] <= time.monotonic():
                reply = heapq.heappop(outbox)[1]
                echoes.expect(reply)
                _send(bus, reply)
            if not outbox:
                aside(last)

    def _catch_up(self, duration: float) -> None:
        self.slip += max(0.0, duration - MAX_CATCH_UP)
        self.advance(min(duration, MAX_CATCH_UP))

    def _steady(self, duration: float) -> bool:
        """Return whether no torque will change for `duration` s: its steps can then be made at once."""
        if self._trial is not None and not self._trial[0].idle(self.time - self._trial[1], duration):
            return False
        return all(motor.steady for motor in self.motors)

    def _step(self, theta: list[float], velocity: list[float], count: int) -> None:
        torque = list(map(SimulatedMotor.torque, self.motors, theta, velocity))
        if self._trial is not None:
            wearer, start = self._trial
            torque = list(map(operator.add, torque, wearer.torque(self.time - start, theta, velocity)))
        self.arm.step(torque, count)
        self._steps += count


class _Echoes:
    """Tells the echo of an own reply from a command with the same ID and bytes.

    udp_multicast hands every frame back to its sender, unmarked; most buses do not. So a frame sent is remembered until
    its echo has come, once. Where many have been sent and never one come back, the bus does not echo.
    """

    def __init__(self):
        self._awaited: deque[Frame] = deque()
        self._ever = False
        self._never = False

    def expect(self, frame: Frame) -> None:
        if self._never:
            return
        self._awaited.append(frame)
        if len(self._awaited) > _ECHOES_AWAITED:
            self._never = not self._ever
            self._awaited.clear()

    def take(self, frame: Frame) -> bool:
        """Return whether `frame` is the echo of one sent, and no longer wait for it."""
        if frame not in self._awaited:
            return False
        self._awaited.remove(frame)
        self._ever = True
        return True


def _receive(bus: can.BusABC, timeout: float) -> tuple[Frame | None, float]:
    """Return the next frame of classic CAN with an 11-bit ID, or None, and how long ago it arrived, in s.

    A remote frame comes out as one without data.
    """
    try:
        message = bus.recv(timeout)
    except can.CanOperationError as error:
        # A datagram on udp_multicast that holds no CAN frame fails on unpacking: it is noise, and the bus is well.
        if error.__cause__ is None or isinstance(error.__cause__, OSError):
            raise BusError(f"receiving on {bus.channel_info} failed: {error}") from error
        return None, 0.0
    if message is None or message.is_extended_id or message.is_error_frame or message.is_fd:
        return None, 0.0
    age = time.time() - message.timestamp
    return (message.arbitration_id, bytes(message.data)), max(0.0, min(age, REPLY_DELAY[0]))


def _send(bus: can.BusABC, frame: Frame) -> None:
    try:
        bus.send(can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False))
    except can.CanError as error:
        raise BusError(f"sending on {bus.channel_info} failed: {error}") from error
