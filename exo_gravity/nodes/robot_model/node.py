"""robot_model: what viewers need of the arms that run: a description, joint states of both, and markers.

It looks for compensators, requests the parameters of each and of its bridge, and publishes

    robot_description  std_msgs/String, latched: the URDF of all arms, again whenever an arm is added
    joint_states       sensor_msgs/JointState of all arms, unless this is the topic of one of them
    ~/markers          visualization_msgs/MarkerArray: gravity, torques, limits and the state of each arm

It only reads: nothing depends on it, and the arms run on if it ends.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.tilt import gravity_in_trunk
from exo_gravity.core.view.scene import ARROW, LINE, SPHERE, TEXT, ArmView, Shape, arm_shapes, gravity_shapes
from exo_gravity.core.view.urdf import (
    OF_BRIDGE,
    OF_COMPENSATOR,
    ROBOT_MODEL,
    ROOT,
    ArmDescription,
    described,
    joint_names,
    urdf,
)
from exo_gravity.nodes.ros.hot_path import LATCHED, NEWEST, HotPath
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics, by_name, to_nanoseconds
from exo_gravity.nodes.ros.parameters import NodeParameters, declare
from exo_gravity.nodes.ros.run import run

DISCOVERY_PERIOD = 0.5  # s between two searches for arms
MARKER_PERIOD = 0.1  # s
STALE = 0.5  # s after which a reading or a state is no longer shown
STALE_STATE = 2.0  # s; states come twice a second
FIELDS = ("position", "velocity", "effort")
KINDS = {ARROW: Marker.ARROW, LINE: Marker.LINE_STRIP, SPHERE: Marker.SPHERE, TEXT: Marker.TEXT_VIEW_FACING}
LIFETIME = Duration(nanosec=500_000_000)  # a marker that is no longer sent disappears


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
        for parameters in [parameters for arm in self._arms.values() for parameters in arm.parameters]:
            parameters.update()
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
        self._described, self._problem = known, ""
        try:
            text = urdf([arm.description for arm in known if arm.description], self._meshes)
            self._description.publish(String(data=text))
        except ParameterError as error:
            self._problem = str(error)

    def _publish_states(self) -> None:
        self._views = [(arm, view) for arm in self._described if (view := arm.view())]
        own_topic = self._joint_states.topic_name
        if not self._views or self._problem or own_topic in {arm.states_topic for arm in self._arms.values()}:
            return
        names = joint_names([arm.description for arm in self._described if arm.description])
        by_arm = dict(zip(self._described, names, strict=True))
        states = JointState()
        stamps = (arm.states.header.stamp for arm, _ in self._views if arm.states)
        states.header.stamp = max(stamps, key=to_nanoseconds)
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


class ViewedArm:
    """The arm in `namespace` ('/right', '' for the root): its parameters and its newest joint states."""

    def __init__(self, node: Node, namespace: str) -> None:
        self.description: ArmDescription | None = None  #: None until both nodes have answered
        #: Why there is no description or no reading, '' if nothing is wrong
        self.problem = f"waiting for the parameters of {namespace}/compensator and {namespace}/can_bridge"
        self.states_topic = f"{namespace}/joint_states"
        self.states: JointState | None = None
        self._node = node
        self._bridge = f"{namespace}/can_bridge".lstrip("/")
        self._status, self._status_time = ("", ""), -math.inf
        self._time = -math.inf
        self.parameters = [
            NodeParameters(node, f"{namespace}/{leaf}", self._on_values, names)
            for leaf, names in (("compensator", OF_COMPENSATOR), ("can_bridge", OF_BRIDGE))
        ]
        self._subscription = HotPath(node, JointState, self.states_topic, self._on_states, NEWEST)

    def note(self, status: DiagnosticStatus) -> None:
        """Keep the status of this arm's bridge; ignore any other."""
        if status.name == self._bridge:
            state = next((pair.value for pair in status.values if pair.key == "state"), "")
            self._status, self._status_time = (state, status.message), time.monotonic()

    def view(self) -> ArmView | None:
        """Return what is known of the arm now; None without a description or a fresh reading."""
        self._subscription.poll()
        now = time.monotonic()
        if self.description is None:
            return None
        if self.states is None or now - self._time > STALE:
            self.problem = f"no messages on {self.states_topic}"
            return None
        names = self.description.limits.joint_names
        try:
            theta, velocity, effort = (by_name(self.states, field, names) for field in FIELDS)
        except ParameterError as error:
            self.problem = f"{self.states_topic}: {error.name} must be {error.expected}"
            return None
        self.problem = ""
        state, message = self._status if now - self._status_time < STALE_STATE else ("", "")
        return ArmView(self.description, theta, velocity, effort, state, message)

    def _on_states(self, message: JointState, _info: dict[str, Any]) -> None:
        self.states, self._time = message, time.monotonic()

    def _on_values(self, _values: object) -> None:
        if not all(parameters.values for parameters in self.parameters):
            return
        try:
            self.description = described(*(parameters.values for parameters in self.parameters))
        except ParameterError as error:
            self.problem = f"{self._bridge.rpartition('/')[0] or 'arm'}: {error}"
            self._node.get_logger().error(self.problem)


def marker_array(shapes: Iterable[tuple[str, Shape]], stamp: Time) -> MarkerArray:
    """Return the markers of (owner, shape): an owner is a side, or '' for what both arms share."""
    markers, numbers = [], defaultdict[str, Iterator[int]](itertools.count)
    for owner, shape in shapes:
        group = f"{owner}/{shape.group}" if owner else shape.group
        markers.append(_marker(group, next(numbers[group]), shape, stamp))
    return MarkerArray(markers=markers)


def _marker(group: str, number: int, shape: Shape, stamp: Time) -> Marker:
    marker = Marker(ns=group, id=number, type=KINDS[shape.kind], action=Marker.ADD, lifetime=LIFETIME, text=shape.text)
    marker.header.stamp, marker.header.frame_id = stamp, ROOT
    marker.color = ColorRGBA(**dict(zip("rgba", shape.colour, strict=True)))
    marker.pose.orientation.w = 1.0
    points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
    scale = marker.scale
    if shape.kind in (LINE, ARROW):
        marker.points = points
        scale.x = shape.size
        if shape.kind == ARROW:  # x: diameter of the shaft, y: of the head
            scale.y = 2 * shape.size
    else:
        marker.pose.position = points[0]
        scale.x = scale.y = scale.z = shape.size
    return marker


def main() -> None:
    """Entry point of the executable `robot_model`."""
    raise SystemExit(run(RobotModel))
