# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Ports and ROS domains that other test runs, and the other workers of this one, leave alone."""

import functools
import itertools
import os
import socket
from collections.abc import Iterator

from exo_gravity.hardware.bus_lock import notes_file

FIRST_PORT = 20_000  # of a bus; those of other programs begin at 32,768
BLOCKS, BLOCK = 25, 500  # blocks, and ports in each
DOMAINS = 49  # DDS takes ports from 7,400 on, 250 for each domain: these end below the first of a bus


@functools.cache
def _claim(kind: str, count: int) -> tuple[int, socket.socket | None]:
    """Return a number below `count`, and the lock that keeps other processes from it until this one ends."""
    start = os.getpid()
    for number in (n % count for n in range(start, start + count)):
        lock = socket.socket(socket.AF_UNIX)
        try:
            lock.bind(f"\0exo_gravity_tests/{kind}/{number}")
        except OSError:
            lock.close()
        else:
            return number, lock
    return start % count, None  # shared with a process that may be of another test run


def own_domain() -> int:
    return 1 + _claim("domain", DOMAINS)[0]


@functools.cache
def own_ports() -> Iterator[int]:
    """Return every second port of this process's block, again and again; the ones between are free too.

    Ports whose notes say that motors may be on are skipped. The next owner of such a bus would first let an arm down,
    and a watchdog may still be waiting there for simulated motors that are gone.
    """
    first = FIRST_PORT + BLOCK * _claim("ports", BLOCKS)[0]
    return filter(_is_free, itertools.cycle(range(first, first + BLOCK, 2)))


def _is_free(port: int) -> bool:
    folder = notes_file(("udp_multicast", "", {})).parent
    return not any(folder.glob(f"exo_gravity_*_{port}.bus"))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
