# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The kinds of rig: which nodes run, in which processes, and what the arm is like."""

from __future__ import annotations

import math
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, ClassVar

from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock

from ..support.launched_nodes import NO_IMU, LaunchedNodes, Parameters, children, executable
from ..support.ros_probe import RosProbe
from ..support.truth import Truth
from .rig import CARRY_LIMIT, NEAR, Rig
from .virtual_cases import SEVEN


def variant(base: type[Rig], /, **attributes: Any) -> type[Rig]:
    """Return a rig with other parameters."""
    return type(f"{base.__name__} with {', '.join(attributes)}", (base,), attributes)


class TwoLaunchersRig(Rig):
    """The compensator has its own launcher: when it dies, the other nodes run on."""

    simulator: ClassVar[Parameters] = {"trunk": {"pitch": 0.0, "roll": 0.0}}

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        bridge = {"rate": self.rate}
        others = self._nodes(without=("compensator", "imu", "simulator"), port=port, can_bridge=bridge)
        compensator = self._nodes(without=("can_bridge", "simulator", "imu"), port=port, compensator=NO_IMU)
        return [others, compensator]


class ExternalClockRig(Rig):
    """Bridge and compensator use /clock, which this process publishes, `clock_offset` s off the system's clock."""

    without = ("imu", "simulator")
    bridge: ClassVar[Parameters] = {"use_sim_time": True}
    compensator: ClassVar[Parameters] = {"use_sim_time": True, **NO_IMU}
    simulator: ClassVar[Parameters] = {"trunk": {"pitch": 0.0, "roll": 0.0}}

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self.clock_offset = 0.0
        self._publisher = self.probe.node.create_publisher(Clock, "/clock", 10)
        self.probe.node.create_timer(0.002, self._publish_clock)
        self.probe.executor.wake()

    def _publish_clock(self) -> None:
        fraction, seconds = math.modf(time.time() + self.clock_offset)
        self._publisher.publish(Clock(clock=Time(sec=int(seconds), nanosec=int(fraction * 1e9))))


class LauncherProcess(LaunchedNodes):
    """Nodes whose launcher is a process too, as for users."""

    def start(self) -> LauncherProcess:
        self.launcher_process = subprocess.Popen(
            [
                executable("launcher"),
                "--params",
                str(self.path),
                "--only",
                *self.names,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        return self

    def _read(self) -> None:
        for line in self.launcher_process.stdout or ():
            self.log.append(line.rstrip())

    @property
    def have_ended(self) -> bool:
        return self.launcher_process.poll() is not None

    def pid(self, node: str) -> int:
        """Return the ID of a node's process, which must run."""
        for child in children(self.launcher_process.pid):
            if f"__node:={node}".encode() in Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0"):
                return child
        raise LookupError(f"{node} does not run")

    def stop(self) -> None:
        self.launcher_process.terminate()
        try:
            self.launcher_process.wait(60)
        except subprocess.TimeoutExpired:
            self.launcher_process.kill()
            raise
        if self._thread is not None:
            self._thread.join(60)
        self._end_watchdogs()


class LauncherRig(Rig):
    """The launcher is a process, as for users; `launcher` is that process."""

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        self._launcher = LauncherProcess(self.folder, without=self.without, port=port, timing=self.timing)
        return [self._launcher]

    @property
    def launcher(self) -> subprocess.Popen[str]:
        return self._launcher.launcher_process


class HandedOverRig(LauncherRig):
    """An arm whose watchdog is alone with silent motors, and the next bridge."""

    next_bridge: subprocess.Popen[str] | None = None

    @property
    def log_of_next(self) -> Path:
        return self.folder / "next_bridge.log"

    def close(self) -> None:
        if self.next_bridge is not None:
            self._bridges.add(self.next_bridge.pid)
            self.next_bridge.kill()
            self.next_bridge.wait()
        super().close()


class BothArmsRig(Rig):
    """Both arms at 100 Hz; faults strike the right one. `left` probes the left arm, `left_truth` is its motion."""

    base = "sim_both.yaml"
    rate = 100.0

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self.left = RosProbe("/left")
        self.left_truth = Truth(self.nodes[-1].truth_path("/left/simulator"))

    def bring_to(self, stage: str) -> None:
        with self.left.time_limit(CARRY_LIMIT):
            newest = self.left_truth.newest()
            if self.left.state != "active" or newest is None or abs(newest["position"][1] - self.pose[1]) > NEAR:
                self.left.wait_until(lambda: self.left.state)
                self.left.get_carried()
                self.left.bring_to(self.script)
        super().bring_to(stage)

    def close(self) -> None:
        super().close()
        self.left.close()


V3: Parameters = {"wire_format": ["mit_v3"] * 4}  # of the motors' boards
V3Rig = variant(Rig, bridge=V3, simulator=V3)
TwoBusRig = variant(Rig, two_buses=True)  # motors 3 and 4 are on a second bus
SignCheckRig = variant(Rig, bridge={"sign_check_torque": 1.5})
SevenRig = variant(Rig, base=SEVEN.base, pose=SEVEN.pose)  # Damiao motors on CAN FD
