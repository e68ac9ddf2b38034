# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A python-can bus that survives its adapter: every error becomes a BusError, and a failed bus is opened again.

A send that fails once is a lost frame, as on the wire: a full transmit queue (ENOBUFS) is often empty a cycle later.

Backends raise more than `can.CanError`: slcan raises ValueError on a garbled line. A USB adapter that is plugged in
again is a new device, which only a newly opened bus can reach. Opening may block, so another thread does it.

Most buses return no echoes of our own frames. Some return them and mark them (`is_rx` is false). udp_multicast returns
them unmarked, in order. SocketCAN sets the same mark on every frame from this computer, also on those of another
process (Documentation/networking/can.rst of Linux, MSG_DONTROUTE): there it does not show an echo.

Names such as can0 are given in the order in which adapters are found. Of two exchanged adapters, motors with the same
IDs would receive each other's torques: so an adapter may be named by its serial number. Linux shows that of a USB
adapter in sysfs; of others python-can may know it. An adapter with several channels has one number for all: their
cables can still be exchanged.
"""

import contextlib
import errno
import select
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.udp_multicast import UdpMulticastBus

from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.frames import EXTENDED, ID_BITS, Frame
from exo_gravity.core.motors.joint_motor import Address, JointMotor, buses_of, channels_of, is_fd
from exo_gravity.core.safety.limits import Limits
from exo_gravity.hardware.clock import Clock

LOST_SENDS = 0.005  # s of failures in a row that are lost frames
REOPEN_AFTER = 0.02  # s of failures in a row after which the bus is opened again
REOPEN_PERIOD = 0.1  # s between two attempts
MOST_AWAITED = 512  # echoes; twice the frames that a udp_multicast socket keeps unread
POLL_TIME = 0.0005  # s for which one of several buses is awaited that cannot be awaited together
MAX_STALE_FRAMES = 256  # the capacity of udp_multicast, more than any cycle produces
SYSFS = Path("/sys")
CLASSES = {"socketcan": "net", "slcan": "tty"}  # in sysfs, of the channels of an interface


def open_bus(interface: str, channel: str, options: Mapping[str, Any]) -> can.BusABC:
    """Open a python-can bus of any kind. Raises BusError that names the bus and the reason.

    By these settings alone: python-can's own files and variables (~/.canrc, CAN_CONFIG) belong to other programs.
    """
    try:
        number = int(channel) if channel.isdecimal() else channel  # of a channel of an adapter with several
        bus = can.Bus(channel=number, interface=interface, ignore_config=True, **options)
        if bus.channel_info == can.BusABC.channel_info:  # some backends leave it "unknown"
            bus.channel_info = f"{interface} {channel}"
        return bus
    except Exception as error:  # backends raise errors of every type
        if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
            lacks = "this kernel has no SocketCAN: modprobe can can_raw; WSL2 and some containers lack it"
            raise BusError(f"CAN bus {interface} {channel} cannot be opened: {lacks}") from error
        raise BusError(f"CAN bus {interface} {channel} {dict(options)} cannot be opened: {error}") from error


class CanPort:
    """Sends and receives frames of classic CAN, or of CAN FD. Not thread-safe: one thread owns it.

    reopen: opens the bus again and raises BusError if it cannot; None if a failed bus must stay failed.
    is_fd: whether it sends CAN FD frames.
    """

    def __init__(
        self,
        bus: can.BusABC,
        clock: Clock,
        reopen: Callable[[], can.BusABC] | None = None,
        is_fd: bool = False,
    ) -> None:
        self.name = str(bus.channel_info)  #: name of the bus
        self.is_fd = is_fd
        self._marks_echoes = not isinstance(bus, SocketcanBus)
        # Frames that were sent and come back, unmarked.
        self._awaited: deque[Frame] = deque(maxlen=MOST_AWAITED if isinstance(bus, UdpMulticastBus) else 0)
        self._bus: can.BusABC | None = bus  # None while a failed one is opened again
        self._clock = clock
        self._reopen = reopen
        self._failing_since: float | None = None
        self._has_lost = False  # a frame, since the last `confirm`
        self._error = ""
        self._is_closing = False

    def send(self, *frames: Frame, may_be_lost: bool = False) -> None:
        """Send frames. Raises BusError; with `may_be_lost`, not for the first failures."""
        for frame in frames:
            bus = self._bus or self._reopening()
            self._awaited.append(frame)
            try:
                bus.send(message_of(frame, self.is_fd))
            except Exception as error:
                self._has_lost = True
                failure = self._failed(bus, error)
                if not may_be_lost or self._clock.monotonic() - (self._failing_since or 0.0) > LOST_SENDS:
                    raise failure from error

    def receive(self, timeout: float) -> can.Message | None:
        """Return the next frame, or None: after `timeout` s at the latest. Raises BusError.

        Not by python-can's `recv`, whose time-out is by the wall clock: one that is set back would hold the loop up.
        """
        bus = self._bus or self._reopening()
        try:
            return bus._recv_internal(timeout)[0]
        except Exception as error:
            raise self._failed(bus, error) from error

    def fileno(self) -> int:
        """Return the descriptor of the bus's socket; -1 if it has none, or keeps frames that it has read."""
        return self._bus.fileno() if isinstance(self._bus, SocketcanBus | UdpMulticastBus) else -1

    def waiting(self) -> Iterator[can.Message]:
        """Yield the frames that have already arrived, but not forever: others may keep sending. Raises BusError.

        An slcan adapter acknowledges each frame with a separate line, for which python-can returns None.
        """
        for _ in range(MAX_STALE_FRAMES):
            while (message := self.receive(0.0)) is None:
                if not hasattr(self._bus, "serialPortOrig") or not self._has_lines():
                    return
            yield message

    def is_echo(self, message: can.Message) -> bool:
        """Return whether the frame is one that this port sent."""
        if self._marks_echoes and not message.is_rx:
            return True
        frame = message.arbitration_id | (EXTENDED if message.is_extended_id else 0), bytes(message.data)
        if frame not in self._awaited:
            return False
        while self._awaited.popleft() != frame:
            pass  # echoes come in order, so those before it are lost
        return True

    def confirm(self) -> None:
        """Note, after a cycle, that the bus works: its last failure, if any, was not the first of a row."""
        if not self._has_lost:
            self._failing_since = None
        self._has_lost = False

    def close(self) -> None:
        """Close the bus. Never raises."""
        self._is_closing = True
        if self._bus is not None:
            _close(self._bus)

    def _reopening(self) -> NoReturn:
        """Raise BusError, because the bus is being opened again."""
        raise BusError(f"CAN bus {self.name}: {self._error}; opening it again")

    def _failed(self, bus: can.BusABC, error: Exception) -> BusError:
        """Return the error to raise for any `error` of `bus`; if it has failed for a while, open it again."""
        now, is_plain = self._clock.monotonic(), isinstance(error, (can.CanError, OSError))
        self._error = f"{error}" if is_plain else f"{type(error).__name__}: {error}"
        if self._failing_since is None:
            self._failing_since = now
        elif self._reopen is not None and now - self._failing_since > REOPEN_AFTER:
            self._bus = None
            self._clock.later(0.0, partial(self._open_again, self._reopen, bus))
        return BusError(f"CAN bus {self.name}: {self._error}")

    def _has_lines(self) -> bool:
        """Return whether the serial port of an slcan adapter has received more."""
        bus = self._bus or self._reopening()
        try:
            return bool(bus.serialPortOrig.in_waiting)  # type: ignore[attr-defined]
        except Exception as error:
            raise self._failed(bus, error) from error

    def _open_again(self, reopen: Callable[[], can.BusABC], failed: can.BusABC | None = None) -> None:
        if failed is not None:
            _close(failed)
        if self._is_closing:
            return
        try:
            bus = reopen()
        except BusError:
            self._clock.later(REOPEN_PERIOD, partial(self._open_again, reopen))
            return
        self._failing_since, self._bus = None, bus
        if self._is_closing:
            _close(bus)


