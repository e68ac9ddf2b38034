"""An independent listener on a udp_multicast bus: every frame with the time at which the kernel saw it.

    python -m bench.listener CHANNEL PORT FILE

It opens the bus with python-can, then reads that socket by itself, a hundred times a second and all that waits:
python-can takes 40 us a frame, which the loop under test would miss. The kernel's time stamps make its own lateness
harmless. On SIGTERM it writes FILE (NumPy): `time` (n,) s, `id` (n,), `data` (n, 8) bytes, `length` (n,). Where the
kernel dropped frames its exit code is 1.
"""

from __future__ import annotations

import signal
import socket
import struct
import sys
import threading
from pathlib import Path

import can
import numpy as np
from can.interfaces.udp_multicast.utils import unpack_message

SO_RXQ_OVFL = 40  # the kernel counts what it dropped
SO_TIMESTAMPNS = 35
PERIOD = 0.01  # s between two looks
BUFFER = 4_000_000  # bytes, of which the kernel may give less
ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)


def listen(bus: can.BusABC, stopping: threading.Event) -> tuple[list[tuple[float, bytes]], int]:
    """Return (time, datagram) of everything until `stopping` is set, and how many datagrams the kernel dropped."""
    sock = socket.socket(fileno=socket.dup(bus.fileno()))
    sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
    sock.setblocking(False)
    taken, dropped = [], 0
    while True:
        ending = stopping.wait(PERIOD)
        try:
            while True:
                data, ancillary, _, _ = sock.recvmsg(512, ANCILLARY)
                about = {kind: value for _, kind, value in ancillary}
                seconds, nanoseconds = struct.unpack("@ll", about[SO_TIMESTAMPNS])
                taken.append((seconds + nanoseconds * 1e-9, data))
                if SO_RXQ_OVFL in about:
                    dropped = struct.unpack("@I", about[SO_RXQ_OVFL])[0]
        except BlockingIOError:
            if ending:
                return taken, dropped


def save(taken: list[tuple[float, bytes]], path: Path) -> None:
    """Write the frames as arrays."""
    messages = [unpack_message(data) for _, data in taken]
    np.savez(
        path,
        time=np.array([time for time, _ in taken]),
        id=np.array([message.arbitration_id for message in messages]),
        length=np.array([len(message.data) for message in messages]),
        data=np.array([list(bytes(message.data).ljust(8, b"\0")) for message in messages], dtype=np.uint8),
    )


def main() -> int:
    """Listen until SIGTERM."""
    channel, port, path = sys.argv[1:]
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    with can.Bus(interface="udp_multicast", channel=channel, port=int(port), hop_limit=0) as bus:
        taken, dropped = listen(bus, stopping)
    save(taken, Path(path))
    return int(dropped > 0)


if __name__ == "__main__":
    sys.exit(main())
