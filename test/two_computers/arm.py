# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One arm on two computers: bridge, IMU and simulated device on the robot; compensator, wearer, recorder on a desk."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..support.launched_nodes import REAL, LaunchedNodes, Parameters, executable
from .network import ADDRESSES, ROOT, Network

POSE = [0.1, 0.8, 0.7, 0.6]  # rad
MOVE = 2.0  # s
PARTS: dict[str, tuple[str, ...]] = {
    "robot": ("/imu", "/right/can_bridge", "/right/simulator", "/robot/recorder"),
    "desk": ("/right/compensator", "/right/wearer", "/recorder"),
}
PEERS = {"robot": ADDRESSES["desk"], "desk": ADDRESSES["robot"]}
STOP_TIMEOUT = 60.0  # s

Line = dict[str, Any]  # what the recorder on the robot prints ten times a second


def write_parameters(folder: Path, hold: float, timing: Mapping[str, Parameters] = REAL) -> Path:
    """Write script and parameter file of an arm that the wearer brings to POSE and lets go for `hold` s."""
    script = folder / "hold.yaml"
    script.write_text(yaml.safe_dump({"name": "hold", "steps": [{"move": POSE, "over": MOVE}, {"hold": hold}]}))
    nodes = LaunchedNodes(folder, timing=timing, truth=True, simulator={"trial": str(script), "trial_delay": 3.0})
    content = yaml.safe_load(nodes.path.read_text())
    for node, name in (("/robot/recorder", "robot"), ("/recorder", "desk")):
        content[node] = {"ros__parameters": {"output": str(folder / f"bag_{name}"), "live": name == "robot"}}
    path = folder / "params.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


class TwoComputers:
    """The nodes of `params` on both computers of `network`, within a `with` block. log: their lines, by computer.

    peers: address that each computer names in ROS_STATIC_PEERS, '' for none.
    """

    def __init__(self, network: Network, params: Path, peers: Mapping[str, str] = PEERS) -> None:
        self.log: dict[str, list[str]] = {name: [] for name in PARTS}
        self.lines: list[tuple[float, Line]] = []  # wall clock in s, and what the recorder printed
        self._news: queue.Queue[None] = queue.Queue()
        self._network, self._params, self._peers = network, params, peers
        self._launchers: dict[str, subprocess.Popen[str]] = {}
        self._readers: list[threading.Thread] = []

    def __enter__(self) -> TwoComputers:
        for computer in ("desk", "robot"):
            self._start(computer)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Stop the robot's nodes, which lets the arm down, then the desk's."""
        for computer in ("robot", "desk"):
            launcher = self._launchers.pop(computer, None)
            if launcher is None:
                continue
            launcher.terminate()
            try:
                launcher.wait(STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                launcher.kill()
        for reader in self._readers:
            reader.join(STOP_TIMEOUT)

    def wait_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait for the recorder's lines until `condition()` holds; return whether it does within `timeout` s."""
        end = time.monotonic() + timeout
        while not condition():
            try:
                self._news.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                return condition()
        return True

    @property
    def bridge(self) -> Line:
        """The newest status of the bridge, empty before the first."""
        return dict(self.lines[-1][1].get("status", {}).get("right/can_bridge", {})) if self.lines else {}

    @property
    def action(self) -> str:
        """What the virtual wearer does: 'move', 'hold' or 'done', and '' before that."""
        return str(self.lines[-1][1].get("right", {}).get("step", {}).get("action", "")) if self.lines else ""

    def _start(self, computer: str) -> None:
        environment = {
            "PYTHONPATH": str(ROOT),
            "ROS_STATIC_PEERS": self._peers[computer],
        }
        command = [executable("launcher"), "--params", str(self._params), "--only", *PARTS[computer]]
        launcher = self._network.start(computer, command, environment)
        self._launchers[computer] = launcher
        reader = threading.Thread(target=self._read, args=(computer, launcher), daemon=True)
        reader.start()
        self._readers.append(reader)

    def _read(self, computer: str, launcher: subprocess.Popen[str]) -> None:
        for text in launcher.stdout or ():
            _, brace, rest = text.partition(" {")
            if not brace:
                self.log[computer].append(text.rstrip())
                continue
            try:
                self.lines.append((time.time(), json.loads("{" + rest)))
            except ValueError:
                continue
            self._news.put(None)
