# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""All nodes as processes, over real DDS and a real CAN bus: the arm is carried, and is let down whoever dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import yaml

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.lab import processes
from exo_gravity.tools import train_anfis

from ..support import CONFIG
from ..support.launched_nodes import CALM, NO_IMU, LaunchedNodes, children
from ..support.ros_probe import RosProbe
from ..support.waiting import wait_until

pytestmark = pytest.mark.real_time

POSE = [0.1, 0.8, 0.7, 0.6]  # rad
RATE = CALM["can_bridge"]["rate"]  # Hz
Observed = TypeVar("Observed")
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))


@pytest.fixture
def to_pose(tmp_path: Path) -> Path:
    """The path of a trial script that moves the arm to `POSE` and lets go."""
    to_pose = tmp_path / "to_pose.yaml"
    to_pose.write_text(yaml.safe_dump({"name": "to_pose", "steps": [{"move": POSE, "over": 1.5}, {"hold": 60.0}]}))
    return to_pose


def fastest(probe: RosProbe) -> float:
    """Return the largest speed in rad/s of the joint states received."""
    return max(max(map(abs, message.velocity)) for message in probe.joint_states)


def while_carried(probe: RosProbe, to_pose: Path, observe: Callable[[], Observed]) -> Observed:
    """Return what `observe` returns of the arm in `POSE`; again if a busy machine let it down meanwhile."""
    while True:
        probe.get_carried()
        probe.bring_to(to_pose)
        probe.states.clear()
        observed = observe()
        if set(probe.states) <= {"active"}:
            return observed


def test_an_arm_stays_follows_live_changes_and_is_let_down_whichever_node_dies(launch, probe, to_pose, listen):
    # Under its own launcher, the compensator's death does not stop the other nodes.
    nodes = launch(without=("compensator",), timing=CALM)
    compensator = launch(without=("can_bridge", "simulator", "imu"), timing=CALM)
    listener = listen(nodes)

    def hold_and_change() -> tuple[float, float, float]:
        """Return the drift in degrees, the error of the efforts in Nm, and the largest step as a share of a change."""
        assert probe.set_parameters("compensator", gain=[1.0] * 4).successful
        released, seen = probe.joint_angles(), len(probe.joint_states)
        probe.wait_until(lambda: len(probe.joint_states) > seen + 2.0 * RATE)
        drift = np.degrees(np.abs(np.subtract(probe.joint_angles(), released)).max())
        tilt = Tilt.of("right", 0.10, -0.06)
        before = next(command.effort for command in reversed(probe.effort_commands.copy()) if command.effort)
        error = np.abs(np.subtract(before, gravity_torque(ROBOT, probe.joint_angles(), tilt.direction))).max()
        probe.effort_commands.clear()
        assert probe.set_parameters("compensator", gain=[1.0, 1.05, 1.0, 1.0]).successful
        heavier = ArmModel(ROBOT.length, ROBOT.cog, ROBOT.mass, gain=(1.0, 1.05, 1.0, 1.0))
        target = gravity_torque(heavier, probe.joint_angles(), tilt.direction)[1]
        probe.wait_until(
            lambda: (
                probe.state != "active"
                or any(command.effort and abs(command.effort[1] - target) < 0.01 for command in probe.effort_commands)
            )
        )
        steps = np.diff([message.effort[1] for message in probe.effort_commands if message.effort])
        return drift, error, np.abs(steps).max(initial=0.0) / abs(target - before[1])

    drift, error, step = while_carried(probe, to_pose, hold_and_change)
    assert drift < 0.5 and error < 0.03 and 0.0 < step < 0.5

    # No node maps another one's shared memory, on which it could block.
    for process in (*map(nodes.process, ("can_bridge", "simulator")), compensator.process("compensator")):
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        assert "librmw_fastrtps" in maps
        assert "fastrtps_port" not in maps

    # Without a compensator the arm is let down, and only the operator clears the fault.
    probe.get_carried()
    probe.joint_states.clear()
    compensator.process("compensator").send_signal(signal.SIGKILL)
    probe.wait_until(lambda: probe.state == "fault")
    assert probe.fault == "command_stale"
    assert abs(probe.joint_angles()[2]) < 0.2  # friction holds it there
    assert fastest(probe) < 1.0
    launch(without=("can_bridge", "simulator", "imu"), timing=CALM)
    probe.effort_commands.clear()
    probe.wait_until(lambda: len(probe.effort_commands) > 100)
    assert (probe.state, probe.fault) == ("fault", "command_stale")
    assert "refused" in probe.enable(True).message
    assert probe.trigger("clear_fault").success
    probe.wait_until(lambda: probe.state == "disabled")
    probe.get_carried()

    # Without the bridge and its watchdog, the launcher lets the arm down.
    kill_bridge_and_watchdog(nodes)
    wait_until(lambda: nodes.have_ended)
    assert nodes.ended_node == ("/right/can_bridge", -signal.SIGKILL)
    assert nodes.launcher.maybe_powered == []
    assert any("the arm is down, its motors are off" in line for line in nodes.log)
    assert listener.motors_are_off()


