"""robot_model: what viewers need of the arms that run: a description, joint states of both, and markers.

It looks for compensators, requests the parameters of each and of its bridge, and publishes

    robot_description  std_msgs/String, latched: the URDF of all arms, again whenever an arm is added
    joint_states       sensor_msgs/JointState of all arms, unless this is the topic of one of them
    ~/markers          visualization_msgs/MarkerArray: gravity, torques, limits and the state of each arm

It only reads: nothing depends on it, and the arms run on if it ends.
"""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.tilt import gravity_in_trunk
from exo_gravity.core.view.arm_description import ROBOT_MODEL
from exo_gravity.core.view.scene import ArmView, arm_shapes, gravity_shapes
from exo_gravity.core.view.urdf import joint_names, urdf
from exo_gravity.nodes.robot_model.markers import marker_array
from exo_gravity.nodes.robot_model.viewed_arm import STALE, ViewedArm
from exo_gravity.nodes.ros.hot_path import LATCHED, NEWEST, HotPath
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics
from exo_gravity.nodes.ros.parameters import declare
from exo_gravity.nodes.ros.run import run

DISCOVERY_PERIOD = 0.5  # s between two searches for arms
MARKER_PERIOD = 0.1  # s


class RobotModel(Node):
    """Follows every arm that it finds."""

    def __init__(self) -> None:
        super().__init__("robot_model", automatically_declare_parameters_from_overrides=True)
        values = declare(self, ROBOT_MODEL)
        self._meshes = values["meshes"]
        self._arms: dict[str, ViewedArm] = {}
        self._views: list[tuple[ViewedArm, ArmView]] = []
        self._described: tuple[ViewedArm, ...] = ()
        self._problem = ""  # of the description
        self._tilt, self._tilt_time = (0.0, 0.0), -math.inf
        self._diagnostics = Diagnostics(self)
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        self._joint_states = self.create_publisher(JointState, "joint_states", 1)
        self._markers = self.create_publisher(MarkerArray, "~/markers", 1)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._tilts = HotPath(self, Vector3Stamped, "/imu/pitch_yaw", self._on_tilt, NEWEST)
        self.create_timer(DISCOVERY_PERIOD, self._discover)
        self.create_timer(1.0 / values["rate"], self._publish_states)
        self.create_timer(MARKER_PERIOD, self._publish_markers)

    def _discover(self) -> None:
        for name, namespace in self.get_node_names_and_namespaces():
            if name == "compensator" and namespace not in self._arms:
                self._arms[namespace] = ViewedArm(self, namespace.rstrip("/"))
        for arm in self._arms.values():
            arm.request()
        self._describe()
        problem = self._problem or next((arm.problem for arm in self._arms.values() if arm.problem), "")
        if not self._arms:
            problem = "waiting for a compensator"
        level, message = (WARN, problem) if problem else (OK, f"publishing {', '.join(sorted(self._arms))}")
        self._diagnostics.report(level, message, {"arms": len(self._arms), "shown": len(self._views)})

    def _describe(self) -> None:
        """Publish the description if the arms that are known have changed."""
        known = tuple(arm for _, arm in sorted(self._arms.items()) if arm.description)
        if known == self._described:
            return
        self._described = known
        try:
            text = urdf([arm.description for arm in known if arm.description], self._meshes)
        except ParameterError as error:
            self._problem = str(error)
            return
        self._problem = ""
        self._description.publish(String(data=text))

    def _publish_states(self) -> None:
        self._views = [(arm, view) for arm in self._described if (view := arm.view())]
        own_topic = self._joint_states.topic_name
        if not self._views or self._problem or own_topic in {arm.states_topic for arm in self._arms.values()}:
            return
        names = joint_names([arm.description for arm in self._described if arm.description])
        by_arm = dict(zip(self._described, names, strict=True))
        states = JointState()
        states.header.stamp = max((arm.states.header.stamp for arm, _ in self._views if arm.states), key=_seconds)
        for arm, view in self._views:
            states.name = [*states.name, *by_arm[arm]]
            states.position = [*states.position, *view.theta]
            states.velocity = [*states.velocity, *view.velocity]
            states.effort = [*states.effort, *view.effort]
        self._joint_states.publish(states)

    def _publish_markers(self) -> None:
        self._tilts.poll()
        if not self._markers.get_subscription_count():
            return
        fresh = time.monotonic() - self._tilt_time < STALE
        shapes = [("", shape) for shape in gravity_shapes(gravity_in_trunk(*self._tilt) if fresh else None)]
        for _, view in self._views:
            shapes += [(view.arm.side, shape) for shape in arm_shapes(view)]
        self._markers.publish(marker_array(shapes, self.get_clock().now().to_msg()))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for arm in self._arms.values():
                arm.note(status)

    def _on_tilt(self, message: Vector3Stamped, _info: dict[str, Any]) -> None:
        self._tilt, self._tilt_time = (message.vector.y, message.vector.x), time.monotonic()


def _seconds(stamp: Any) -> tuple[int, int]:
    return stamp.sec, stamp.nanosec


def main() -> None:
    """Entry point of the executable `robot_model`."""
    raise SystemExit(run(RobotModel))
