# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One owner per CAN bus and host, and a page of notes for the process that comes after it.

The lock is an abstract UNIX socket named after the bus. Such a name belongs to the network namespace, as a CAN
interface does: it is one for every user, folder and container that reaches the interface. The watchdog inherits the
socket, so the kernel frees the name when bridge and watchdog have both ended. Who wants the bus holds a connection to
the socket while it waits (`is_asked_for`).

The notes are a file in a folder that all users share. It is removed once the motors are off. If both processes were
killed, it tells the next owner what the motors still apply.
"""

import contextlib
import ctypes
import errno
import mmap
import os
import re
import socket
import stat
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import Address
from exo_gravity.core.numbers import MAX_JOINTS
from exo_gravity.core.safety.command import Command, Send
from exo_gravity.core.safety.limits import DAMPING, MAX_EFFORT
from exo_gravity.hardware.clock import COMPUTER_CLOCK, Clock

ATTEMPT_TIME = 1.0  # s; a watchdog with nothing to do may take that long to end after its bridge
ATTEMPT_PERIOD = 0.02  # s, of looking whether it has

NAME = "\0exo_gravity/"  # the first character makes a socket's name abstract
# The first that every user may write to; /dev/shm only after it, because logind empties it when a user logs out.
FOLDERS = ("/run/lock", "/dev/shm", "/tmp")
FLAGS = os.O_NOFOLLOW | os.O_NONBLOCK  # another user may have put a link or a pipe there
SHARED = stat.S_ISVTX | stat.S_IWOTH | stat.S_IXOTH
# By the number of joints: the first fields of `CommandNotes`, written at once.
NOTES = [struct.Struct(f"={3 + 2 * count}d") for count in range(MAX_JOINTS + 1)]
CREDENTIALS = struct.Struct("=3i")  # PID, user and group of the process that listens on a socket; unix(7)
UNKNOWN_COMMAND = Command((), (), (), True)  # of motors that may be on


class CommandNotes(ctypes.Structure):
    """One page of shared memory: what the motors of a bus receive, who owns the bus, and the watchdog's heartbeat.

    `MotorBus` notes each command before its frames are sent. A process that outlives the writer thus knows the torque
    that the motors still apply. An empty page means that the motors are off. Create it by `from_buffer`.
    """

    _fields_ = (
        ("time", ctypes.c_double),  #: s, of the last note
        ("_powered", ctypes.c_double),  #: 2 while signs are not proven
        ("_count", ctypes.c_double),
        ("_values", ctypes.c_double * (2 * MAX_JOINTS)),
        ("heartbeat", ctypes.c_double),  #: s, at which the watchdog last ran; 0 before it runs
        ("_owner", ctypes.c_char * 512),
    )
    clock: Clock = COMPUTER_CLOCK

    def note(self, command: Command) -> None:
        """Note what the motors are about to receive, and whether one may be on."""
        count, values = len(command.effort), (*command.effort, *command.damping)
        NOTES[count].pack_into(self, 0, self.clock.monotonic(), command.powered + command.is_unproven, count, *values)

    @property
    def command(self) -> Command:
        """What the motors received last; of as many motors as were noted, of none before the first note."""
        powered = bool(self._powered)
        count = int(self._count) if self._count in range(MAX_JOINTS + 1) else 0
        values = self._values[: 2 * count]
        return Command(
            tuple(values[:count]),
            tuple(values[count:]),
            (Send.COMMAND if powered else Send.POLL,) * count,
            powered,
            self._powered == 2.0,
        )

    @property
    def is_damaged(self) -> bool:
        """Whether these are no notes: numbers that no command has."""
        effort, damping, *_ = self.command
        return self._count != len(effort) or not all(abs(value) <= MAX_EFFORT for value in effort + damping)

    @property
    def owner(self) -> str:
        """Who owns the bus, for error messages."""
        return str(self._owner, errors="replace")

    @owner.setter
    def owner(self, text: str) -> None:
        self._owner = text.encode()[:512]


class BusLock:
    """Exclusive ownership of the bus at `address` until `release`. Raises BusError with the present owner.

    owner: shown to others who want the bus.
    patience: s for which a bus that is held is waited for.
    asks: whether to ask for the bus, so that the watchdog of motors that do not reply hands it over.
    """

    def __init__(
        self,
        address: Address,
        owner: str,
        patience: float = ATTEMPT_TIME,
        clock: Clock = COMPUTER_CLOCK,
        asks: bool = False,
    ) -> None:
        self.socket = _lock(address, patience, clock, asks)  #: the lock, for the watchdog to inherit
        #: Why the notes of the last owner are not known, '' if they are. The motors count as powered then.
        self.problem = ""
        path = notes_file(address)
        try:
            self.descriptor = _open_notes(path)  #: of the notes, for the watchdog to inherit
        except OSError as error:
            self.problem = f"{path}: {error.strerror}"
            self.descriptor = os.memfd_create("exo_gravity")
            os.ftruncate(self.descriptor, mmap.PAGESIZE)
        self.notes = CommandNotes.from_buffer(mmap.mmap(self.descriptor, mmap.PAGESIZE))  #: the shared page
        self.notes.clock = clock
        if self.notes.is_damaged:
            self.problem = f"{path}: damaged"
        if self.problem:
            self.notes.note(UNKNOWN_COMMAND)
        self.notes.owner = owner
        self.notes.heartbeat = 0.0

    def release(self) -> None:
        """Give up the bus: it is free once the watchdog has ended, too."""
        if not self.notes.command.powered:
            remove_notes(self.descriptor)
        os.close(self.descriptor)
        self.socket.close()


class ArmNotes:
    """The notes of all buses of an arm as one; every bus has the notes of the whole arm.

    pages: of the bus of each joint's motor (n,).
    joints: from 0 on, on whose buses to note; None for all.
    clock: of the times of the notes.
    """

    def __init__(self, pages: Sequence[CommandNotes], joints: Sequence[int] | None = None) -> None:
        self.clock = pages[0].clock
        self._pages = pages
        noted = pages if joints is None else [pages[joint] for joint in joints]
        self.noted = list({id(page): page for page in noted}.values())  #: those of these joints

    def of(self, joints: Sequence[int]) -> "ArmNotes":
        """Return the notes of the buses of these joints alone."""
        return ArmNotes(self._pages, joints)

    def note(self, command: Command) -> None:
        """Note what the motors are about to receive."""
        for page in self.noted:
            page.note(command)

    @property
    def command(self) -> Command:
        """What the motors received last; powered if they may be on on one bus.

        Without torque, under full damping, where that is not known: the notes may be those of another arm.
        """
        commands, count = [page.command for page in self._pages], len(self._pages)
        columns = [
            (command.effort[i], command.damping[i]) if len(command.effort) == count else (0.0, DAMPING)
            for i, command in enumerate(commands)
        ]
        effort, damping = zip(*columns, strict=True)
        return Command(
            effort,
            damping,
            (Send.COMMAND,) * count,
            powered=any(command.powered for command in commands),
            is_unproven=any(command.is_unproven for command in commands),
        )

    @property
    def time(self) -> float:
        """S, of the last note."""
        return max(page.time for page in self.noted)

    @property
    def heartbeat(self) -> float:
        """S, at which the watchdog last ran; 0 before it runs."""
        return self._pages[0].heartbeat


@contextlib.contextmanager
def borrowed(address: Address) -> Iterator[str]:
    """Keep others from the bus at `address`, whose notes stay as they are; yields who holds it already, or ''."""
    try:
        lock = _lock(address, 0.0, COMPUTER_CLOCK, asks=False)
    except BusError:
        yield _holder(address)
        return
    with lock:
        yield ""


def bridge_of(address: Address) -> str:
    """Return who holds the bus at `address`, '' if no process does, or only the watchdog of one that has ended."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.setblocking(False)
        if asking.connect_ex(NAME + bus_name(address)):
            return ""
        process, *_ = CREDENTIALS.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    return _holder(address) if Path(f"/proc/{process}").exists() else ""


