# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator's node with `law: urdf` and `command_interface: multi_array`, over real DDS in this process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation import guidance
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety import guidance as guided
from exo_gravity.hardware.network import keep_to_this_machine
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.nodes.compensator import arm
from exo_gravity.nodes.ros.subscriptions import LATCHED

from ..support.compensator_rig import CompensatorRig

keep_to_this_machine()
ARMS = Path(__file__).parents[1] / "data" / "arms"
URDF = ARMS / "ur5.urdf"
NAMES = [f"{part}_joint" for part in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
POSE = (0.3, -0.8, 1.1, 0.4, -0.6, 0.2)
EXPECTED = UrdfArm(URDF.read_text(), NAMES).torque(POSE, Tilt.of("left"))
PARAMETERS = {
    "law": "urdf",
    "joint_names": f"[{','.join(NAMES)}]",
    "urdf.file": URDF,
    "use_imu": "false",
    "command_interface": "multi_array",
    "multi_array.timeout": 0.15,
    "max_effort": [200.0] * 6,
    "max_effort_rate": 1000.0,
    "side": "left",  # of the exoskeleton's own arm: ignored
}


class Rig(CompensatorRig):
    """A compensator of six joints, and a node that plays ros2_control. commands: all so far, (n,) Nm each."""

    def __init__(self, **changes: object) -> None:
        super().__init__("/arm", {**PARAMETERS, **changes})
        self.commands: list[tuple[float, ...]] = []
        self.lag, self.names, self.pose = 0.0, ["gripper", *NAMES[::-1]], (float("nan"), *POSE[::-1])
        self.applied = (0.0,) * 7  # Nm, in the order of `names`
        self.publisher = self.user.create_publisher(JointState, "joint_states", 1)
        self.user.create_subscription(
            Float64MultiArray,
            "effort_controller/commands",
            lambda message: self.commands.append(tuple(message.data)),
            100,
        )
        self.is_feeding = False
        self.user.create_timer(0.01, self._send)

    def start(self) -> Rig:
        super().start()
        self.is_feeding = True
        return self

    def _send(self) -> None:
        if self.is_feeding:
            still = [0.0] * len(self.names)
            states = JointState(name=self.names, position=self.pose, velocity=still, effort=self.applied)
            states.header.stamp = Time(nanoseconds=time.time_ns() - round(self.lag * 1e9)).to_msg()
            self.publisher.publish(states)

    def is_carried(self) -> bool:
        return bool(self.commands) and np.allclose(self.commands[-1], EXPECTED, rtol=0.0, atol=1e-9)

    def is_zero(self) -> bool:
        return len(self.commands) > 0 and not any(self.commands[-1])

    def clear(self) -> bool:
        client = self.user.create_client(Trigger, "compensator/clear_fault")
        self.wait_until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.wait_until(future.done)
        return future.result().success


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Shorter ramps and fades, which test_limiter.py times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guided, "GUIDANCE", replace(guided.GUIDANCE, time=0.2, rate=100.0))
        patch.setattr(guidance, "LAST_FADE", 0.4)
        yield


@pytest.fixture
def make_rig() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def make(**changes: object) -> Rig:
        rigs.append(Rig(**changes))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.close()


@pytest.fixture(scope="module")
def running() -> Iterator[Rig]:
    rig = Rig().start()
    yield rig
    rig.close()


@pytest.fixture
def rig(running: Rig) -> Rig:
    """The node of this module, fed with sound joint states, and carrying the arm."""
    running.lag, running.names, running.pose = 0.0, ["gripper", *NAMES[::-1]], (float("nan"), *POSE[::-1])
    running.is_feeding, running.applied = True, (0.0,) * 7
    running.commands.clear()
    return carried(running)


def carried(rig: Rig, condition: Callable[[], object] | None = None) -> Rig:
    """Return the rig once the arm is carried, or `condition()` holds; a fault, as of a busy machine, is cleared."""
    condition = condition or rig.is_carried
    while not condition():
        rig.wait_until(lambda: condition() or rig.values.get("output") == "zero")
        if not condition():
            rig.clear()
    return rig


