# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `wearer` beside a compensator: what it estimates, asks for and warns of, and the arm that it makes."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.nodes.compensator.arm import declared
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.subscriptions import LATCHED
from exo_gravity.nodes.wearer.node import WearerNode

from ..support import PARTS, ROBOT
from ..support.chains import random_chain
from ..support.compensator_rig import NAMES, POSE, CompensatorRig
from ..support.node_thread import NodeRig
from ..support.urdf_oracle import MujocoArm
from ..support.waiting import each_closed

LOAD = Wearer(75.0).on_links(ROBOT.length)
WORN = {"use_imu": "false", "max_effort": [9.0, 18.0, 9.0, 9.0], "wearer.body_mass": 75.0}
ADAPTIVE = {**WORN, "mode": "zero_g", "support": 0.4, "support_adapts": "true", "model_error.wearer": 0.03}
NEEDED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog), POSE)
CARRIED = gravity_torque(ROBOT.with_wearer(LOAD.mass, LOAD.cog, 0.4), POSE)
GIVEN = np.array((0.0, 4.0, 1.5, 0.0))  # Nm, of the wearer
WEIGHT = NEEDED - gravity_torque(ROBOT, POSE)  # Nm, that carries the wearer's arm
NONE = ["0.0"] * len(PARTS)  # Nm
GRAVITY = (0.0, 0.0, -9.80665)


class WornRig(CompensatorRig):
    """An arm with a wearer. estimates: the wearer's torques and their deviations, all so far."""

    def __init__(self, parameters: dict[str, Any], names: list[str] = NAMES, pose: Any = POSE) -> None:
        super().__init__("/right", parameters, names, pose)
        self.estimates: dict[str, list[JointState]] = {"": [], "_std": []}
        for part, messages in self.estimates.items():
            self.user.create_subscription(JointState, f"wearer_efforts{part}", messages.append, 100)
        self.effort = []

    def found(self, key: str) -> str:
        return self.values_of("wearer")[key]

    @property
    def torques(self) -> list[str]:
        return [self.found(f"right_{part} wearer (Nm)") for part in PARTS]


@pytest.fixture
def worn() -> Iterator[Callable[..., WornRig]]:
    yield from each_closed(WornRig)


