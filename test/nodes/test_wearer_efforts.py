# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `wearer` beside a compensator, which the test feeds with joint states and requests."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.subscriptions import LATCHED
from exo_gravity.nodes.wearer.node import WearerNode

from ..support.joint_state_feeder import PARTS, POSE, Feeder
from ..support.launched_nodes import NO_IMU
from ..support.urdf_oracle import MujocoArm
from ..support.waiting import wait_until

OTHER_NODES = ("can_bridge", "simulator", "imu")
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(ROBOT.length)
WORN = {**NO_IMU, "max_effort": [9.0, 18.0, 9.0, 9.0], "wearer.body_mass": 75.0}
ADAPTIVE = {**WORN, "mode": "zero_g", "support": 0.4, "support_adapts": True, "model_error.wearer": 0.03}
NEEDED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog), POSE)
CARRIED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog, 0.4), POSE)
GIVEN = np.array((0.0, 4.0, 1.5, 0.0))  # Nm, of the wearer
WEIGHT = NEEDED - gravity_torque(ROBOT, POSE)  # Nm, that carries the wearer's arm
NONE = ["0.0"] * len(PARTS)  # Nm


class StillArm(Feeder):
    """Publishes the joint states of a still arm every 5 ms; `effort` of its motors in Nm. Stamps count them in ns."""

    def __init__(
        self,
        node: Node,
        names: Sequence[str] = tuple(f"right_{part}" for part in PARTS),
        pose: Sequence[float] = POSE,
    ) -> None:
        self.effort: Sequence[float] = ()
        self.velocity: Sequence[float] = (0.0,) * len(names)
        self._message = JointState(name=names, position=pose)
        self.sinking = 0.0  # rad every 5 ms, of the abduction
        self._publisher = node.create_publisher(JointState, "/right/joint_states", 1)
        super().__init__(0.005)

    def send(self, number: int) -> None:
        message = self._message
        message.header.stamp = Time(nanoseconds=number).to_msg()
        message.effort, message.velocity = self.effort, self.velocity
        message.position[1] -= self.sinking
        self._publisher.publish(message)


@pytest.fixture
def arm(probe) -> Iterator[StillArm]:
    still = StillArm(probe.node)
    yield still
    still.close()


