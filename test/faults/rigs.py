# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The kinds of rig: which nodes run, in which processes, which node commands the arm, and what the arm is like."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.nodes.ros.subscriptions import NEWEST_ONLY

from ..support import CONFIG, ROOT
from ..support.launched_nodes import NO_IMU, LaunchedNodes, LauncherProcess, Parameters
from ..support.ros_probe import RosProbe
from ..support.truth import Truth
from .injected import injected
from .players import BE_SOUND, EFFORTS, OPERATOR
from .rig import CARRY_LIMIT, NEAR, Rig

UPRIGHT: Parameters = {"trunk": {"pitch": 0.0, "roll": 0.0}}
COMPENSATOR = load(CONFIG / "sim.yaml")["/right/compensator"]
ROBOT = ArmModel(*(COMPENSATOR[name] for name in ("link_length", "robot.cog", "robot.mass")))
STATED: Parameters = {"largest_moment": list(ROBOT.first_moment), "largest_addition": [0.0] * 4}
PEAK = [9.0, 18.0, 9.0, 9.0]  # Nm

ChangeMessage = Callable[[JointState], object]


def variant(base: type[Rig], /, **attributes: Any) -> type[Rig]:
    """Return a rig with other parameters."""
    return type(f"{base.__name__} with {', '.join(attributes)}", (base,), attributes)


def with_friction(coulomb: float, **other: Any) -> type[Rig]:
    """Return a rig with this friction in Nm in every joint."""
    return variant(Rig, simulator={"friction": {"coulomb": [coulomb] * 4, **other}})


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


class PlayedRig(Rig):
    """Other processes act on the arm: the players of players.py."""

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        super().__init__(folder, shipped_timeouts)
        self._players: dict[str, subprocess.Popen[bytes]] = {}

    def is_played(self, player: str) -> bool:
        """Return whether a player runs."""
        return player in self._players and self._players[player].poll() is None

    def play(self, player: str) -> None:
        """Start a player unless it runs."""
        if not self.is_played(player):
            self._players[player] = subprocess.Popen([sys.executable, "-m", "test.faults.players", player], cwd=ROOT)

    def pid(self, node: str) -> int:
        return self._players[node].pid if node in self._players else super().pid(node)

    def end(self, player: str) -> None:
        """End a player that runs."""
        if process := self._players.pop(player, None):
            process.kill()
            process.wait()

    def close(self) -> None:
        for player in tuple(self._players):
            self.end(player)
        super().close()


class HeldRig(PlayedRig):
    """A separate process holds control of the arm."""

    def bring_to(self, stage: str) -> None:
        self.play("holder")
        super().bring_to(stage)
        self.probe.wait_until(lambda: self.probe.diagnostic("can_bridge", "control held by") == OPERATOR)


class AssistedRig(PlayedRig):
    """A separate process assists the arm by `EFFORTS`."""

    without = ("imu", "simulator")
    compensator: ClassVar[Parameters] = {**NO_IMU, "assist": {"max_effort": [1.0] * 4}}
    simulator: ClassVar[Parameters] = UPRIGHT

    def bring_to(self, stage: str) -> None:
        """Bring the arm to `stage`, with the outer loop's efforts in full."""
        for number in (signal.SIGCONT, BE_SOUND):
            if self.is_played("outer_loop"):
                os.kill(self.pid("outer_loop"), number)
        self.play("outer_loop")
        super().bring_to(stage)
        self.probe.wait_until(self._is_assisted)

    def _is_assisted(self) -> bool:
        gravity = gravity_torque(ROBOT, self.probe.joint_states[-1].position)
        effort = self.probe.effort_commands[-1].effort
        return len(effort) == 4 and bool(np.allclose(effort, gravity + EFFORTS, atol=0.02))


class SuccessorRig(AssistedRig):
    """A second outer loop, which asks for nothing, waits while the first one assists the arm."""

    def replace_outer_loop(self) -> float:
        """Kill the outer loop; once its torque has gone, let the other one begin. Return when it died (wall clock)."""
        died = time.time()
        os.kill(self.pid("outer_loop"), signal.SIGKILL)
        self._wait_for("waiting")
        os.kill(self.pid("successor"), BE_SOUND)
        self._wait_for("assisting")
        return died

    def _wait_for(self, state: str) -> None:
        self.probe.wait_until(lambda: self.probe.diagnostic("compensator", "assist") == state)

    def bring_to(self, stage: str) -> None:
        self.end("successor")
        self.play("successor")
        super().bring_to(stage)


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
ShortEnableRig = variant(SignCheckRig, bridge={"sign_check_torque": 1.5, "enable_timeout": 2.0})
LeastFrictionRig, LowFrictionRig, HighFrictionRig = (
    with_friction(0.01, viscous=[0.0] * 4),
    with_friction(0.05, viscous=[0.0] * 4),
    with_friction(0.5),
)
# In this pose the motors can hold the arm on a trunk that is bowed to any angle up to 110 degrees.
BowRig = variant(Rig, pose=(0.0, 0.4, 1.0, 1.8))
# The elbow's upper limit is within reach of a push, and far from the mechanical stop.
WallRig = variant(Rig, pose=(0.0, 0.3, 0.3, 1.0), bridge={"position_max": [1.65, 3.14, 2.53, 1.2]})
V3WearerRig = variant(WearerRig, bridge=V3, simulator={**WearerRig.simulator, **V3})
# The same wearer with a load in the hand, for which the motors use their peak torque.
LoadedRig = variant(
    WearerRig, bridge={"max_effort": PEAK}, compensator={**WearerRig.compensator, "max_effort": PEAK}
)  # fmt: skip
# The bridge knows what the robot needs at most; this process is in the compensator's place.
MonitoredCommandsRig = variant(CommandedRig, bridge=STATED)
# An arm half raised, which the wearer can move in both directions; and one with a long way to be pressed down.
WornRig = variant(TwoLaunchersRig, pose=(0.0, 0.9, 0.3, 0.6))
RaisedRig = variant(TwoLaunchersRig, pose=(0.0, 1.5, 0.3, 0.6))
