"""Real nodes as processes, started by the launcher from a parameter file that a test has changed."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.tools.launcher import Launcher

from . import CONFIG

Parameters = Mapping[str, Any]

PORTS = itertools.count(20_000 + os.getpid() % 100 * 100)  # of test buses; 100 for each process
NO_IMU: Parameters = {"use_imu": False}  # for the compensator, which then starts without waiting for a tilt
FAST: Parameters = {"sign_check_torque": 0.0, "ramp_time": 0.5, "fade_time": 0.5, "damping": 1.5}
GENTLE: Parameters = {**FAST, "ramp_time": 1.0, "fade_time": 2.0, "damping": 5.0}
# Rate and time-outs of config/sim.yaml, which suit a busy machine, and those of a real device.
SIMULATED: dict[str, Parameters] = {
    "can_bridge": {"rate": 100.0, "command_timeout": 0.1, "reply_timeout": 0.1},
    "compensator": {"tilt_timeout": 0.5},
}
REAL: dict[str, Parameters] = {
    "can_bridge": {"rate": 250.0, "command_timeout": 0.05, "reply_timeout": 0.05},
    "compensator": {"tilt_timeout": 0.08},
}


class LaunchedNodes:
    """The nodes of a parameter file on their own CAN bus.

    base: the file in config/. without: nodes to leave out, by the last part of their names. port: of the bus, a new one
    by default. timing: rate and time-outs by node, `SIMULATED` or `REAL`. changes: of the parameters, by node; they
    come last, after `FAST` for the bridge. The attribute `ended_node` is what `Launcher.run` returned.
    """

    def __init__(
        self,
        folder: Path,
        base: str | Path = "sim.yaml",
        without: Iterable[str] = (),
        port: int | None = None,
        timing: Mapping[str, Parameters] = SIMULATED,
        **changes: Parameters,
    ) -> None:
        port = port or next(PORTS)
        content = yaml.safe_load((CONFIG / base).read_text())
        content = {name: entry for name, entry in content.items() if name.split("/")[-1] not in without}
        for name, entry in content.items():
            node, parameters = name.split("/")[-1], entry["ros__parameters"]
            if "can" in parameters:
                parameters["can"]["options"]["port"] = port
            parameters.update(FAST if node == "can_bridge" else {})
            parameters.update(timing.get(node, {}))
        for node, values in changes.items():
            content[full_name(node)]["ros__parameters"].update(values)
        self.bus: dict[str, Any] = {
            "interface": "udp_multicast",
            "channel": "239.74.163.2",
            "port": port,
            "hop_limit": 0,
        }
        self.path = folder / f"params_{port}_{'_'.join(without)}.yaml"
        self.path.write_text(yaml.safe_dump(content))
        self.log: list[str] = []
        self.stopping = threading.Event()
        self.ended_node: tuple[str, int] | None = None

    def start(self) -> LaunchedNodes:
        self.launcher = Launcher(self.path, on_line=lambda node, line: self.log.append(f"{node}: {line}"))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def _run(self) -> None:
        self.ended_node = self.launcher.run(self.stopping)

    @property
    def have_ended(self) -> bool:
        """Whether every process has ended."""
        return not self._thread.is_alive()

    def process(self, node: str) -> subprocess.Popen[str]:
        """Return the process of a node by the last part of its name."""
        return self.launcher.process(full_name(node))

    def stop(self) -> None:
        self.stopping.set()
        self._thread.join(60)


class LauncherProcess(LaunchedNodes):
    """The same, but the launcher is a process too, as for users."""

    def start(self) -> LauncherProcess:
        self.launcher_process = subprocess.Popen(
            [executable("launcher"), "--params", str(self.path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        return self

    @property
    def have_ended(self) -> bool:
        return self.launcher_process.poll() is not None

    def stop(self) -> None:
        self.launcher_process.terminate()
        self.log += self.launcher_process.communicate(timeout=60)[0].splitlines()


def executable(name: str) -> str:
    """Return the path of an installed executable of the package."""
    return str(Path(sys.executable).with_name(name))


def full_name(node: str) -> str:
    """Return the full name of a node of the right arm, or of the IMU that serves both arms."""
    return "/imu" if node == "imu" else f"/right/{node}"
