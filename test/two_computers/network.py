# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Two computers in network namespaces, joined by a wire with delay, jitter and loss.

    robot eth0 -- veth -- [ forwarder ] -- veth -- eth0 desk

No namespace has another interface, so that nothing leaves this machine. The kernel may lack netem: the forwarder is a
separate process (forwarder.py). Without root, a user namespace permits all of this.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

ROOT = Path(__file__).parents[2]
ADDRESSES = {"robot": "10.77.0.1", "desk": "10.77.0.2"}
START_TIMEOUT = 20.0  # s
# Ends with its standard input, and with it the namespace.
HOLDER = ("sh", "-c", "echo ready; read _")


@dataclass(frozen=True)
class Wire:
    """delay: ms one way. jitter: ms added at random, at most. loss: share each way. Packets keep their order."""

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0


class Network:
    """The namespaces `robot` and `desk`, and the forwarder between them, within a `with` block.

    traffic: after the block, frames `passed` and `lost`, and by how many ms the `latest` was late because this computer
    was busy.
    """

    def __init__(self, wire: Wire) -> None:
        self.traffic: dict[str, float] = {}
        self._wire = wire
        self._processes: list[subprocess.Popen[str]] = []
        self._namespaces: dict[str, int] = {}  # name -> PID of its holder

    def __enter__(self) -> Network:
        try:
            self._make()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        assert self._forwarder.stdin is not None and self._forwarder.stdout is not None
        self._forwarder.stdin.close()
        self.traffic = json.loads(self._forwarder.stdout.readline())
        self._end()

    def start(self, computer: str, command: Sequence[str], environment: Mapping[str, str]) -> subprocess.Popen[str]:
        """Start `command` on a computer; the caller reads its output and ends it."""
        return self._popen([*self._enter(computer), *command], {**os.environ, **environment})

    def _make(self) -> None:
        new_user = [] if os.getuid() == 0 else ["--user", "--map-root-user"]
        self._hold("wire", ["unshare", *new_user, "--net"])
        for name in ADDRESSES:
            self._hold(name, [*self._enter("wire"), "unshare", "--net"])
        for name, address in ADDRESSES.items():
            self._ip("wire", f"link add {name} type veth peer name eth0 netns {self._namespaces[name]}")
            self._ip("wire", f"link set {name} up")
            for command in (
                "link set lo up",
                f"address add {address}/24 dev eth0",
                "link set eth0 up",
                "route add 224.0.0.0/4 dev eth0",  # for the CAN bus over UDP, whose frames never leave (hop limit 0)
            ):
                self._ip(name, command)
        words = [f"{key}={value}" for key, value in asdict(self._wire).items()]
        forwarder = [sys.executable, "-m", "test.two_computers.forwarder", *ADDRESSES, *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self._forwarder = self._wait_until_ready(self._popen([*self._enter("wire"), *forwarder], environment))

    def _hold(self, name: str, unshare: Sequence[str]) -> None:
        self._namespaces[name] = self._wait_until_ready(self._popen([*unshare, *HOLDER])).pid

    def _enter(self, name: str) -> list[str]:
        user = [] if os.getuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._namespaces[name]), *user, "--net"]

    def _ip(self, name: str, arguments: str) -> None:
        subprocess.run([*self._enter(name), "ip", *arguments.split()], check=True, timeout=START_TIMEOUT)

    def _popen(self, command: Sequence[str], environment: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        process = subprocess.Popen(command, env=environment, cwd=ROOT, start_new_session=True, **pipes)
        self._processes.append(process)
        return process

    def _wait_until_ready(self, process: subprocess.Popen[str]) -> subprocess.Popen[str]:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise RuntimeError(f"{process.args!r}: ended with exit code {process.wait()}")
        return process

    def _end(self) -> None:
        """End every process in the namespaces, also those that were left behind, and with them the namespaces."""
        holders = set(self._namespaces.values())
        spaces = {os.readlink(f"/proc/{holder}/ns/net") for holder in holders}
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if int(process.name) not in holders and os.readlink(process / "ns/net") in spaces:
                    os.kill(int(process.name), signal.SIGKILL)
        for started in self._processes:
            if started.stdin is not None and not started.stdin.closed:
                started.stdin.close()
            started.wait(START_TIMEOUT)
