# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wire between two computers: passes Ethernet frames between two interfaces, late, and not all of them.

Frames keep their order. Address resolution (ARP) is never lost. A frame that was sent to a virtual interface may lack
the UDP checksum that hardware would add; it is set to 0, which means none (RFC 768).

At the end one line of JSON: frames passed and lost, and by how much the latest was late beyond the wire's own delay.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import select
import socket
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

from test.two_computers.network import Wire

ALL_PROTOCOLS = 0x0003
OUTGOING = 4  # packet type of what this process sent itself
ARP, IPV4 = b"\x08\x06", b"\x08\x00"
UDP = 17
LARGEST = 65_535  # bytes


class Direction:
    """Frames from one interface to the other."""

    def __init__(self, source: socket.socket, target: socket.socket, wire: Wire, seed: int) -> None:
        self.source = source
        self.lost = self.passed = 0
        self.latest = 0.0  # s by which a frame left after it was due
        self._target, self._wire = target, wire
        self._random = random.Random(seed)
        self._queue: deque[tuple[float, bytes]] = deque()

    @property
    def due(self) -> float:
        """Monotonic time in s at which the next frame leaves; infinity without one."""
        return self._queue[0][0] if self._queue else float("inf")

    def receive(self, now: float) -> None:
        """Take one frame from the source."""
        frame, address = self.source.recvfrom(LARGEST)
        if address[2] == OUTGOING:
            return
        if frame[12:14] != ARP and self._random.random() < self._wire.loss:
            self.lost += 1
            return
        leaves = now + 1e-3 * (self._wire.delay + self._wire.jitter * self._random.random())
        previous = self._queue[-1][0] if self._queue else leaves
        self._queue.append((max(leaves, previous), _without_checksum(frame)))

    def send(self, now: float) -> None:
        """Send the frames that are due."""
        while self.due <= now:
            due, frame = self._queue.popleft()
            self.latest = max(self.latest, now - due)
            self._target.send(frame)
            self.passed += 1


def _without_checksum(frame: bytes) -> bytes:
    if frame[12:14] != IPV4 or frame[23] != UDP or (frame[20] & 0x1F) or frame[21]:  # not UDP, or a later fragment
        return frame
    checksum = 14 + 4 * (frame[14] & 0x0F) + 6
    return frame[:checksum] + b"\0\0" + frame[checksum + 2 :]


def _open(interface: str) -> socket.socket:
    packets = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ALL_PROTOCOLS))
    packets.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    packets.bind((interface, ALL_PROTOCOLS))
    return packets


def main(first: str, second: str, *words: str) -> None:
    """Forward until the standard input closes. words: `delay=5.0` and so on, the fields of `Wire`."""
    wire = Wire(**{key: float(value) for key, _, value in (word.partition("=") for word in words)})
    a, b = _open(first), _open(second)
    directions = (Direction(a, b, wire, seed=1), Direction(b, a, wire, seed=2))
    by_socket = {direction.source: direction for direction in directions}
    if Path("/proc/sys/net/ipv4/ip_forward").read_text().strip() != "0":
        raise SystemExit("the kernel forwards packets in this namespace: the wire would not be the only way")
    with contextlib.suppress(OSError):  # not permitted without root; the nodes have a high priority too
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    print("ready", flush=True)
    while True:
        wait = min(direction.due for direction in directions) - time.monotonic()
        ready: list[Any] = select.select([*by_socket, sys.stdin], [], [], max(0.0, wait) if wait < 1.0 else 1.0)[0]
        if sys.stdin in ready:
            break
        now = time.monotonic()
        for source in ready:
            by_socket[source].receive(now)
        for direction in directions:
            direction.send(now)
    latest = 1000.0 * max(direction.latest for direction in directions)
    passed, lost = (sum(getattr(d, name) for d in directions) for name in ("passed", "lost"))
    print(json.dumps({"passed": passed, "lost": lost, "latest": latest}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