def is_asked_for(lock: socket.socket) -> bool:
    """Return whether another process waits for the bus of `lock`, with a connection that is still open."""
    lock.setblocking(False)
    while True:
        try:
            asking, _ = lock.accept()
        except OSError:
            return False
        with asking, contextlib.suppress(ConnectionError):
            asking.setblocking(False)
            try:
                asking.recv(1)  # returns at once if the other end was closed
            except BlockingIOError:
                return True


def notes_file(address: Address) -> Path:
    """Return the path of the bus's notes, the same for every user."""
    usable = (folder for folder in map(Path, FOLDERS) if folder.is_dir() and folder.stat().st_mode & SHARED == SHARED)
    return next(usable, Path(FOLDERS[0])) / f"exo_gravity_{bus_name(address)}.bus"


def bus_name(address: Address) -> str:
    """Return a name of the bus; a serial adapter has the same under each of its names, and so has an interface."""
    interface, channel, options = address
    parts = [interface, channel, *([str(options["port"])] if "port" in options else [])]
    path = Path(channel.partition("@")[0])  # slcan: DEVICE@BITRATE
    with contextlib.suppress(OSError, ValueError):
        if interface == "socketcan":  # it may have alternative names
            parts[1] = socket.if_indextoname(socket.if_nametoindex(channel))
        elif path.is_absolute() and path.is_char_device():
            device = path.stat()
            parts = ["device", str(os.major(device.st_rdev)), str(os.minor(device.st_rdev))]
    return re.sub(r"[^\w.:-]", "_", "_".join(parts))[-80:]