def test_what_the_motors_do_not_carry_is_published_as_the_wearers_and_follows_the_compensators_parameters(worn):
    rig = worn(WORN)
    rig.start(with_wearer=True)
    torques, deviations = rig.estimates.values()
    rig.wait_until(lambda: rig.found("reason") == "incomplete_joint_states")
    assert not torques  # without the motors' efforts nothing is known of the wearer
    rig.effort = (NEEDED - GIVEN).tolist()
    rig.wait_until(lambda: len(torques) > 100 and len(deviations) > 100)
    assert list(torques[-1].name) == NAMES
    assert torques[-1].effort == pytest.approx(GIVEN, abs=1e-6)
    assert all(0.05 < std < 2.5 for std in deviations[-1].effort)
    stamps = [{to_nanoseconds(message.header.stamp) for message in messages[:50]} for messages in (torques, deviations)]
    assert stamps[0] & stamps[1]  # a torque and its deviation have the same stamp
    rig.wait_until(lambda: rig.torques == [f"{torque:.1f}" for torque in GIVEN])
    assert float(rig.found("right_shoulder_abduction wearer band (Nm)")) < 4.0
    share = f"{100.0 * (GIVEN @ WEIGHT) / (WEIGHT @ WEIGHT):.0f}"
    rig.wait_until(lambda: rig.found("share of the wearer (%)") == share)
    rig.effort = NEEDED.tolist()
    rig.wait_until(lambda: rig.torques == NONE and rig.found("share of the wearer (%)") == "0")
    assert (rig.found("contacts"), rig.found("contact joint")) == ("0", "none")

    def strike(_stamp: object) -> None:  # again, for a node that was late at the first one
        rig.effort = np.add(NEEDED, (0.0, 0.0, 0.0, 5.0 * (len(torques) // 100 % 2))).tolist()

    rig.on_cycle = strike
    rig.wait_until(lambda: rig.found("contact joint") == "right_elbow_flexion")
    rig.on_cycle = lambda stamp: None
    assert rig.set(payload__mass=2.0) == [""]
    loaded = ROBOT.with_payload(2.0, (0.0, 0.0, 0.0)).with_wearer(LOAD.mass, LOAD.cog)
    rig.effort = gravity_torque(loaded, POSE).tolist()
    rig.wait_until(lambda: rig.torques == NONE)


def test_beside_a_compensator_that_hangs_nothing_is_known_of_the_wearer(worn):
    rig = worn(WORN)
    rig.effort = NEEDED.tolist()
    rig.start(with_wearer=True)
    torques = rig.estimates[""]
    rig.wait_until(lambda: rig.torques == NONE and torques)
    rig.is_stopped = True  # the wearer's own thread goes on

    def are_at_an_end() -> bool:
        told, end = len(torques), time.monotonic() + 0.5
        rig.wait_until(lambda: time.monotonic() > end)
        return len(torques) == told

    rig.wait_until(are_at_an_end)
    rig.is_stopped = False
    told = len(torques)
    rig.wait_until(lambda: len(torques) > told and rig.torques == NONE)


@pytest.mark.thorough
def test_a_load_beyond_the_motors_is_clamped_and_one_warning_states_the_support_that_fits(worn, capfd):
    rig = worn({"use_imu": "false"})
    bridge = rig.add(rclpy.create_node("can_bridge"))
    for param in CAN_BRIDGE:
        bridge.declare_parameter(param.name, param.default)
    rig.start(with_wearer=True)
    rig.wait_until(lambda: rig.found("budget") == "within_rated")
    worn = {"mode": "zero_g", "support": 1.0, "wearer.body_mass": 75}
    changes = [Parameter(name, value=value) for name, value in worn.items()]
    assert rig.node.set_parameters_atomically(changes).successful
    needs = "right_shoulder_abduction needs 19.6 Nm in its worst pose (rated 9, peak 18)"
    rig.wait_until(lambda: needs in rig.found("budget text"))
    assert rig.found("budget") == "above_rated"
    assert f"the largest support that fits is {rig.found('largest support')}" in rig.found("budget text")
    rig.wait_until(lambda: ", right_shoulder_flexion" in rig.status.message and rig.commands[-1][2] == 3.0)
    rig.statuses.clear()
    rig.wait_until(lambda: rig.found("budget text"))  # the next report does not repeat the warning
    warnings = [line for line in capfd.readouterr().err.splitlines() if needs in line]
    assert len(warnings) == 1 and "WARN" in warnings[0]


@pytest.fixture
def alone() -> Iterator[NodeRig]:
    """A rig with a wearer, `alone.wearer`."""
    alone = NodeRig()
    alone.wearer = alone.add(WearerNode())
    yield alone
    alone.wearer.close()
    alone.close()


def test_a_node_of_another_program_with_the_compensators_name_does_not_end_the_node_and_is_refused(alone):
    other = alone.add(rclpy.create_node("compensator"))
    publisher = other.create_publisher(DiagnosticArray, "/diagnostics", 10)
    values = [KeyValue(key="answers", value="many")]
    report = DiagnosticArray(status=[DiagnosticStatus(name="compensator", values=values)])
    other.create_timer(0.05, lambda: publisher.publish(report))
    alone.wait_until(lambda: alone.statuses["wearer"].message == "the compensator has no parameter 'law'")
    assert alone.wearer.failure is None


@pytest.mark.thorough
def test_the_wearers_torque_on_an_arm_of_three_joints_is_known_once_its_urdf_arrives(worn):
    names, pose, given = ["abduction", "flexion", "elbow"], [0.4, 0.5, 0.7], np.array((1.0, -2.0, 0.5))
    text = packaged_config("arms/three_joints.urdf").read_text(encoding="utf-8")
    urdf = {"urdf.topic": "/robot_description", "urdf.hand": "hand", "max_effort": [30.0] * 3}
    rig = worn({"law": "urdf", "use_imu": "false", "joint_names": f"[{','.join(names)}]", **urdf}, names, pose)
    rig.effort = (MujocoArm(text, names).torque(pose, GRAVITY) - given).tolist()
    rig.user.create_publisher(String, "/robot_description", LATCHED).publish(String(data=text))
    rig.start(with_wearer=True)
    torques = rig.estimates[""]
    rig.wait_until(lambda: len(torques) > 50)
    assert list(torques[-1].name) == names and torques[-1].effort == pytest.approx(given, abs=1e-6)
    assert rig.found("budget") == "unknown"


@pytest.mark.thorough
def test_the_support_follows_an_arm_that_sinks_and_returns_when_the_node_ends_while_the_arm_is_carried_on(worn):
    rig = worn(ADAPTIVE)
    rig.effort, sinking = CARRIED.tolist(), [0.0]  # rad in each cycle, of the second joint

    def sink(_stamp: object) -> None:
        rig.pose[1] -= sinking[0]

    in_use = lambda: float(rig.values["support in use"] or 0.0)  # noqa: E731
    asked = lambda: float(rig.found("support asked for").replace("none", "") or 0.0)  # noqa: E731
    rig.on_cycle = sink
    rig.start(with_wearer=True)
    rig.wait_until(lambda: rig.found("support adapts") == "on" and asked() == 0.4)
    sinking[0] = 0.0004
    rig.wait_until(lambda: asked() > 0.4 and in_use() > 0.4)
    sinking[0] = 0.0
    assert rig.values["support"] == "0.4"
    assert rig.set(model_error__wearer=0.3) == [""]
    rig.wait_until(lambda: asked() == 0.4 and rig.found("support adapts") == "held")
    assert rig.set(model_error__wearer=0.03) == [""]
    sinking[0] = 0.0004
    rig.wait_until(lambda: in_use() > 0.42)
    rig.wearer.close()
    rig.wait_until(lambda: in_use() == 0.4 and rig.values["support request"] == "none")
    count = len(rig.commands)
    rig.wait_until(lambda: len(rig.commands) > count + 50 and rig.commands[-1])


# Compensator, wearer and the tools make the same arm of a URDF whose chain has joints that are not the arm's


def test_a_joint_that_is_not_listed_is_at_0_for_compensator_wearer_and_tools(alone, tmp_path):
    text, names = random_chain(3, seed=5)
    urdf, listed = tmp_path / "chain.urdf", [names[0], names[2]]
    urdf.write_text(text)
    given = {"law": "urdf", "use_imu": False, "joint_names": listed, "urdf.file": str(urdf), "urdf.hand": "hand"}
    given["max_effort"] = [30.0] * 2
    bridge = {
        "joint_names": listed, "can.interface": "virtual", "can.channel": "one_urdf_arm", "motor": ["AK80-9"] * 2,
        "can_id": [1, 2], "max_effort": [9.0] * 2, "position_min": [-1.0] * 2, "position_max": [1.0] * 2,
    }  # fmt: skip
    own = [Parameter(name, value=value) for name, value in given.items()]
    has = {"parameter_overrides": own, "automatically_declare_parameters_from_overrides": True}
    node = alone.add(rclpy.create_node("compensator", **has), is_spun=False)
    _, values, read, arm = declared(node)
    assert arm.fixed == (names[1],)
    of_tools = read_arm({"/right/can_bridge": bridge, "/right/compensator": given}, "/right").settings
    made = read(values), alone.wearer._read(values), of_tools
    oracle = MujocoArm(text, listed)
    for theta in np.random.default_rng(0).uniform(-2.0, 2.0, (10, 2)):
        for settings in made:
            torque, _ = settings.torque(theta.tolist(), Tilt.of("left"))
            np.testing.assert_allclose(torque, oracle.torque(theta, GRAVITY), rtol=0.0, atol=1e-10)
