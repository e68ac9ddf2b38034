"""The compensator's node with `law: urdf` and `command_interface: multi_array`, in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import rclpy
import rtbdata
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.nodes.compensator import arm
from exo_gravity.nodes.compensator.node import CompensatorNode
from exo_gravity.nodes.ros.hot_path import LATCHED
from exo_gravity.nodes.ros.messages import to_time

from ..support.virtual_ros import VirtualRos, start_ros

URDF = Path(rtbdata.__path__[0], "xacro/kuka_description/kuka_kr16/urdf/kr16_2.urdf")
NAMES = [f"joint_a{n}" for n in range(1, 7)]
POSE = (0.3, -0.8, 1.1, 0.4, -0.6, 0.2)
EXPECTED = UrdfArm(URDF.read_text(), NAMES).torque(POSE, (0.0, 0.0, -9.80665))
PARAMETERS = {
    "joint_names": f"[{','.join(NAMES)}]",
    "law": "urdf",
    "urdf.file": str(URDF),
    "use_imu": False,
    "command_interface": "multi_array",
    "multi_array.timeout": 0.15,
    "max_effort": [200.0] * 6,
    "max_effort_rate": 1000.0,
    "side": "left",  # of the exoskeleton's own arm: ignored
}


class Rig:
    """A compensator of six joints, which ros2_control feeds 100 times a second.

    applied: Nm, in the order of `names`. lag: age of the stamps in s.
    """

    def __init__(self, ros: VirtualRos) -> None:
        self.lag, self.names, self.pose = 0.0, ["gripper", *NAMES[::-1]], (float("nan"), *POSE[::-1])
        self.applied: tuple[float, ...] = (0.0,) * 7
        self.is_feeding = True
        start_ros("/arm", **PARAMETERS)
        self.ros, self.node = ros, CompensatorNode()
        self._states = self.node.create_publisher(JointState, "joint_states", 1)
        ros.clock.every(0.01, self._send)

    def _send(self) -> None:
        if self.is_feeding:
            still = [0.0] * len(self.names)
            states = JointState(name=self.names, position=self.pose, velocity=still, effort=self.applied)
            states.header.stamp = to_time(self.ros.now().nanoseconds - round(self.lag * 1e9))
            self._states.publish(states)

    @property
    def commands(self) -> list[tuple[float, ...]]:
        """All so far, (6,) Nm each."""
        return [tuple(message.data) for message in self.ros.messages["/arm/effort_controller/commands"]]

    @property
    def status(self) -> DiagnosticStatus:
        return self.ros.status("arm/compensator")

    @property
    def values(self) -> dict[str, str]:
        return {item.key: item.value for item in self.status.values}

    def is_carried(self) -> bool:
        return self.sends(EXPECTED)

    def is_zero(self) -> bool:
        return self.sends((0.0,) * 6)

    def sends(self, torque: Sequence[float]) -> bool:
        newest = self.ros.messages["/arm/effort_controller/commands"][-1:]
        return bool(newest) and np.allclose(newest[0].data, torque, rtol=0.0, atol=1e-9)

    def clear(self) -> bool:
        return bool(self.ros.call("/arm/compensator/clear_fault").success)


@pytest.fixture
def make_rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Rig]]:
    yield lambda: Rig(VirtualRos(monkeypatch))
    rclpy.try_shutdown()


@pytest.fixture
def rig(make_rig: Callable[[], Rig]) -> Rig:
    """A node that carries the arm."""
    rig = make_rig()
    rig.ros.wait_until(rig.is_carried)
    return rig


@pytest.mark.parametrize("is_published", [True, False])
def test_the_description_may_come_from_a_latched_topic_and_is_missed_at_the_start(monkeypatch, is_published):
    """Over real DDS."""
    monkeypatch.setattr(arm, "DESCRIPTION_TIMEOUT", 60.0 if is_published else 0.2)
    start_ros("/arm", **PARAMETERS | {"urdf.file": '""', "urdf.topic": "robot_description"})
    user = rclpy.create_node("robot")
    try:
        if is_published:
            user.create_publisher(String, "robot_description", LATCHED).publish(String(data=URDF.read_text()))
            CompensatorNode().close()
        else:
            with pytest.raises(ParameterError, match=r"urdf\.topic = 'robot_description': must be published, latched"):
                CompensatorNode()
    finally:
        user.destroy_node()
        rclpy.try_shutdown()


def test_after_a_restart_the_torque_begins_from_what_the_joints_apply(make_rig):
    rig = make_rig()
    rig.applied = ()
    rig.ros.wait_until(lambda: "joint_states: effort must be 7 values" in rig.status.message)
    assert rig.commands == [] and rig.status.level == DiagnosticStatus.ERROR
    rig.applied = (0.0, *(float(n) for n in range(6, 0, -1)))
    rig.ros.wait_until(lambda: rig.commands)
    assert rig.commands[0] == pytest.approx((1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    rig.ros.wait_until(rig.is_carried)


def test_six_joints_among_others_in_any_order_are_carried_in_the_order_of_the_controller(rig):
    rig.ros.wait_until(lambda: rig.status.message == "compensating")
    assert rig.values["output"] == "active"
    assert rig.values["law"] == "urdf" and rig.values["mass carried (kg)"] == "12.000"


def test_gains_and_limits_change_live_and_the_law_does_not(rig):
    results = rig.node.set_parameters([Parameter("gain", value=[0.9] * 6), Parameter("law", value="exact")])
    assert [result.successful for result in results] == [True, False]
    rig.ros.wait_until(lambda: rig.sends(np.multiply(0.9, EXPECTED)))


def test_without_joint_states_the_torque_fades_to_zeros_until_the_fault_is_cleared(rig):
    rig.is_feeding = False
    carried = len(rig.commands)
    rig.ros.wait_until(rig.is_zero)
    faded = np.abs(rig.commands[carried:])
    assert len(faded) > 5 and np.all(np.diff(faded, axis=0) <= 1e-12)
    rig.ros.wait_until(lambda: "no joint_states younger than 150 ms: zero, call clear_fault" in rig.status.message)
    assert rig.status.level == DiagnosticStatus.ERROR
    rig.is_feeding = True
    count = len(rig.commands)
    rig.ros.clock.run(1.0)
    assert len(rig.commands) > count + 20 and not np.any(rig.commands[count:])
    assert rig.clear()
    rig.ros.wait_until(rig.is_carried)


def test_joint_states_that_are_old_by_their_stamps_do_not_count(rig):
    rig.lag = 1.0
    rig.ros.wait_until(rig.is_zero)
    rig.ros.wait_until(lambda: "no joint_states younger than 150 ms" in rig.status.message)
    assert "age by its stamp" in rig.values["last refused message"]


def test_a_missing_joint_fades_the_torque(rig):
    rig.names, rig.pose, rig.applied = rig.names[:-1], rig.pose[:-1], ()
    rig.ros.wait_until(rig.is_zero)
    rig.ros.wait_until(lambda: "joint_states: name must be joint_a1" in rig.status.message)


def test_the_torque_fades_to_zero_before_the_node_ends(rig):
    rig.node.close()
    assert rig.is_zero()
