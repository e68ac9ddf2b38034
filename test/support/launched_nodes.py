# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Real nodes as processes, started by the launcher from a parameter file that a test has changed."""

from __future__ import annotations

import contextlib
import copy
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.hardware.bus_lock import notes_file
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.processes import Launcher, wearers

from . import CONFIG
from .ports import free_port, own_ports

Parameters = Mapping[str, Any]

PORTS = own_ports()
GROUP = "239.74.163.2"
NO_IMU: Parameters = {"use_imu": False}  # for the compensator, which then starts without waiting for a tilt
FAST: Parameters = {"sign_check_torque": 0.0}
# Rate and time-outs of config/sim.yaml, which suit a busy machine, and those of a real device.
SIMULATED: dict[str, Parameters] = {
    "can_bridge": {"rate": 100.0, "command_timeout": 0.1, "frozen_timeout": 0.08},
    "compensator": {"tilt_timeout": 0.5},
}
# The same at half the rates: all nodes and the test take about half of a core.
CALM: dict[str, Parameters] = {
    "can_bridge": {**SIMULATED["can_bridge"], "rate": 50.0},
    "compensator": SIMULATED["compensator"],
    "imu": {"rate": 50.0},
    "simulator": {"imu.rate": 50.0},
}
REAL: dict[str, Parameters] = {
    "can_bridge": {"rate": 250.0, "command_timeout": 0.05, "frozen_timeout": 0.08},
    "compensator": {"tilt_timeout": 0.08},
}


class LaunchedNodes:
    """The nodes of a parameter file, on a CAN bus of their own.

    base: the file in config/. without: nodes to leave out, by the last part of their names. port: of the bus, a new one
    by default; the left arm's bus has the next one. timing: rate and time-outs by node, `SIMULATED`, `CALM` or `REAL`.
    changes: of the parameters, by node, for both arms; they come last, after `FAST` for the bridge. truth: whether
    simulators log the arm's true motion, at `truth_path`. one_process: of the launcher. wearer: whether a `wearer` runs
    beside each compensator, as for users: most tests spare its processor time. The attribute `ended_node` is what
    `Launcher.run` returned.

    Nodes that have started run before other processes, if permitted: others that start would keep them waiting.
    """

    def __init__(
        self,
        folder: Path,
        base: str | Path = "sim.yaml",
        without: Iterable[str] = (),
        port: int | None = None,
        timing: Mapping[str, Parameters] = SIMULATED,
        truth: bool = False,
        one_process: bool = False,
        wearer: bool = False,
        **changes: Parameters,
    ) -> None:
        port = port or next(PORTS)
        self.folder = folder
        content = yaml.safe_load((CONFIG / base).read_text())
        content = {name: entry for name, entry in content.items() if name.split("/")[-1] not in without}
        for name, entry in content.items():
            node, parameters = name.split("/")[-1], entry["ros__parameters"]
            if "can" in parameters:
                parameters["can"]["options"]["port"] = port + name.startswith("/left")
            if truth and node == "simulator":
                parameters["truth"] = str(self.truth_path(name))
            parameters.update(FAST if node == "can_bridge" else {})
            parameters.update(timing.get(node, {}))
            parameters.update(copy.deepcopy(changes.get(node, {})))  # ROS reads no YAML aliases
        unknown = set(changes) - {name.split("/")[-1] for name in content}
        assert not unknown, f"changes of nodes that are left out: {unknown}"
        given = (entry["ros__parameters"].get("can") for entry in content.values())
        channel = next((can["channel"] for can in given if can), GROUP)
        self.bus: dict[str, Any] = {"interface": "udp_multicast", "channel": channel, "port": port, "hop_limit": 0}
        self.path = folder / f"params_{port}_{'_'.join(without)}.yaml"
        self.path.write_text(yaml.safe_dump(content))
        self.one_process = one_process
        self.wearer = wearer
        self.log: list[str] = []
        self.stopping = threading.Event()
        self.ended_node: tuple[str, int] | None = None
        self._thread: threading.Thread | None = None

    def add(self, name: str, **parameters: Any) -> None:
        """Add a node to the file, before the start. name: its full name."""
        content = yaml.safe_load(self.path.read_text())
        self.path.write_text(yaml.safe_dump({**content, name: {"ros__parameters": parameters}}))

    def add_panel(self, **parameters: Any) -> str:
        """Add the panel; return the address of its page."""
        port = free_port()
        self.add("/panel", port=port, output=str(self.folder / "out"), **parameters)
        return f"http://127.0.0.1:{port}/"

    @property
    def names(self) -> list[str]:
        nodes = load(self.path)
        return [*nodes, *(wearers(nodes) if self.wearer else ())]

    def has_started(self) -> bool:
        return self._thread is not None

    def start(self) -> LaunchedNodes:
        self.launcher = Launcher(self.path, self._on_line, self.names, one_process=self.one_process)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def _on_line(self, node: str, line: str) -> None:
        self.log.append(f"{node}: {line}")

    def _run(self) -> None:
        self.ended_node = self.launcher.run(self.stopping)

    @property
    def have_ended(self) -> bool:
        return self._thread is not None and not self._thread.is_alive()

    def process(self, node: str) -> subprocess.Popen[str]:
        """Return the process of a node by the last part of its name, or by its full name."""
        return self.launcher.process(full_name(node))

    def pid(self, node: str) -> int:
        return self.process(node).pid

    def truth_path(self, node: str = "/right/simulator") -> Path:
        """Return the path of a simulator's truth log."""
        return self.folder / f"truth{node.replace('/', '_')}.bin"

    def stop(self) -> None:
        self.stopping.set()
        if self._thread is not None:
            self._thread.join(60)
        self._end_watchdogs()

    def _end_watchdogs(self) -> None:
        """End watchdogs that retry forever, because their simulated motors are gone, and remove their notes."""
        ports = (self.bus["port"], self.bus["port"] + 1)  # of the right and of the left arm
        names = [f"{self.bus['channel']}_{port}.bus" for port in ports]
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if b"hardware.watchdog" in (process / "cmdline").read_bytes() and any(
                    name in os.readlink(descriptor) for descriptor in (process / "fd").iterdir() for name in names
                ):
                    os.kill(int(process.name), signal.SIGKILL)
        for port in ports:
            notes_file((self.bus["interface"], self.bus["channel"], {"port": port})).unlink(missing_ok=True)


def executable(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def full_name(node: str) -> str:
    """Return the full name of a node of the right arm, or of the IMU that serves both arms."""
    if node.startswith("/"):
        return node
    return "/imu" if node == "imu" else f"/right/{node}"


def children(pid: int) -> list[int]:
    return [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]
