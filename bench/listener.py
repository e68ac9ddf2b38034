# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An independent listener on a udp_multicast bus: it records every frame with the kernel's time stamp.

    python -m bench.listener CHANNEL PORT FILE

It opens the bus with python-can, then reads the socket directly, all waiting datagrams a hundred times a second:
python-can takes 40 us per frame, which would slow down the loop under test. The listener's own delays do not matter,
because the kernel stamps the frames. On SIGTERM it writes FILE (NumPy): `time` (n,) s, `id` (n,), `data` (n, 8) bytes,
`length` (n,). Its exit code is 1 if the kernel dropped frames.
"""

import signal
import socket
import struct
import sys
import threading
from pathlib import Path

import can
import numpy as np
from can.interfaces.udp_multicast.utils import unpack_message

SO_RXQ_OVFL = 40  # the kernel counts the datagrams that it dropped
SO_TIMESTAMPNS = 35
PERIOD = 0.01  # s between two reads
BUFFER = 4_000_000  # bytes; the kernel may grant less
ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)

Datagrams = list[tuple[float, bytes]]  # time in s, content


def listen(bus: can.BusABC, stopping: threading.Event) -> tuple[Datagrams, int]:
    """Return all datagrams until `stopping` is set, and how many the kernel dropped."""
    sock = socket.socket(fileno=socket.dup(bus.fileno()))
    sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
    sock.setblocking(False)
    datagrams: Datagrams = []
    dropped = 0
    while True:
        ending = stopping.wait(PERIOD)
        try:
            while True:
                data, ancillary, _, _ = sock.recvmsg(512, ANCILLARY)
                values = {kind: value for _, kind, value in ancillary}
                seconds, nanoseconds = struct.unpack("@ll", values[SO_TIMESTAMPNS])
                datagrams.append((seconds + nanoseconds * 1e-9, data))
                if SO_RXQ_OVFL in values:
                    dropped = struct.unpack("@I", values[SO_RXQ_OVFL])[0]
        except BlockingIOError:
            if ending:
                return datagrams, dropped


def save(datagrams: Datagrams, path: Path) -> None:
    """Write the frames as arrays."""
    messages = [unpack_message(data) for _, data in datagrams]
    np.savez(
        path,
        time=np.array([time for time, _ in datagrams]),
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
        datagrams, dropped = listen(bus, stopping)
    save(datagrams, Path(path))
    return int(dropped > 0)


if __name__ == "__main__":
    sys.exit(main())