@dataclass(frozen=True)
class ArmOnBus:
    """An arm that may have to be let down, and how to reach it."""

    address: Address  #: Of its bus; of several, as the parameters `can` state them.
    motors: Sequence[JointMotor]  #: From shoulder to elbow.
    limits: Limits  #: That it must never exceed.
    period: float  #: s of a control cycle.
    joints: Sequence[int] = field(default=(), kw_only=True)  #: From 0 on, that are to be reached; () for all.
    serials: Sequence[str] = field(default=(), kw_only=True)  #: (n,) Of adapters, '' for any; () for any.

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", tuple(self.joints) or tuple(range(len(self.motors))))
        object.__setattr__(self, "serials", tuple(self.serials) or ("",) * len(self.motors))

    @property
    def parts(self) -> "list[ArmOnBus]":
        """The arm's part on each of its buses."""
        (interface, channel, options), count = self.address, len(self.motors)
        buses = buses_of(channel, options, count).items()
        parts = ((name, own, [joint for joint in on if joint in self.joints]) for name, (on, own) in buses)
        return [
            replace(self, address=(interface, name, own), joints=joints, serials=(self.serials[joints[0]],) * count)
            for name, own, joints in parts
            if joints
        ]

    def open(self, address: Address) -> can.BusABC:
        """Open one of its buses. Raises BusError, also if it has another adapter."""
        interface, channel, _ = address
        channels = channels_of(self.address[1], len(self.motors))
        check_serial(interface, channel, dict(zip(channels, self.serials, strict=True))[channel])
        return open_bus(*address)

    def ports(self, clock: Clock, failures: list[BusError] | None = None) -> list[CanPort | None]:
        """Open its buses; return the port of each joint's motor (n,), None for one that is not to be reached.

        failures: receives the error of each bus that cannot be opened, instead of its ports. Without it, raises
        BusError.
        """
        ports: list[CanPort | None] = [None] * len(self.motors)
        for part in self.parts:
            try:
                port = CanPort(self.open(part.address), clock, partial(self.open, part.address), is_fd(part.address[2]))
            except BusError as error:
                if failures is None:
                    for opened in filter(None, ports):
                        opened.close()
                    raise
                failures.append(error)
                continue
            for joint in part.joints:
                ports[joint] = port
        return ports


