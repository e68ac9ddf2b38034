# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A serial CAN adapter that speaks the LAWICEL protocol on a pseudo-terminal, between a program and a python-can bus.

Commands end with a carriage return (Lawicel, CANUSB manual): S0 to S8 set the bit rate, O opens, L opens for listening
only, C closes; each is acknowledged with a carriage return. tiiildd.. and Tiiiiiiiildd.. send a frame with an 11-bit or
a 29-bit ID and are acknowledged with z or Z; received frames arrive in the same form. A command that is refused is
answered with BEL.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import sys
import termios
import threading
import tty
from pathlib import Path

import can

BITRATES = {"S0": 10, "S1": 20, "S2": 50, "S3": 100, "S4": 125, "S5": 250, "S6": 500, "S7": 800, "S8": 1000}  # kbit/s
OK, REFUSED = b"\r", b"\a"
FRAME_SENT = (b"z\r", b"Z\r")  # with an 11-bit or a 29-bit ID


class FakeSlcan:
    """The adapter, plugged in at `path` until `close`; `bus` is its wire.

    kbit_s: bit rate that was set. is_open: whether O was received. passed: frames of the program that were sent and
    acknowledged.
    """

    def __init__(self, path: Path, bus: can.BusABC) -> None:
        self.kbit_s = 0
        self.passed = 0
        self.acknowledges = True
        self._path = path
        self._bus = bus
        self.is_open = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.plug_in()

    def plug_in(self) -> None:
        """Appear at `path` as a new device."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        with contextlib.suppress(FileNotFoundError):
            self._path.unlink()
        self._path.symlink_to(os.ttyname(self._slave))
        self.is_open = False
        self._stop.clear()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def unplug(self) -> None:
        """Vanish: the program's next access fails."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        self._thread = None
        self._path.unlink()
        os.close(self._slave)
        os.close(self._master)

    close = unplug

    @property
    def unread(self) -> int:
        """Characters that the program has not yet read."""
        return int.from_bytes(fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)), sys.byteorder)

    def _run(self) -> None:
        rest = b""
        while not self._stop.is_set():
            if select.select([self._master], [], [], 0.0)[0]:
                *lines, rest = (rest + os.read(self._master, 4096)).split(b"\r")
                for line in lines:
                    answer = self._obey(line.decode())
                    self._write(answer)
                    self.passed += answer in FRAME_SENT
            message = self._bus.recv(0.0005)
            if message is not None and self.is_open and not message.is_error_frame and not message.is_fd:
                self._write(_line(message))

    def _write(self, data: bytes) -> None:
        if self.acknowledges or data not in FRAME_SENT:
            os.write(self._master, data)

    def _obey(self, line: str) -> bytes:
        if line in BITRATES and not self.is_open:
            self.kbit_s = BITRATES[line]
        elif line in ("O", "L", "C"):
            self.is_open = line != "C"
        elif line[:1] in ("t", "T") and self.is_open:
            digits = 3 if line[0] == "t" else 8
            data = bytes.fromhex(line[digits + 2 :])
            if len(data) != int(line[digits + 1]):
                return REFUSED
            frame_id = int(line[1 : digits + 1], 16)
            self._bus.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=digits == 8))
            return FRAME_SENT[digits == 8]
        elif line:
            return REFUSED
        return OK


def _line(message: can.Message) -> bytes:
    head = f"T{message.arbitration_id:08X}" if message.is_extended_id else f"t{message.arbitration_id:03X}"
    return f"{head}{message.dlc}{bytes(message.data).hex().upper()}\r".encode()