def test_the_description_may_come_from_a_latched_topic_and_the_torque_begins_from_what_the_joints_apply(make_rig):
    rig = make_rig(**{"urdf.file": '""', "urdf.topic": "robot_description"})
    rig.user.create_publisher(String, "robot_description", LATCHED).publish(String(data=URDF.read_text()))
    rig.applied = ()
    rig.start()
    rig.wait_until(lambda: "joint_states: effort must be 7 values" in rig.status.message)
    assert rig.commands == [] and rig.status.level == DiagnosticStatus.ERROR
    rig.applied = (0.0, *(float(n) for n in range(6, 0, -1)))
    rig.wait_until(lambda: rig.commands)
    assert rig.commands[0] == pytest.approx((1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    carried(rig)


def test_the_positions_of_other_joints_come_from_the_joint_states_or_there_is_no_torque(make_rig):
    own = [f"panda_joint{n}" for n in (1, 2, 3)]
    rig = make_rig(**{"urdf.file": ARMS / "panda.urdf", "joint_names": f"[{','.join(own)}]", "max_effort": [87.0] * 3})
    rig.names, rig.pose, rig.applied = own, (0.0, 0.6, 0.0), (0.0,) * 3
    rig.start()
    rig.wait_until(lambda: "position of panda_joint4 must be in the joint states" in rig.status.message)
    assert "cannot be at 0 (limits -3.0718 to -0.0698)" in rig.status.message and rig.commands == []
    rig.names = [f"panda_joint{n}" for n in (4, 5, 6, 7, 1, 2, 3)]
    rig.pose, rig.applied = (-1.57, 0.0, 1.57, 0.78, 0.0, 0.6, 0.0), (0.0,) * 7
    # -44.9 Nm by differentiating the potential energy; -32.0 with the other joints at 0
    carried(rig, lambda: rig.commands and abs(rig.commands[-1][1] + 44.92) < 0.01)
    assert rig.values["joints taken to be at 0"] == "none"


def test_a_missing_description_is_an_error_at_the_start(make_rig, monkeypatch):
    monkeypatch.setattr(arm, "DESCRIPTION_TIMEOUT", 0.2)
    rig = make_rig(**{"urdf.file": '""'})
    with pytest.raises(ParameterError, match=r"urdf\.topic = '/robot_description': must be published, latched"):
        rig.start()


def test_six_joints_among_others_in_any_order_are_carried_in_the_order_of_the_controller(rig):
    carried(rig, lambda: rig.status.message == "compensating" and rig.values["output"] == "active")
    assert rig.values["law"] == "urdf" and rig.values["mass carried (kg)"] == "16.994"


def test_gains_and_limits_change_live_and_the_law_does_not(rig):
    accepted, refused = rig.set(gain=[0.9] * 6, law="exact")
    assert accepted == "" != refused
    carried(rig, lambda: np.allclose(rig.commands[-1], np.multiply(0.9, EXPECTED), rtol=0.0, atol=1e-9))
    assert rig.set(gain=[1.0] * 6) == [""]


def test_without_joint_states_the_torque_fades_to_zeros_until_the_fault_is_cleared(rig):
    rig.is_feeding = False
    rig.commands.clear()
    rig.wait_until(rig.is_zero)
    faded = np.abs(rig.commands)
    assert np.all(np.diff(faded, axis=0) <= 1e-12)
    rig.wait_until(lambda: "no joint_states younger than 150 ms: zero, call clear_fault" in rig.status.message)
    assert rig.status.level == DiagnosticStatus.ERROR
    rig.is_feeding = True
    count = len(rig.commands)
    rig.wait_until(lambda: len(rig.commands) > count + 20)
    assert not np.any(rig.commands[count:])
    assert rig.clear()
    carried(rig)


def test_joint_states_that_are_old_by_their_stamps_are_ignored(rig):
    rig.lag = 1.0
    rig.wait_until(rig.is_zero)
    rig.wait_until(lambda: "no joint_states younger than 150 ms" in rig.status.message)
    assert rig.values["refused message"] == "joint_states" and "age by its stamp" in rig.values["refused message text"]


def test_a_missing_joint_fades_the_torque(rig):
    rig.names, rig.pose, rig.applied = rig.names[:-1], rig.pose[:-1], rig.applied[:-1]
    rig.wait_until(rig.is_zero)
    carried(rig, lambda: f"joint_states: name must be {NAMES[0]}" in rig.status.message)


def test_the_torque_fades_to_zero_before_the_node_ends(rig):
    rig.node.close()
    rig.wait_until(rig.is_zero)