def remove_notes(descriptor: int) -> None:
    """Remove the file of the notes, whose motors are off. Another user's file stays, and says the same."""
    with contextlib.suppress(OSError):
        os.unlink(os.readlink(f"/proc/self/fd/{descriptor}"))


def _open_notes(path: Path) -> int:
    """Return a descriptor of the notes, which any user may write. Raises OSError."""
    try:
        descriptor = os.open(path, os.O_RDWR | FLAGS)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | FLAGS | os.O_CREAT | os.O_EXCL, 0o666)
        os.fchmod(descriptor, 0o666)  # whatever the umask
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:  # another file's link would be overwritten
            raise OSError(errno.EINVAL, "not a regular file with a single link")
        os.posix_fallocate(descriptor, 0, mmap.PAGESIZE)  # without it, a full disk would end the process later
        return descriptor
    except OSError:
        os.close(descriptor)
        raise


def _lock(address: Address, patience: float, clock: Clock, asks: bool) -> socket.socket:
    name, end = NAME + bus_name(address), clock.monotonic() + patience
    with socket.socket(socket.AF_UNIX) as asking:
        asking.setblocking(False)
        while True:
            lock = socket.socket(socket.AF_UNIX)
            try:
                lock.bind(name)
                lock.listen()
                return lock
            except OSError as error:
                lock.close()
                if error.errno != errno.EADDRINUSE:
                    raise BusError(f"CAN bus {address[1]} cannot be locked: {error.strerror}") from error
            asks = asks and asking.connect_ex(name) != 0
            if clock.monotonic() > end:
                raise BusError(f"CAN bus {address[1]} is held by {_holder(address)}")
            clock.sleep(ATTEMPT_PERIOD)


def _holder(address: Address) -> str:
    with contextlib.suppress(OSError, ValueError):
        descriptor = os.open(notes_file(address), os.O_RDONLY | FLAGS)
        with os.fdopen(descriptor, "rb"):
            if owner := CommandNotes.from_buffer_copy(os.pread(descriptor, mmap.PAGESIZE, 0)).owner:
                return owner
    return f"a process that left no notes here, as of another container: `ss -xlp | grep {bus_name(address)}` shows it"
