# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Measures a wire with numbered datagrams: `echo ADDRESS` sends them back, `count ADDRESS NUMBER` prints each time."""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import threading
import time

PORT = 5005
PERIOD = 0.002  # s between two datagrams
PATIENCE = 1.0  # s without a datagram after which no more are expected


def echo(address: str) -> None:
    """Send every datagram back until PATIENCE is over after the first one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver, contextlib.suppress(TimeoutError):
        receiver.bind((address, PORT))
        print("ready", flush=True)
        while True:
            data, sender = receiver.recvfrom(100)
            receiver.settimeout(PATIENCE)
            receiver.sendto(data, sender)


def count(address: str, number: int) -> None:
    """Print the round-trip times in s of the datagrams that return, by their numbers, as a list of pairs."""
    sent, back = dict[int, float](), list[tuple[int, float]]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("", 0))
        sender.settimeout(PATIENCE)

        def receive() -> None:
            with contextlib.suppress(TimeoutError):
                while True:
                    index = int(sender.recv(100))
                    back.append((index, time.monotonic() - sent[index]))

        receiving = threading.Thread(target=receive)
        receiving.start()
        for index in range(number):
            sent[index] = time.monotonic()
            sender.sendto(str(index).encode(), (address, PORT))
            time.sleep(PERIOD)
        receiving.join()
    print(json.dumps(back))


if __name__ == "__main__":
    echo(sys.argv[2]) if sys.argv[1] == "echo" else count(sys.argv[2], int(sys.argv[3]))
