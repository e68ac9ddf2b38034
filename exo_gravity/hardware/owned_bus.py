# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The bus of an arm, or its buses, that this process owns: locks, watchdog, and what a previous owner left behind.

Each bus has its own lock and notes. One watchdog holds all of them and lets the whole arm down: a joint without load
must stay damped while the joints on the other bus are lowered.

AK motors keep applying the last command: an arm that another process has left with its motors on is let down. The
watchdog does it for a bridge that has died, and a new bridge does it if both had died.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing import Pipe

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.command import Send
from exo_gravity.core.safety.watch import excess_torque, expected_torque
from exo_gravity.hardware.bus_lock import ATTEMPT_TIME, ArmNotes, BusLock, bus_name
from exo_gravity.hardware.can_port import ArmOnBus, CanPort
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock
from exo_gravity.hardware.control_loop import ControlLoop, NoController
from exo_gravity.hardware.motor_bus import MotorBus

# s between two attempts to open the bus of an arm that another process has left, and for its motors' first replies
REACH_PERIOD = 0.05


@dataclass(frozen=True)
class Heartbeat:
    """When the watchdog's process counts as alive, in s."""

    start: float = 15.0  #: until the first heartbeat, before which no arm is enabled: imports take long when busy
    timeout: float = 0.3  #: without a heartbeat, while this process itself runs
    longest_look: float = 0.15  #: between two looks of a process that runs
    end: float = 2.0  #: for the watchdog to end after `close`


HEARTBEAT = Heartbeat()


def let_down(arm: ArmOnBus, notes: ArmNotes, log: Callable[[str], None], is_wanted: Callable[[], bool]) -> bool:
    """Let down an arm whose motors apply what is noted; return whether its motors have confirmed that they are off.

    The joints on a bus that cannot be opened come after the others.

    log: called with each change worth knowing.
    is_wanted: whether to give up while the bus or a motor cannot be reached, because another process waits for the bus.
    """
    ports: list[CanPort | None] = []
    is_logged = False
    while not any(ports):
        failures: list[BusError] = []
        ports = arm.ports(notes.clock, failures)
        if failures and not is_logged:
            log(f"{'; '.join(map(str, failures))}; the motors may still be powered")
        is_logged = True
        if not any(ports):
            if is_wanted():
                return False
            notes.clock.sleep(REACH_PERIOD)
    left = [joint for joint in arm.joints if not ports[joint]]
    own = notes.of([joint for joint in arm.joints if ports[joint]])
    command, clock, is_complete = notes.command, notes.clock, False
    motors = MotorBus(ports, arm.motors, note=own.note, clock=clock)
    send = [Send.COMMAND if replies else Send.NOTHING for replies in motors.replies]
    first = command._replace(send=tuple(send), powered=True)
    end = clock.monotonic() + REACH_PERIOD
    while not is_complete and clock.monotonic() < end:
        try:
            is_complete = motors.exchange(first, clock.monotonic() + arm.period)
        except BusError:
            clock.sleep(arm.period)
    # A motor that replies another torque than it received has been switched off or obeyed another sender.
    effort, damping = list(command.effort), list(command.damping)
    for i, joint in enumerate(motors.samples):
        expected = expected_torque(effort[i], damping[i], joint.velocity)
        if excess_torque(joint.effort, expected) > 0.0:  # not without a reply: that is NaN
            effort[i], damping[i] = joint.effort, 0.0
    loop = ControlLoop(motors, arm.limits, arm.period, NoController())
    loop.safety.take_over(effort, damping, clock.monotonic(), command.is_unproven)
    was_unreached = False
    while not loop.is_off and loop.cycle():
        if loop.safety.is_unreached and not was_unreached:
            log("a motor does not reply; it may still be powered; trying again")
        was_unreached = loop.safety.is_unreached
        if was_unreached and is_wanted():
            motors.close()
            return False
    loop.stop()
    if not loop.is_off:
        return False
    return not left or let_down(replace(arm, joints=left), notes, log, is_wanted)


class Silence:
    """How long another process has given no sign of life, seen by a process that may have stood still itself.

    now: s.
    longest_look: s between two looks of a process that runs. If more time has passed, the whole machine may have stood
        still, and the other process gets another chance: only `longest_look` is added.
    """

    def __init__(self, now: float, longest_look: float) -> None:
        self._last_look = now
        self._longest_look = longest_look
        self._sign = 0.0
        self._duration = 0.0

    def look(self, now: float, sign: float, is_due: bool = True) -> float:
        """Return the silence in s at `now`, 0 if `sign` is new.

        is_due: whether the other process must give signs.
        """
        is_silent = is_due and sign == self._sign
        self._duration = self._duration + min(now - self._last_look, self._longest_look) if is_silent else 0.0
        self._last_look, self._sign = now, sign
        return self._duration


