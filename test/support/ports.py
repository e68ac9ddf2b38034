"""Ports that other test runs, and the other workers of this one, leave alone."""

from __future__ import annotations

import itertools
import os
import socket
from collections.abc import Iterator

BLOCKS, BLOCK = 25, 400  # blocks, and ports in each
WORKERS = 4  # whose blocks are certain to differ


def own_ports(first: int) -> Iterator[int]:
    """Return every second port of a block of this process's own, from `first` on; the ones between are free too."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    run, number = (os.getppid(), int(worker[2:])) if worker else (os.getpid(), 0)
    return itertools.count(first + BLOCK * ((WORKERS * run + number) % BLOCKS), 2)


def free_port() -> int:
    """Return a TCP port of loopback that is free."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