def awaited(ports: Sequence[CanPort], timeout: float) -> tuple[Sequence[CanPort], float]:
    """Return the ports to read next, and the time in s to wait for a frame of each.

    Sockets are awaited together, for at most `timeout` s; other buses in turn.
    """
    if len(ports) == 1:
        return ports, timeout
    try:
        return select.select(ports, (), (), timeout)[0], 0.0
    except (OSError, ValueError):  # one has no socket, or is being opened again
        return ports, min(timeout, POLL_TIME)


def message_of(frame: Frame, is_fd: bool = False) -> can.Message:
    """Return python-can's message of a frame, whose ID contains `EXTENDED` if it has 29 bits.

    is_fd: whether it is one of CAN FD, with its data at the higher bit rate.
    """
    frame_id, data = frame
    return can.Message(
        arbitration_id=frame_id & ID_BITS,
        data=data,
        is_extended_id=frame_id >= EXTENDED,
        is_fd=is_fd,
        bitrate_switch=is_fd,
    )


def _close(bus: can.BusABC) -> None:
    with contextlib.suppress(Exception):
        bus.shutdown()


def serial_of(interface: str, channel: str, sysfs: Path = SYSFS) -> str:
    """Return the serial number of a bus's adapter, '' if it has none or it is not known."""
    if interface in CLASSES:
        name = Path(channel.partition("@")[0]).resolve().name  # slcan's may end with the serial port's speed
        device = (sysfs / "class" / CLASSES[interface] / name / "device").resolve()
        for folder in (device, *device.parents):
            if (folder / "idVendor").is_file():  # the adapter; above it are hubs, which have numbers, too
                with contextlib.suppress(OSError):
                    return (folder / "serial").read_text().strip()
                return ""
        return ""
    with contextlib.suppress(Exception):  # a backend without its driver raises errors of every type
        for config in can.detect_available_configs([interface]):
            if str(config["channel"]) == channel:
                return str(config.get("serial", ""))
    return ""


def check_serial(interface: str, channel: str, expected: str, sysfs: Path = SYSFS) -> None:
    """Raise BusError unless the adapter of a bus has the number `expected`; '' for any."""
    if expected and (found := serial_of(interface, channel, sysfs)) != expected:
        shown = f"the serial number {found}" if found else "no known serial number"
        raise BusError(
            f"CAN bus {interface} {channel}: its adapter has {shown}, must be can.serial = {expected}: "
            "are two adapters exchanged?"
        )


def serials_of(serial: str, channel: str, count: int) -> tuple[str, ...]:
    """Return the number of the adapter of each of `count` motors that the value of `can.serial` names.

    channel: the value of `can.channel`. Raises ParameterError.
    """
    names, channels = [name.strip() for name in serial.split(",")], channels_of(channel, count)
    if len(names) == 1:
        names *= count
    if len(names) != len(channels) or len(set(zip(channels, names, strict=True))) != len(set(channels)):
        raise ParameterError("can.serial", serial, f"one number, or one for each motor, as can.channel = {channel}")
    return tuple(names)
