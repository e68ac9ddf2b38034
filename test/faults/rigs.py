# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The kinds of rig: which nodes run, in which processes, which node commands the arm, and what the arm is like."""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.nodes.ros.subscriptions import NEWEST_ONLY

from ..support import CONFIG
from ..support.launched_nodes import NO_IMU, LaunchedNodes, LauncherProcess, Parameters
from ..support.ros_probe import RosProbe
from ..support.truth import Truth
from .injected import injected
from .rig import CARRY_LIMIT, NEAR, Rig

UPRIGHT: Parameters = {"trunk": {"pitch": 0.0, "roll": 0.0}}
COMPENSATOR = load(CONFIG / "sim.yaml")["/right/compensator"]
ROBOT = ArmModel(*(COMPENSATOR[name] for name in ("link_length", "robot.cog", "robot.mass")))

ChangeMessage = Callable[[JointState], object]


def variant(base: type[Rig], /, **attributes: Any) -> type[Rig]:
    """Return a rig with other parameters."""
    return type(f"{base.__name__} with {', '.join(attributes)}", (base,), attributes)


class TwoLaunchersRig(Rig):
    """The compensator has its own launcher: when it dies, the other nodes run on. Not so in one process."""

    simulator: ClassVar[Parameters] = UPRIGHT

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        bridge = {"rate": self.rate}
        if self.one_process:
            return [self._nodes(without=("imu", "simulator"), port=port, can_bridge=bridge, compensator=NO_IMU)]
        others = self._nodes(without=("compensator", "imu", "simulator"), port=port, can_bridge=bridge)
        compensator = self._nodes(without=("can_bridge", "simulator", "imu"), port=port, compensator=NO_IMU)
        return [others, compensator]


class FailingStepRig(TwoLaunchersRig):
    """The compensator's step fails once `failure` has a text: `sleep` never returns, any other raises an exception."""

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self.failure = folder / "failure"
        self._injected = injected(EXO_TEST_FAILURE=str(self.failure))

    def start(self) -> None:
        self._injected.__enter__()  # the nodes' processes start later, on the launcher's thread
        super().start()

    def close(self) -> None:
        super().close()
        self._injected.__exit__(None, None, None)


class CommandedRig(Rig):
    """This process commands the arm, at 100 Hz; `change_message` may spoil each message before it leaves."""

    rate = 100.0
    pose = (0.0, 0.6, 0.0, 0.3)  # soon down: these rows are about what is refused
    without = ("compensator", "imu", "simulator")
    simulator: ClassVar[Parameters] = UPRIGHT

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self.change_message: ChangeMessage = lambda message: None
        self._publisher = self.probe.node.create_publisher(JointState, "/right/effort_commands", 1)
        self.probe.node.create_subscription(JointState, "/right/joint_states", self._on_joint_states, NEWEST_ONLY)
        self.probe.executor.wake()

    def _on_joint_states(self, state: JointState) -> None:
        message = JointState(header=state.header, name=state.name)
        message.effort = gravity_torque(ROBOT, state.position).tolist()
        self.change_message(message)
        self._publisher.publish(message)

    def bring_to(self, stage: str) -> None:
        self.change_message = lambda message: None
        super().bring_to(stage)


class ExternalClockRig(Rig):
    """Bridge and compensator use /clock, which this process publishes, `clock_offset` s off the system's clock."""

    without = ("imu", "simulator")
    bridge: ClassVar[Parameters] = {"use_sim_time": True}
    compensator: ClassVar[Parameters] = {"use_sim_time": True, **NO_IMU}
    simulator: ClassVar[Parameters] = UPRIGHT

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self.clock_offset = 0.0
        self._publisher = self.probe.node.create_publisher(Clock, "/clock", 10)
        self.probe.node.create_timer(0.002, self._publish_clock)
        self.probe.executor.wake()

    def _publish_clock(self) -> None:
        fraction, seconds = math.modf(time.time() + self.clock_offset)
        self._publisher.publish(Clock(clock=Time(sec=int(seconds), nanosec=int(fraction * 1e9))))


class LauncherRig(Rig):
    """The launcher is a process, as for users; `launcher` is that process."""

    def _make_nodes(self, port: int) -> list[LaunchedNodes]:
        self._launcher = LauncherProcess(
            self.folder, without=self.without, port=port, timing=self.timing, one_process=self.one_process
        )
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


WORN_MASS, WORN_COG = Wearer(75.0).on_links((0.05, 0.13, 0.3, 0.3))


class WearerRig(Rig):
    """Zero-G for a wearer of 75 kg, who is passive. In this pose the rated torques carry the wearer's arm."""

    pose = (0.0, 0.4, 0.2, 0.5)
    compensator: ClassVar[Parameters] = {"mode": "zero_g", "support": 1.0, "wearer": {"body_mass": 75.0}}
    simulator: ClassVar[Parameters] = {
        "wearer": {"mass": WORN_MASS.tolist(), "cog": WORN_COG.tolist()},
        "friction": {"coulomb": [0.1] * 4},
    }


V3: Parameters = {"wire_format": ["mit_v3"] * 4}  # of the motors' boards
V3Rig = variant(Rig, bridge=V3, simulator=V3)
TwoBusRig = variant(Rig, two_buses=True)  # motors 3 and 4 are on a second bus
TwoBusV3Rig = variant(V3Rig, two_buses=True)
SignCheckRig = variant(Rig, bridge={"sign_check_torque": 1.5})
LeastFrictionRig = variant(Rig, simulator={"friction": {"coulomb": [0.01] * 4, "viscous": [0.0] * 4}})
# In this pose the motors can hold the arm on a trunk that is bowed to any angle up to 110 degrees.
BowRig = variant(Rig, pose=(0.0, 0.4, 1.0, 1.8))