def kill_bridge_and_watchdog(nodes: LaunchedNodes) -> None:
    bridge = nodes.pid("can_bridge")
    (watchdog,) = children(bridge)
    for process in (watchdog, bridge):
        os.kill(process, signal.SIGKILL)


@pytest.mark.thorough
def test_the_launcher_states_that_motors_may_still_be_powered(launch, probe, monkeypatch):
    monkeypatch.setattr(processes, "DESCENT_TIMEOUT", 5.0)
    monkeypatch.setattr(processes, "RECOVERY", {"EXO_GRAVITY_RECOVER": "2"})
    nodes = launch(without=("imu",), compensator=NO_IMU)
    probe.wait_until_carried()
    (watchdog,) = children(nodes.pid("can_bridge"))
    assert probe.set_parameters("simulator", fault__bus_silent=True).successful
    nodes.stopping.set()
    wait_until(lambda: nodes.have_ended)
    assert nodes.launcher.maybe_powered == ["/right/can_bridge"]
    with suppress(ProcessLookupError):  # it ended once the launcher had asked for the bus
        os.kill(watchdog, signal.SIGKILL)


@pytest.fixture(scope="module")
def seated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosProbe]:
    """The arm of a seated wearer, whose first motor has its zero 0.3 rad off: observed, not carried yet."""
    nodes = LaunchedNodes(
        tmp_path_factory.mktemp("seated"),
        without=("imu",),
        timing=CALM,
        simulator={"zero": [0.3, 0.0, 0.0, 0.2]},
        can_bridge={"zero": [0.0] * 4},
        compensator=NO_IMU,
    ).start()
    probe = RosProbe()
    yield probe
    probe.close()
    nodes.stop()
    print("\n".join(nodes.log))


@pytest.mark.thorough
def test_the_anfis_law_runs_from_its_file_and_the_exact_law_replaces_it_outside_its_training(seated, tmp_path):
    path = str(tmp_path / "anfis.json")
    assert train_anfis.main(["--params", str(CONFIG / "sim.yaml"), "--output", path]) == 0
    assert "anfis_file" in seated.set_parameters("compensator", law="anfis").reason
    assert seated.set_parameters("compensator", atomically=True, law="anfis", anfis_file=path).successful
    seated.wait_until(lambda: seated.diagnostic("compensator", "law") == "anfis")
    seated.wait_until(lambda: seated.status_contains("compensator", "compensating"))
    worn = {"mode": "zero_g", "support": 1.0, "wearer__body_mass": 75.0}
    assert seated.set_parameters("compensator", atomically=True, **worn).successful
    message = "the exact law replaces anfis: the ANFIS was trained for another arm"
    seated.wait_until(lambda: seated.status_contains("compensator", message))
