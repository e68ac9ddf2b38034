"""The rigs on which faults are tried: which nodes run, in which processes, and which node commands the arm."""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml
from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.tools.inputs.parameter_file import load

from ..support import CONFIG
from ..support.bus_listener import BusListener
from ..support.launched_nodes import GENTLE, NO_IMU, REAL, LaunchedNodes, LauncherProcess, Parameters, full_name
from ..support.ros_probe import RosProbe

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
HORIZONTAL = {"name": "horizontal", "steps": [{"move": [0.0, 1.5, 0.0, 0.3], "over": 2.0}, {"hold": 600.0}]}
UPRIGHT: Parameters = {"trunk": {"pitch": 0.0, "roll": 0.0}}
CARRY_LIMIT = 90.0  # s for the nodes to start and carry the arm

ChangeMessage = Callable[[JointState], object]


class Rig:
    """Nodes that carry the arm in a horizontal pose, with a probe and a bus listener. End it with `close`.

    timing: rate and time-outs of the nodes, `REAL` or, for a busy machine, `SIMULATED`.
    """

    def __init__(self, folder: Path, timing: Mapping[str, Parameters] = REAL) -> None:
        self.folder, self.timing = folder, timing
        self.script = folder / "horizontal.yaml"
        self.script.write_text(yaml.safe_dump(HORIZONTAL))
        self.nodes = self._make_nodes()
        self.probe = RosProbe()
        self.listener = BusListener(self.nodes[0].bus)
        for nodes in self.nodes:
            nodes.start()

    def _make_nodes(self) -> list[LaunchedNodes]:
        """Return the nodes of each launcher; the first one has the bridge."""
        return [self._nodes(can_bridge=GENTLE)]

    def _nodes(self, without: tuple[str, ...] = (), port: int | None = None, **changes: Any) -> LaunchedNodes:
        return LaunchedNodes(self.folder, without=without, port=port, timing=self.timing, **changes)

    @property
    def rate(self) -> float:
        """The rate of the control loop in Hz."""
        return float(self.timing["can_bridge"]["rate"])

    def carry(self) -> None:
        """Clear what the last fault left and bring the arm to the pose, in several attempts on a busy machine.

        Raises Timeout unless it is carried within `CARRY_LIMIT`.
        """
        probe = self.probe
        with probe.time_limit(CARRY_LIMIT):
            probe.wait_until(lambda: self.have_ended or (probe.joint_states and probe.effort_commands))
            assert not self.have_ended, f"the nodes ended: {self.log[-5:]}"
            while not self._bring_to_pose():
                probe.wait_until(lambda: probe.state == "fault")

    def _bring_to_pose(self) -> bool:
        probe = self.probe
        probe.bring_to(self.script)
        self.listener.frames.clear()
        seen = len(probe.joint_states)
        probe.wait_until(lambda: len(probe.joint_states) > seen + self.rate / 4)
        return probe.state == "active"

    def process(self, node: str) -> subprocess.Popen[str]:
        """Return the process of a node by the last part of its name."""
        return next(nodes.process(node) for nodes in self.nodes if full_name(node) in load(nodes.path))

    @property
    def have_ended(self) -> bool:
        """Whether the nodes have ended."""
        return self.nodes[0].have_ended

    @property
    def log(self) -> list[str]:
        return [line for nodes in self.nodes for line in nodes.log]

    def close(self) -> None:
        for nodes in self.nodes:
            nodes.stop()
        self.listener.close()
        self.probe.close()


class TwoLaunchersRig(Rig):
    """The compensator has its own launcher: when it dies, the other nodes run on."""

    def _make_nodes(self) -> list[LaunchedNodes]:
        others = self._nodes(without=("compensator", "imu"), can_bridge=GENTLE, simulator=UPRIGHT)
        without = ("can_bridge", "simulator", "imu")
        return [others, self._nodes(without=without, port=others.bus["port"], compensator=NO_IMU)]


class CommandedRig(Rig):
    """This process commands the arm, at 100 Hz; `change_message` may spoil each message before it leaves."""

    def __init__(self, folder: Path, timing: Mapping[str, Parameters] = REAL) -> None:
        super().__init__(folder, timing)
        self.change_message: ChangeMessage = lambda message: None
        parameters = load(CONFIG / "sim.yaml")["/right/compensator"]
        self._arm = ArmModel(*(parameters[name] for name in ("link_length", "robot.cog", "robot.mass")))
        self._publisher = self.probe.node.create_publisher(JointState, "/right/effort_commands", 1)
        self.probe.node.create_subscription(JointState, "/right/joint_states", self._on_joint_states, NEWEST)
        self.probe.executor.wake()

    def _make_nodes(self) -> list[LaunchedNodes]:
        bridge = {**GENTLE, "rate": self.rate}
        return [self._nodes(without=("compensator", "imu"), can_bridge=bridge, simulator=UPRIGHT)]

    @property
    def rate(self) -> float:
        """100 Hz, at which this process can command the arm."""
        return 100.0

    def _on_joint_states(self, state: JointState) -> None:
        message = JointState(header=state.header, name=state.name)
        message.effort = gravity_torque(self._arm, state.position).tolist()
        self.change_message(message)
        self._publisher.publish(message)

    def carry(self) -> None:
        self.change_message = lambda message: None
        super().carry()


class ExternalClockRig(Rig):
    """Bridge and compensator use /clock, which this process publishes, `clock_offset` s off the system's clock."""

    def __init__(self, folder: Path, timing: Mapping[str, Parameters] = REAL) -> None:
        super().__init__(folder, timing)
        self.clock_offset = 0.0
        self._publisher = self.probe.node.create_publisher(Clock, "/clock", 10)
        self.probe.node.create_timer(0.002, self._publish_clock)
        self.probe.executor.wake()

    def _make_nodes(self) -> list[LaunchedNodes]:
        clock = {"use_sim_time": True}
        compensator, bridge = {**clock, **NO_IMU}, {**clock, **GENTLE}
        return [self._nodes(without=("imu",), compensator=compensator, can_bridge=bridge, simulator=UPRIGHT)]

    def _publish_clock(self) -> None:
        fraction, seconds = math.modf(time.time() + self.clock_offset)
        self._publisher.publish(Clock(clock=Time(sec=int(seconds), nanosec=int(fraction * 1e9))))


class LauncherRig(Rig):
    """The launcher is a process, as for users; `launcher` is that process."""

    def _make_nodes(self) -> list[LaunchedNodes]:
        self._launcher = LauncherProcess(self.folder, timing=self.timing, can_bridge=GENTLE)
        return [self._launcher]

    @property
    def launcher(self) -> subprocess.Popen[str]:
        return self._launcher.launcher_process
