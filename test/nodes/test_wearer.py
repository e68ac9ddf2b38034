# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `wearer` beside a compensator: what it estimates, asks for and warns of, and the arm that it makes."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.nodes.compensator.arm import declared
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.subscriptions import LATCHED
from exo_gravity.nodes.wearer.node import WearerNode

from ..support import PARTS, ROBOT
from ..support.chains import random_chain
from ..support.launched_nodes import NO_IMU
from ..support.urdf_oracle import MujocoArm
from ..support.waiting import wait_until

keep_to_this_machine()
OTHER_NODES = ("can_bridge", "simulator", "imu")
POSE = (0.2, 0.9, 0.7, 0.6)  # rad
LOAD = Wearer(75.0).on_links(ROBOT.length)
WORN = {**NO_IMU, "max_effort": [9.0, 18.0, 9.0, 9.0], "wearer.body_mass": 75.0}
ADAPTIVE = {**WORN, "mode": "zero_g", "support": 0.4, "support_adapts": True, "model_error.wearer": 0.03}
NEEDED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog), POSE)
CARRIED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog, 0.4), POSE)
GIVEN = np.array((0.0, 4.0, 1.5, 0.0))  # Nm, of the wearer
WEIGHT = NEEDED - gravity_torque(ROBOT, POSE)  # Nm, that carries the wearer's arm
NONE = ["0.0"] * len(PARTS)  # Nm
GRAVITY = (0.0, 0.0, -9.80665)


class StillArm:
    """Publishes the joint states of a still right arm; their stamps count them in ns.

    effort: of its motors, (4,) Nm. velocity: (4,) rad/s. sinking: rad in each period, of the second joint.
    """

    def __init__(self, node: Node) -> None:
        self.effort: Sequence[float] = ()
        self.velocity: Sequence[float] = (0.0,) * 4
        self.sinking = 0.0
        self._message = JointState(name=[f"right_{part}" for part in PARTS], position=POSE)
        self._publisher = node.create_publisher(JointState, "/right/joint_states", 1)
        self.timer = node.create_timer(0.005, self._publish)

    def _publish(self) -> None:
        self._message.header.stamp.nanosec += 1
        self._message.effort, self._message.velocity = self.effort, self.velocity
        self._message.position[1] -= self.sinking
        self._publisher.publish(self._message)


@pytest.fixture
def arm(probe) -> StillArm:
    return StillArm(probe.node)


@pytest.fixture
def value(probe) -> partial[str | None]:
    """A function that returns the newest value of a key of the wearer."""
    return partial(probe.diagnostic, "wearer")