def test_what_the_motors_do_not_carry_is_published_as_the_wearers_and_follows_the_compensators_parameters(
    launch, probe, arm
):
    found: dict[str, list[JointState]] = {"": [], "_std": []}
    for part, messages in found.items():
        probe.node.create_subscription(JointState, f"/right/wearer_efforts{part}", messages.append, 100)
    nodes = launch(without=OTHER_NODES, compensator=WORN, wearer=True)
    share, reason = (partial(probe.diagnostic, "wearer", key) for key in ("share of the wearer (%)", "reason"))

    def torques() -> list[str | None]:
        return [probe.diagnostic("wearer", f"right_{part} wearer (Nm)") for part in PARTS]

    probe.wait_until(lambda: reason() == "incomplete_joint_states")
    assert not found[""]  # without the motors' efforts nothing is known of the wearer
    arm.effort = (NEEDED - GIVEN).tolist()
    probe.wait_until(lambda: len(found[""]) > 100 and len(found["_std"]) > 100)
    newest, deviation = found[""][-1], found["_std"][-1]
    assert list(newest.name) == [f"right_{part}" for part in PARTS]
    assert newest.effort == pytest.approx(GIVEN, abs=1e-6)
    assert all(0.05 < value < 2.5 for value in deviation.effort)
    stamps = [[to_nanoseconds(message.header.stamp) for message in messages[:50]] for messages in found.values()]
    assert set(stamps[0]) & set(stamps[1])  # a torque and its deviation have the same stamp
    probe.wait_until(lambda: torques() == [f"{torque:.1f}" for torque in GIVEN])
    assert float(probe.diagnostic("wearer", "right_shoulder_abduction wearer band (Nm)")) < 4.0
    probe.wait_until(lambda: share() == f"{100.0 * (GIVEN @ WEIGHT) / (WEIGHT @ WEIGHT):.0f}")
    arm.effort = NEEDED.tolist()
    probe.wait_until(lambda: torques() == NONE and share() == "0")
    assert (probe.diagnostic("wearer", "contacts"), probe.diagnostic("wearer", "contact joint")) == ("0", "none")

    def strike() -> None:
        blow = 5.0 * (len(probe.joint_states) // 200 % 2)  # Nm; again, for a node that was late at the first one
        arm.effort = np.add(NEEDED, (0.0, 0.0, 0.0, blow)).tolist()

    probe.wait_until(lambda: strike() or probe.diagnostic("wearer", "contact joint") == "right_elbow_flexion")
    assert probe.set_parameters("compensator", payload__mass=2.0).successful
    loaded = ROBOT.with_payload(2.0, (0.0, 0.0, 0.0)).with_wearer(LOAD.mass, LOAD.cog)
    arm.effort = gravity_torque(loaded, POSE).tolist()
    probe.wait_until(lambda: torques() == NONE)
    # A compensator that hangs, or is gone: the middleware lists it for long.
    os.kill(nodes.pid("compensator"), signal.SIGSTOP)
    probe.wait_until(lambda: reason() == "no_compensator" and set(torques()) == {"unknown"})
    told, seen = len(found[""]), len(probe.joint_states)
    probe.wait_until(lambda: len(probe.joint_states) > seen + 200)
    assert len(found[""]) == told
    os.kill(nodes.pid("compensator"), signal.SIGCONT)
    probe.wait_until(lambda: torques() == NONE and len(found[""]) > told)


def test_a_node_of_another_program_with_the_compensators_name_does_not_end_the_node_and_is_refused():
    keep_to_this_machine()
    rclpy.init()
    wearer, other, executor, told = WearerNode(), rclpy.create_node("compensator"), NodeExecutor(), []
    publisher = other.create_publisher(DiagnosticArray, "/diagnostics", 10)
    values = [KeyValue(key="answers", value="many")]
    other.create_timer(
        0.05, lambda: publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name="compensator", values=values)]))
    )
    other.create_subscription(DiagnosticArray, "/diagnostics", lambda message: told.extend(message.status), 10)
    try:
        for node in (wearer, other):
            executor.add_node(node)
        refusal = "the compensator has no parameter 'law'"
        wait_until(lambda: refusal in {status.message for status in told}, lambda: executor.spin_once(0.05))
        assert wearer.failure is None
    finally:
        wearer.close()
        executor.shutdown()
        for node in (wearer, other):
            node.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.thorough
def test_the_wearers_torque_on_an_arm_of_three_joints_is_known_once_its_urdf_arrives(launch, probe):
    names, pose, given = ["abduction", "flexion", "elbow"], [0.4, 0.5, 0.7], np.array((1.0, -2.0, 0.5))
    text = packaged_config("arms/three_joints.urdf").read_text(encoding="utf-8")
    found: list[JointState] = []
    probe.node.create_subscription(JointState, "/right/wearer_efforts", found.append, 100)
    from_topic = {"urdf": {"topic": "/robot_description", "hand": "hand"}}
    launch(base="three_joints.yaml", without=OTHER_NODES, compensator=from_topic, wearer=True)
    probe.node.create_publisher(String, "/robot_description", LATCHED).publish(String(data=text))
    three = StillArm(probe.node, names, pose)
    try:
        three.effort = (MujocoArm(text, names).torque(pose, (0.0, 0.0, -9.80665)) - given).tolist()
        probe.wait_until(lambda: len(found) > 50)
    finally:
        three.close()
    assert list(found[-1].name) == names
    assert found[-1].effort == pytest.approx(given, abs=1e-6)
    assert probe.diagnostic("wearer", "budget") == "unknown"


@pytest.mark.thorough
def test_a_load_is_weighed_on_request_and_one_that_is_dropped_is_no_longer_a_parameter(launch, probe, arm):
    launch(without=OTHER_NODES, compensator={**WORN, "support": 0.5})
    probe.wait_until(lambda: probe.effort_commands)

    def weigh() -> Trigger.Response:
        return probe.call(Trigger, "/right/compensator/weigh", Trigger.Request())

    weighing = partial(probe.diagnostic, "compensator")
    refused = weigh()
    assert not refused.success and "support 1" in refused.message
    probe.wait_until(lambda: weighing("weigh refused") == "support" and weighing("weighing number") == "0")
    assert probe.set_parameters("compensator", mode="zero_g", support=1.0).successful
    probe.wait_until(lambda: probe.diagnostic("compensator", "changing load") == "none" and weigh().success)
    probe.wait_until(lambda: weighing("weighing") == "taking_over" and weighing("weighing number") == "1")
    assert not probe.set_parameters("compensator", payload__mass=6.0).successful
    assert probe.set_parameters("compensator", payload__mass=2.0).successful
    probe.wait_until(lambda: (weighing("weighing"), weighing("weighing trouble")) == ("failed", "settings_changed"))
    arm.velocity = (0.0, 0.0, 1.5, 2.0)
    probe.wait_until(lambda: probe.diagnostic("compensator", "payload mass (kg)") == "0.000")
    values = probe.dump_parameters(["/right/compensator"])["/right/compensator"]
    assert values["ros__parameters"]["payload"]["mass"] == 0.0