class ArmLock:
    """Exclusive ownership of every bus of `arm` until `release`. `BusLock` explains the arguments.

    The buses are locked in the order of their names: two owners never wait for each other. Raises BusError, and owns
    none, if one is held.
    """

    def __init__(self, arm: ArmOnBus, owner: str, patience: float, clock: Clock) -> None:
        self.locks: list[BusLock] = []  #: of the buses
        own: dict[int, BusLock] = {}
        try:
            for part in sorted(arm.parts, key=lambda part: bus_name(part.address)):
                self.locks.append(BusLock(part.address, owner, patience, clock, asks=True))
                own |= dict.fromkeys(part.joints, self.locks[-1])
        except BaseException:
            self.release()
            raise
        self.of_joints = [own[joint] for joint in range(len(arm.motors))]  #: (n,) of the bus of each joint's motor
        self.notes = ArmNotes([lock.notes for lock in self.of_joints])

    def release(self) -> None:
        """Give up all buses: they are free once the watchdog has ended, too."""
        for lock in self.locks:
            lock.release()


class Watchdog:
    """The bridge's end: the watchdog process of `arm`, on the buses that `lock` holds."""

    def __init__(self, lock: ArmLock, arm: ArmOnBus) -> None:
        self._notes = lock.notes
        self._now = lock.notes.clock.monotonic
        self._start = self._now()
        self._timeout = max(HEARTBEAT.timeout, arm.limits.frozen_timeout)
        self._silence = Silence(self._start, HEARTBEAT.longest_look)
        receiver, self._sender = Pipe(duplex=False)
        pages, locks = [own.descriptor for own in lock.of_joints], [own.socket.fileno() for own in lock.locks]
        shared = (receiver.fileno(), *pages, *locks)
        arguments = map(str, (os.getpid(), len(pages), *shared))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "exo_gravity.hardware.watchdog", *arguments],
            pass_fds=shared,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # keeps Ctrl-C and Ctrl-Z in the terminal away from it
        )
        receiver.close()
        self._sender.send(arm)

    @property
    def is_starting(self) -> bool:
        """Whether the watchdog does not watch yet: no motor may be switched on."""
        return self._notes.heartbeat == 0.0

    @property
    def alive(self) -> bool:
        """Whether the watchdog process runs. Read it several times a second: it must also notice a frozen process."""
        if self.process.poll() is not None:
            return False
        now, heartbeat = self._now(), self._notes.heartbeat
        if heartbeat == 0.0:
            return now - self._start < HEARTBEAT.start
        return self._silence.look(now, heartbeat) < self._timeout

    def hand_over(self, reason: str) -> bool:
        """Request the watchdog to kill this process and let the arm down; return whether it is alive."""
        with contextlib.suppress(OSError):
            if self.process.poll() is None:
                self._sender.send(reason)
                return True
        return False

    def close(self) -> None:
        """End the watchdog and wait until it has ended. If the motors may be on, it stays and lets the arm down."""
        self._sender.close()
        if self._notes.command.powered:
            return
        try:
            self.process.wait(HEARTBEAT.end)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class OwnedBus:
    """The bus of `arm`, or its buses, owned until `close`.

    If the previous owner and its watchdog ended while the motors were on, that arm is let down first. Raises BusError
    if the bus is held or cannot be opened, or if that arm cannot be let down.

    owner: shown to others who want the bus.
    log: called with what happens when an arm is let down first.
    """

    def __init__(self, arm: ArmOnBus, owner: str, log: Callable[[str], None], clock: Clock = COMPUTER_CLOCK) -> None:
        self._arm = arm
        self._lock = take_over(arm, owner, log, ATTEMPT_TIME, clock)
        self.notes = self._lock.notes  #: what the motors receive, for a process that outlives this one
        self.watchdog = Watchdog(self._lock, arm)

    def open(self) -> MotorBus:
        """Open the bus. Raises BusError if it cannot be opened, or if another host commands the motors."""
        ports = self._arm.ports(self.notes.clock)
        bus = MotorBus(ports, self._arm.motors, note=self.notes.note, clock=self.notes.clock)
        try:
            bus.listen()
        except BusError:
            bus.close()
            raise
        return bus

    def close(self) -> None:
        """End the watchdog and release the bus, after the motors were switched off."""
        self.watchdog.close()
        self._lock.release()


def take_over(
    arm: ArmOnBus, owner: str, log: Callable[[str], None], patience: float = ATTEMPT_TIME, clock: Clock = COMPUTER_CLOCK
) -> ArmLock:
    """Lock each bus for `owner`, and let down the arm that its last owner left with its motors on.

    If the arm cannot be reached, a watchdog stays and keeps trying, until the next owner asks for the bus. Raises
    BusError.

    patience: s for the last owner's watchdog to let it down first.
    """
    lock = ArmLock(arm, owner, patience, clock)
    try:
        command = lock.notes.command
        if problem := "; ".join(own.problem for own in lock.locks if own.problem):
            log(f"it is not known what the motors apply, they may be on ({problem}): letting the arm down")
        elif command.powered:
            log("the last can_bridge on this bus and its watchdog ended with the motors on: letting the arm down")
        if command.powered:
            if not let_down(arm, lock.notes, log, lambda: True):
                Watchdog(lock, arm).close()
                raise BusError(f"CAN bus {arm.address[1]}: a motor that may be powered does not reply")
            log("the arm is down, its motors are off")
        return lock
    except BaseException:
        lock.release()
        raise
