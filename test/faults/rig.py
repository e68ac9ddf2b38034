# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rig on which faults are tried: nodes as processes that carry a simulated arm, and the arm's true motion.

The simulated device always has its own launcher: it outlives the other nodes, so that the judge sees the arm after its
motors were switched off.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml

from exo_gravity.core.motors.joint_motor import JointMotor, motors_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.hardware.clock import favour
from exo_gravity.lab.inputs.arms import node_values
from exo_gravity.lab.inputs.parameter_file import load

from ..support import CONFIG
from ..support.launched_nodes import REAL, SIMULATED, LaunchedNodes, Parameters, children, full_name
from ..support.ros_probe import RosProbe
from ..support.truth import Truth
from .fault_case import CARRYING

RAISED = (0.0, 1.3, 0.0, 0.3)  # rad, nearly horizontal
NEAR = 0.15  # rad from the pose, in which the arm need not be moved again
CARRY_LIMIT = 60.0  # s for the nodes to start and bring the arm to a stage


class Rig:
    """Nodes that carry the arm in `pose`, with a probe and the arm's true motion. End it with `close`.

    shipped_timeouts: whether the nodes have their default time-outs, or longer ones for a busy machine.
    struck: the joint (0..) whose motor is the one that fails; it carries much of the arm's weight.
    bridge, compensator, simulator: the nodes' parameters, apart from those of the configuration `base`. two_buses:
    whether motors 3 and 4 are on a second bus. without: nodes that do not run, or not with the bridge.
    """

    two_buses = False
    without: Sequence[str] = ("simulator",)
    base = "sim.yaml"
    rate = 250.0  # Hz
    pose: Sequence[float] = RAISED
    struck = 1
    bridge: ClassVar[Parameters] = {}
    compensator: ClassVar[Parameters] = {}
    simulator: ClassVar[Parameters] = {}

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        favour(5)  # what the probe receives, and a rig may command, is in time
        self.folder, self.shipped_timeouts = folder, shipped_timeouts
        self.script = self.write_script("pose", [{"move": list(self.pose), "over": 1.0}, {"hold": 600.0}])
        self.probe = RosProbe()
        self.probe.home_script = self.write_script("home", [{"move": self.home, "over": over} for over in (2.0, 20.0)])
        device = self._device_nodes()
        self.nodes = [*self._make_nodes(device.bus["port"]), device]
        self.truth = Truth(device.truth_path(), len(self.motors))
        self._bridges: set[int] = set()  # IDs of their processes
        self.second_bridge: tuple[int | None, list[str]] = (None, [])  # exit code and log of the last one started

    def start(self) -> None:
        """Start the nodes, the simulated device first."""
        for nodes in reversed(self.nodes):
            nodes.start()

    @cached_property
    def motors(self) -> tuple[JointMotor, ...]:
        """The motors of the configuration."""
        return motors_of(node_values(load(CONFIG / self.base), "/right/can_bridge", CAN_BRIDGE))

    @property
    def home(self) -> list[float]:
        """A pose (n,) in rad near to hanging, within the limits."""
        return [0.0, *[0.05] * (len(self.motors) - 1)]

    @property
    def timing(self) -> Mapping[str, Parameters]:
        """Rate and time-outs of the nodes."""
        return REAL if self.shipped_timeouts else SIMULATED

    def write_script(self, name: str, steps: Sequence[Mapping[str, Any]]) -> Path:
        """Write a trial script and return its path."""
        path = self.folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump({"name": name, "steps": [*map(dict, steps)]}))
        return path

    def _device_nodes(self) -> LaunchedNodes:
        without = ("can_bridge", "compensator", "imu")
        return self._nodes(without=without, truth=True, simulator=self.simulator)

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        """Return the nodes of each launcher apart from the simulator; the first one has the bridge."""
        changes = {"can_bridge": {"rate": self.rate, **self.bridge}, "compensator": self.compensator}
        changes = {node: values for node, values in changes.items() if node not in self.without}
        return [self._nodes(without=self.without, port=port, **changes)]

    def _nodes(self, **options: Any) -> LaunchedNodes:
        return LaunchedNodes(self.folder, base=self.base, timing=self.timing, two_buses=self.two_buses, **options)

    def bring_to(self, stage: str) -> None:
        """Clear what the last fault left and bring the arm to `stage`, in several attempts.

        stage: a state of the bridge; or "started": the nodes run, whatever they do.

        Raises Timeout after `CARRY_LIMIT`.
        """
        with self.probe.time_limit(CARRY_LIMIT):
            self._wait_for_nodes()
            if stage == "started":
                return
            if stage in ("checking", "proving signs", "ramping in"):
                self._start_over(stage)
                return
            while not self.is_at_pose():
                self.probe.get_carried()
                self.probe.bring_to(self.script)
                self._wait_for_states(self.rate / 4)
            if stage == "letting down":
                assert self.probe.enable(False).success
                self.probe.wait_until(lambda: abs(self.true_velocity(self.struck)) > 0.2)

    def _wait_for_states(self, count: float) -> None:
        seen = len(self.probe.joint_states)
        self.probe.wait_until(lambda: len(self.probe.joint_states) > seen + count)

    def _wait_for_nodes(self) -> None:
        probe = self.probe
        probe.wait_until(lambda: self.has_lost_a_node or (probe.joint_states and probe.effort_commands))
        assert not self.has_lost_a_node, "nodes ended at the start"
        self._bridges.add(self.pid("can_bridge"))

    def is_at_pose(self) -> bool:
        """Return whether the arm is carried in its pose."""
        newest = self.truth.newest()
        is_near = newest is not None and np.abs(newest["position"] - self.pose).max() < NEAR
        return self.probe.state == "active" and bool(is_near)

    def _start_over(self, stage: str) -> None:
        """Let the arm hang with its motors off, make its signs unproven, and enable it up to `stage`."""
        probe = self.probe
        probe.wait_until(lambda: probe.state not in (None, "checking"))
        if probe.state in CARRYING:
            assert probe.enable(False).success
        probe.wait_until(lambda: self.truth.motors_are_off() and probe.state in ("disabled", "fault"))
        for silent in (True, False):
            probe.set_parameters("simulator", fault__bus_silent=silent)
            time.sleep(0.5)
        if probe.state == "fault":
            assert probe.trigger("clear_fault").success
        probe.enable(True)  # without effect if autostart came first
        probe.wait_until(lambda: probe.state == stage)
        if stage == "proving signs":  # which begins with motors that are still off
            probe.wait_until(lambda: (newest := self.truth.newest()) is not None and bool(newest["on"].all()))

    def true_velocity(self, joint: int) -> float:
        """Return the newest velocity in rad/s of `joint` (0..)."""
        newest = self.truth.newest()
        return 0.0 if newest is None else float(newest["velocity"][joint])

    def process(self, node: str) -> subprocess.Popen[str]:
        """Return the process of a node by the last part of its name."""
        return self._nodes_of(node).process(node)

    def pid(self, node: str) -> int:
        """Return the ID of a node's process."""
        return self._nodes_of(node).pid(node)

    @property
    def watchdog(self) -> int:
        """The ID of the process of the bridge's watchdog."""
        return children(self.pid("can_bridge"))[0]

    def _nodes_of(self, node: str) -> LaunchedNodes:
        return next(nodes for nodes in self.nodes if full_name(node) in load(nodes.path))

    @property
    def have_ended(self) -> bool:
        """Whether the nodes have ended."""
        return self.nodes[0].have_ended

    @property
    def has_lost_a_node(self) -> bool:
        """Whether a launcher has ended with its nodes, as it does when one of them ends."""
        return any(nodes.have_ended for nodes in self.nodes)

    @property
    def log(self) -> list[str]:
        return [line for nodes in self.nodes for line in nodes.log]

    def close(self) -> None:
        with contextlib.ExitStack() as stack:  # each is done although another one fails; the last one first
            stack.callback(self.probe.close)
            stack.callback(lambda: kill_watchdogs(self._bridges))
            for nodes in reversed([nodes for nodes in self.nodes if nodes.has_started()]):
                stack.callback(nodes.stop)


def kill_watchdogs(bridges: Collection[int]) -> None:
    """Kill the watchdogs of these bridges: one that is left waits forever for a device that no longer runs."""
    arguments = {str(bridge).encode() for bridge in bridges}
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            command = path.read_bytes().split(b"\0")
            if any(b".watchdog" in part for part in command) and arguments.intersection(command):
                os.kill(int(path.parent.name), signal.SIGKILL)