@pytest.mark.thorough
def test_the_support_follows_an_arm_that_sinks_and_returns_when_the_node_is_killed_while_the_arm_is_carried_on(
    launch, probe, arm
):
    nodes = launch(without=OTHER_NODES, compensator=ADAPTIVE, wearer=True)
    arm.effort = CARRIED.tolist()
    adapts, in_use = partial(probe.diagnostic, "wearer", "support adapts"), partial(support_in_use, probe)

    def asked() -> float:
        value = probe.diagnostic("wearer", "support asked for")
        return 0.0 if value in (None, "none") else float(value)

    probe.wait_until(lambda: adapts() == "on" and asked() == 0.4)
    arm.sinking = 0.0002
    probe.wait_until(lambda: asked() > 0.4 and in_use() > 0.4)
    arm.sinking = 0.0
    assert probe.diagnostic("compensator", "support") == "0.4"
    assert probe.set_parameters("compensator", model_error__wearer=0.3).successful
    probe.wait_until(lambda: asked() == 0.4 and adapts() == "held")
    assert probe.set_parameters("compensator", model_error__wearer=0.03).successful
    arm.sinking = 0.0002
    probe.wait_until(lambda: in_use() > 0.42)
    nodes.process("wearer").kill()
    probe.wait_until(lambda: in_use() == 0.4 and probe.diagnostic("compensator", "support request") == "none")
    probe.wait_until(lambda: any("wearer: ended with exit code -9; no arm depends on it" in line for line in nodes.log))
    count = len(probe.effort_commands)
    probe.wait_until(lambda: len(probe.effort_commands) > count + 100)
    assert probe.effort_commands[-1].effort and nodes.ended_node is None


def support_in_use(probe) -> float:
    return float(probe.diagnostic("compensator", "support in use") or 0.0)


@pytest.mark.thorough
def test_a_wrong_or_second_sender_of_requests_raises_no_support(launch, probe, arm):
    launch(without=OTHER_NODES, compensator=ADAPTIVE)
    arm.effort = CARRIED.tolist()
    probe.wait_until(lambda: probe.effort_commands and support_in_use(probe) == 0.4)
    report, publish = partial(probe.diagnostic, "compensator", "support request"), Requests(probe.node).publish
    for wrong in ({"share": math.nan}, {"share": 1.5}, {"name": "elbow"}, {"age": 3.0}, {"age": -3.0}):
        word = "late" if "age" in wrong else "invalid"
        probe.wait_until(lambda wrong=wrong, word=word: publish(**wrong) or report() == word)
        assert support_in_use(probe) == 0.4
        probe.wait_until(lambda: report() == "none")
    probe.wait_until(lambda: publish(share=0.8) or support_in_use(probe) == 0.8)
    second = Requests(probe.node).publish
    probe.wait_until(lambda: publish(share=0.8) or second(share=0.9) or support_in_use(probe) == 0.4)
    assert report() == "second_publisher"


class Requests:
    """A sender of requests for support, at most 10 a second."""

    def __init__(self, node: Node) -> None:
        self._node, self._sent = node, -math.inf
        self._publisher = node.create_publisher(JointState, "/right/support_request", 1)

    def publish(self, share: float = 0.7, name: str = "support", age: float = 0.0) -> None:
        """Ask for `share` 0..1 as of `age` s ago."""
        now = self._node.get_clock().now().nanoseconds
        if now * 1e-9 - self._sent < 0.1:
            return
        self._sent = now * 1e-9
        request = JointState(name=[name], position=[share])
        request.header.stamp = Time(nanoseconds=now - round(age * 1e9)).to_msg()
        self._publisher.publish(request)