def test_what_the_motors_do_not_carry_is_published_as_the_wearers_and_follows_the_compensators_parameters(
    launch, probe, arm, value
):
    found: dict[str, list[JointState]] = {"": [], "_std": []}
    for part, messages in found.items():
        probe.node.create_subscription(JointState, f"/right/wearer_efforts{part}", messages.append, 100)
    nodes = launch(without=OTHER_NODES, compensator=WORN, wearer=True)

    def torques() -> list[str | None]:
        return [value(f"right_{part} wearer (Nm)") for part in PARTS]

    probe.wait_until(lambda: value("reason") == "incomplete_joint_states")
    assert not found[""]  # without the motors' efforts nothing is known of the wearer
    arm.effort = (NEEDED - GIVEN).tolist()
    probe.wait_until(lambda: len(found[""]) > 100 and len(found["_std"]) > 100)
    newest, deviation = found[""][-1], found["_std"][-1]
    assert list(newest.name) == [f"right_{part}" for part in PARTS]
    assert newest.effort == pytest.approx(GIVEN, abs=1e-6)
    assert all(0.05 < std < 2.5 for std in deviation.effort)
    stamps = [{to_nanoseconds(message.header.stamp) for message in messages[:50]} for messages in found.values()]
    assert stamps[0] & stamps[1]  # a torque and its deviation have the same stamp
    probe.wait_until(lambda: torques() == [f"{torque:.1f}" for torque in GIVEN])
    assert float(value("right_shoulder_abduction wearer band (Nm)")) < 4.0
    probe.wait_until(lambda: value("share of the wearer (%)") == f"{100.0 * (GIVEN @ WEIGHT) / (WEIGHT @ WEIGHT):.0f}")
    arm.effort = NEEDED.tolist()
    probe.wait_until(lambda: torques() == NONE and value("share of the wearer (%)") == "0")
    assert (value("contacts"), value("contact joint")) == ("0", "none")

    def strike() -> None:
        blow = 5.0 * (len(probe.joint_states) // 200 % 2)  # Nm; again, for a node that was late at the first one
        arm.effort = np.add(NEEDED, (0.0, 0.0, 0.0, blow)).tolist()

    probe.wait_until(lambda: strike() or value("contact joint") == "right_elbow_flexion")
    assert probe.set_parameters("compensator", payload__mass=2.0).successful
    loaded = ROBOT.with_payload(2.0, (0.0, 0.0, 0.0)).with_wearer(LOAD.mass, LOAD.cog)
    arm.effort = gravity_torque(loaded, POSE).tolist()
    probe.wait_until(lambda: torques() == NONE)
    # A compensator that hangs, or is gone: the middleware lists it for long.
    os.kill(nodes.pid("compensator"), signal.SIGSTOP)
    probe.wait_until(lambda: value("reason") == "no_compensator" and set(torques()) == {"unknown"})
    for count in (100, 200):  # what was on its way arrives in the first time
        told, seen = len(found[""]), len(probe.joint_states)
        probe.wait_until(lambda end=seen + count: len(probe.joint_states) > end)
    assert len(found[""]) == told
    os.kill(nodes.pid("compensator"), signal.SIGCONT)
    probe.wait_until(lambda: torques() == NONE and len(found[""]) > told)


@pytest.mark.thorough
def test_a_load_beyond_the_motors_is_clamped_and_one_warning_states_the_support_that_fits(launch, probe, arm, value):
    nodes = launch(without=OTHER_NODES, compensator=NO_IMU, wearer=True)
    bridge = rclpy.create_node("can_bridge", namespace="/right", context=probe.context)
    for param in CAN_BRIDGE:
        bridge.declare_parameter(param.name, param.default)
    probe.executor.add_node(bridge)
    probe.wait_until(lambda: value("budget") == "within_rated")
    worn = {"mode": "zero_g", "support": 1.0, "wearer__body_mass": 75}
    assert probe.set_parameters("compensator", atomically=True, **worn).successful
    needs = "right_shoulder_abduction needs 19.6 Nm in its worst pose (rated 9, peak 18)"
    probe.wait_until(lambda: needs in (value("budget text") or ""))
    assert value("budget") == "above_rated"
    assert f"the largest support that fits is {value('largest support')}" in value("budget text")
    probe.wait_until(lambda: probe.status_contains("compensator", ", right_shoulder_flexion"))
    probe.wait_until(lambda: probe.effort_commands[-1].effort[2] == 3.0)
    probe.wait_until(lambda: [line for line in nodes.log if needs in line and "WARN" in line])
    probe.statuses.clear()
    probe.wait_until(lambda: value("budget text"))  # the next report does not repeat the warning
    assert len([line for line in nodes.log if needs in line]) == 1


@pytest.fixture
def wearer() -> Iterator[WearerNode]:
    """A wearer in this process, which is not spun."""
    rclpy.init()
    node = WearerNode()
    yield node
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_a_node_of_another_program_with_the_compensators_name_does_not_end_the_node_and_is_refused(wearer):
    other, executor, told = rclpy.create_node("compensator"), NodeExecutor(), []
    publisher = other.create_publisher(DiagnosticArray, "/diagnostics", 10)
    values = [KeyValue(key="answers", value="many")]
    report = DiagnosticArray(status=[DiagnosticStatus(name="compensator", values=values)])
    other.create_timer(0.05, lambda: publisher.publish(report))
    other.create_subscription(DiagnosticArray, "/diagnostics", lambda message: told.extend(message.status), 10)
    for node in (wearer, other):
        executor.add_node(node)
    refusal = "the compensator has no parameter 'law'"
    wait_until(lambda: refusal in {status.message for status in told}, lambda: executor.spin_once(0.05))
    assert wearer.failure is None
    executor.shutdown()
    other.destroy_node()


@pytest.mark.thorough
def test_the_wearers_torque_on_an_arm_of_three_joints_is_known_once_its_urdf_arrives(launch, probe, value):
    names, pose, given = ["abduction", "flexion", "elbow"], [0.4, 0.5, 0.7], np.array((1.0, -2.0, 0.5))
    text = packaged_config("arms/three_joints.urdf").read_text(encoding="utf-8")
    found: list[JointState] = []
    probe.node.create_subscription(JointState, "/right/wearer_efforts", found.append, 100)
    from_topic = {"urdf": {"topic": "/robot_description", "hand": "hand"}}
    launch(base="three_joints.yaml", without=OTHER_NODES, compensator=from_topic, wearer=True)
    probe.node.create_publisher(String, "/robot_description", LATCHED).publish(String(data=text))
    three = StillArm(probe.node, names, pose)
    three.effort = (MujocoArm(text, names).torque(pose, GRAVITY) - given).tolist()
    probe.wait_until(lambda: len(found) > 50)
    three.close()
    assert list(found[-1].name) == names and found[-1].effort == pytest.approx(given, abs=1e-6)
    assert value("budget") == "unknown"


@pytest.mark.thorough
def test_the_support_follows_an_arm_that_sinks_and_returns_when_the_node_is_killed_while_the_arm_is_carried_on(
    launch, probe, arm, value
):
    nodes = launch(without=OTHER_NODES, compensator=ADAPTIVE, wearer=True)
    arm.effort = CARRIED.tolist()

    def in_use() -> float:
        return float(probe.diagnostic("compensator", "support in use") or 0.0)

    def asked() -> float:
        asked = value("support asked for")
        return 0.0 if asked in (None, "none") else float(asked)

    probe.wait_until(lambda: value("support adapts") == "on" and asked() == 0.4)
    arm.sinking = 0.0002
    probe.wait_until(lambda: asked() > 0.4 and in_use() > 0.4)
    arm.sinking = 0.0
    assert probe.diagnostic("compensator", "support") == "0.4"
    assert probe.set_parameters("compensator", model_error__wearer=0.3).successful
    probe.wait_until(lambda: asked() == 0.4 and value("support adapts") == "held")
    assert probe.set_parameters("compensator", model_error__wearer=0.03).successful
    arm.sinking = 0.0002
    probe.wait_until(lambda: in_use() > 0.42)
    nodes.process("wearer").kill()
    probe.wait_until(lambda: in_use() == 0.4 and probe.diagnostic("compensator", "support request") == "none")
    probe.wait_until(lambda: any("wearer: ended with exit code -9; no arm depends on it" in line for line in nodes.log))
    count = len(probe.effort_commands)
    probe.wait_until(lambda: len(probe.effort_commands) > count + 100)
    assert probe.effort_commands[-1].effort and nodes.ended_node is None


# Compensator, wearer and the tools make the same arm of a URDF whose chain has joints that are not the arm's


def given_of(urdf: Path, names: list[str], hand: str = "") -> dict[str, Any]:
    own = {"joint_names": names, "urdf.file": str(urdf), "urdf.hand": hand, "max_effort": [30.0] * len(names)}
    return {"law": "urdf", "use_imu": False, **own}


def compensator(given: dict[str, Any]) -> Node:
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    with_them: dict[str, Any] = {"automatically_declare_parameters_from_overrides": True}
    return rclpy.create_node("compensator", parameter_overrides=overrides, **with_them)


def files(given: dict[str, Any]) -> dict[str, dict[str, Any]]:
    count = len(given["joint_names"])
    of_joints = {"motor": ["AK80-9"] * count, "can_id": list(range(1, count + 1)), "max_effort": [9.0] * count}
    ranges = {"position_min": [-1.0] * count, "position_max": [1.0] * count}
    bus = {"can.interface": "virtual", "can.channel": "one_urdf_arm"}
    bridge = {"joint_names": given["joint_names"], **bus, **of_joints, **ranges}
    return {"/right/can_bridge": bridge, "/right/compensator": given}


def test_a_joint_that_is_not_listed_is_at_0_for_compensator_wearer_and_tools(wearer, tmp_path):
    text, names = random_chain(3, seed=5)
    urdf, listed = tmp_path / "chain.urdf", [names[0], names[2]]
    urdf.write_text(text)
    given = given_of(urdf, listed, "hand")
    node = compensator(given)
    _, values, read, arm = declared(node)
    assert arm.fixed == (names[1],)
    made = (read(values), wearer._read(values), read_arm(files(given), "/right").settings)
    oracle = MujocoArm(text, listed)
    for theta in np.random.default_rng(0).uniform(-2.0, 2.0, (10, 2)):
        for settings in made:
            torque, _ = settings.torque(theta.tolist(), Tilt.of("left"))
            np.testing.assert_allclose(torque, oracle.torque(theta, GRAVITY), rtol=0.0, atol=1e-10)
    node.destroy_node()
