"""The compensator's node with an outer loop and terms, in virtual time."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
import rclpy
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.nodes.compensator.node import CompensatorNode

from ..support.joint_state_feeder import PARTS, POSE
from ..support.virtual_ros import VirtualRos, start_ros

NAMES = [f"right_{part}" for part in PARTS]
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
GRAVITY = gravity_torque(ROBOT, POSE)
ASSIST = (0.5, -0.5, 0.25, 0.0)
STILL = (0.0,) * 4


class Rig:
    """A compensator, fed 200 times a second with joint states and, if `assisted`, with efforts of an outer loop."""

    def __init__(self, ros: VirtualRos) -> None:
        start_ros("/right", use_imu=False)
        self.ros, self.node = ros, CompensatorNode()
        self.joint_states, self.assist = (
            self.node.create_publisher(JointState, topic, 1) for topic in ("joint_states", "assist_efforts")
        )
        self.velocity, self.names, self.efforts, self.assisted = STILL, NAMES, ASSIST, False
        ros.clock.every(0.005, self._send)

    def _send(self) -> None:
        stamp = self.ros.now().to_msg()
        states = JointState(name=NAMES, position=POSE, velocity=self.velocity)
        states.header.stamp = stamp
        self.joint_states.publish(states)
        if self.assisted:
            efforts = JointState(name=self.names, effort=self.efforts)
            efforts.header.stamp = stamp
            self.assist.publish(efforts)

    @property
    def message(self) -> str:
        return self.ros.status("right/compensator").message

    def reports(self, key: str) -> str:
        """Return the newest value of `key` on /diagnostics."""
        return {item.key: item.value for item in self.ros.status("right/compensator").values}[key]

    def set(self, **values: object) -> list[str]:
        """Set parameters (`__` for a dot) and return why each was refused, '' if it was not."""
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return [result.reason for result in self.node.set_parameters(changes)]

    def is_assisted(self) -> bool:
        return self.adds(ASSIST)

    def adds(self, torque: tuple[float, ...]) -> bool:
        """Return whether the newest efforts are gravity's and these, (4,) Nm."""
        newest = self.ros.messages["/right/effort_commands"][-1:]
        return bool(newest and newest[0].effort) and np.allclose(np.subtract(newest[0].effort, GRAVITY), torque)


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    """A node that carries the arm, without terms and without efforts of the outer loop."""
    rig = Rig(VirtualRos(monkeypatch))
    rig.ros.wait_until(lambda: rig.adds(STILL))
    yield rig
    rclpy.try_shutdown()


@pytest.fixture
def assisted(rig: Rig) -> Rig:
    """The same, to which the outer loop's efforts are added."""
    rig.assisted = True
    rig.set(assist__max_effort=[1.0] * 4)
    rig.ros.wait_until(rig.is_assisted)
    return rig


def test_efforts_of_the_outer_loop_are_added_and_the_arm_stays_carried_without_them(rig):
    rig.assisted = True
    rig.ros.clock.run(2.0)
    assert rig.adds(STILL) and rig.reports("assist") == "off"
    assert rig.set(assist__max_effort=[1.0] * 4) == [""]
    rig.ros.clock.run(2.0)
    assert rig.is_assisted() and (rig.reports("assist"), rig.reports("terms")) == ("assisting", "assist")
    rig.assisted = False
    rig.ros.clock.run(2.0)
    assert rig.adds(STILL) and rig.reports("assist") == "waiting: assist_efforts stopped"
    assert rig.message == "compensating"


@pytest.mark.parametrize(
    ("names", "efforts", "reason"),
    [(NAMES, (math.nan, 0.0, 0.0, 0.0), "must be numbers within 40 Nm"), (["x", *NAMES[1:]], ASSIST, "must name")],
)
def test_wrong_efforts_are_withdrawn_and_reported_while_gravity_compensation_goes_on(assisted, names, efforts, reason):
    assisted.names, assisted.efforts = names, efforts
    assisted.ros.clock.run(2.0)
    assert assisted.adds(STILL)
    assert assisted.message.startswith("gravity compensation alone: ") and reason in assisted.message
    assisted.names, assisted.efforts = NAMES, ASSIST
    assisted.ros.clock.run(2.0)
    assert assisted.is_assisted() and assisted.message == "compensating"


def test_a_second_outer_loop_ends_the_assistance_of_both(assisted):
    other = assisted.node.create_publisher(JointState, "assist_efforts", 1)
    message = JointState(name=NAMES, effort=(0.0, 1.0, 0.0, 0.0))

    def send() -> None:
        message.header.stamp = assisted.ros.now().to_msg()
        other.publish(message)

    end = assisted.ros.clock.every(0.007, send)
    assisted.ros.clock.run(2.0)
    assert assisted.adds(STILL) and "more than one publisher" in assisted.message
    end()
    assisted.ros.wait_until(assisted.is_assisted)


def test_terms_are_set_live_and_need_velocities(rig):
    rig.velocity = (0.15, -0.15, 0.0, 0.0)  # a change of load waits for slow joints
    assert rig.set(friction__coulomb=[0.2, 0.4, 0.2, 0.2], friction__share=0.5) == ["", ""]
    rig.ros.wait_until(lambda: rig.adds((0.1, -0.2, 0.0, 0.0)))
    rig.ros.wait_until(lambda: rig.reports("terms") == "friction")
    rig.velocity = ()
    rig.ros.wait_until(lambda: rig.adds(STILL))
