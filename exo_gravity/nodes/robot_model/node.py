"""robot_model: what viewers need of the arms that run: a description, joint states of both, and markers.

It looks for compensators, requests the parameters of each and of its bridge, and publishes

    robot_description  std_msgs/String, latched: the URDF of all arms, again whenever an arm is added or changed
    joint_states       sensor_msgs/JointState of all arms, unless this is the topic of one of them
    ~/markers          visualization_msgs/MarkerArray: gravity, torques, limits and the state of each arm

It only reads: nothing depends on it, and the arms run on if it ends.
"""

import time
from contextlib import suppress
from typing import Any

from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.tilt import gravity_in_trunk
from exo_gravity.core.view.scene import ARROW, LINE, SPHERE, TEXT, ArmView, Shape, arm_shapes, gravity_shapes
from exo_gravity.core.view.urdf import ROBOT_MODEL, ROOT, ArmDescription, described, joint_names, urdf
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics, Newest, by_name, status_values, to_nanoseconds
from exo_gravity.nodes.ros.parameters import NodeParameters, declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import LATCHED, NEWEST, HotPath

DISCOVERY_PERIOD = 0.5  # s between two searches for arms
MARKER_PERIOD = 0.1  # s
STALE = 0.5  # s after which a reading or a state is no longer shown
STALE_STATE = 2.0  # s; states come twice a second
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
        self._described: dict[ViewedArm, ArmDescription] = {}
        self._problem = ""  # of the description
        self._tilt = Newest()  # gravity in the trunk's axes
        self._status: dict[str, Newest] = {}  # of each node
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
            for parameters in arm.parameters:
                parameters.update()
        known = {arm: arm.description for _, arm in sorted(self._arms.items()) if arm.description}
        if known != self._described:
            self._described, self._problem = known, ""
            try:
                self._description.publish(String(data=urdf(list(known.values()), self._meshes)))
            except ParameterError as error:
                self._problem = str(error)
        problems = [self._problem, *(arm.problem for arm in self._arms.values())]
        problem = next(filter(None, problems), "" if self._arms else "waiting for a compensator")
        level, message = (WARN, problem) if problem else (OK, f"publishing {', '.join(sorted(self._arms))}")
        self._diagnostics.report(level, message, {"arms": len(self._arms), "shown": len(self._views)})

    def _publish_states(self) -> None:
        names = dict(zip(self._described, joint_names(list(self._described.values())), strict=True))
        found = ((arm, arm.view(self._status.get(arm.bridge, Newest()))) for arm in self._described)
        self._views = views = [(arm, view) for arm, view in found if view]
        own_topic = self._joint_states.topic_name
        if not views or self._problem or own_topic in {arm.states_topic for arm in self._arms.values()}:
            return
        states = JointState(
            name=[name for arm, _ in views for name in names[arm]],
            position=[theta for _, view in views for theta in view.theta],
            velocity=[velocity for _, view in views for velocity in view.velocity],
            effort=[effort for _, view in views for effort in view.effort],
        )
        states.header.stamp = max((arm.states.header.stamp for arm, _ in views), key=to_nanoseconds)
        self._joint_states.publish(states)

    def _publish_markers(self) -> None:
        self._tilts.poll()
        if not self._markers.get_subscription_count():
            return
        groups = [("", gravity_shapes(self._tilt.within(STALE)))]
        groups += [(f"{view.arm.side}/", arm_shapes(view)) for _, view in self._views]
        markers = [marker(owner, n, shape) for owner, shapes in groups for n, shape in enumerate(shapes)]
        stamp = self.get_clock().now().to_msg()
        for each in markers:
            each.header.stamp = stamp
        self._markers.publish(MarkerArray(markers=markers))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        self._status.update({status.name: Newest(status_values(status), now) for status in message.status})

    def _on_tilt(self, message: Vector3Stamped, _info: dict[str, Any]) -> None:
        self._tilt = Newest(gravity_in_trunk(message.vector.y, message.vector.x), time.monotonic())


class ViewedArm:
    """The arm in `namespace` ('/right', '' for the root): its parameters and its newest joint states."""

    def __init__(self, node: Node, namespace: str) -> None:
        self.description: ArmDescription | None = None  #: None until both nodes have answered
        #: Why there is no description or no reading, '' if nothing is wrong
        self.problem = f"waiting for the parameters of {namespace}/compensator and {namespace}/can_bridge"
        self.states_topic = f"{namespace}/joint_states"
        self.states = JointState()
        self.bridge = f"{namespace}/can_bridge".lstrip("/")
        self._arrived = Newest()
        self.parameters = [
            NodeParameters(node, f"{namespace}/{leaf}", self._on_values) for leaf in ("compensator", "can_bridge")
        ]
        self._subscription = HotPath(node, JointState, self.states_topic, self._on_states, NEWEST)

    def view(self, status: Newest) -> ArmView | None:
        """Return what is known of the arm now; None without a description or a fresh reading. status: its bridge's."""
        self._subscription.poll()
        if self.description is None:
            return None
        self.problem = "" if self._arrived.within(STALE) else f"no messages on {self.states_topic}"
        try:
            names = self.description.limits.joint_names
            fields = ("position", "velocity", "effort")
            theta, velocity, effort = (by_name(self.states, field, names) for field in fields)
        except ParameterError as error:
            self.problem = self.problem or f"{self.states_topic}: {error.name} must be {error.expected}"
        if self.problem:
            return None
        values = status.within(STALE_STATE) or {}
        return ArmView(self.description, theta, velocity, effort, values.get("state", ""), values.get("message", ""))

    def _on_states(self, message: JointState, _info: dict[str, Any]) -> None:
        self.states, self._arrived = message, Newest(True, time.monotonic())

    def _on_values(self, _values: object) -> None:
        try:
            with suppress(KeyError):  # one of them has not answered yet, or is of another kind of arm
                self.description = described(*(parameters.values for parameters in self.parameters))
        except ParameterError as error:
            self.problem = f"{self.bridge.rpartition('/')[0] or 'arm'}: {error}"


def marker(owner: str, number: int, shape: Shape) -> Marker:
    """Return the marker of a shape; owner: 'left/' or 'right/', or '' for what both arms share."""
    kind = KINDS[shape.kind]
    marker = Marker(ns=f"{owner}{shape.group}", id=number, type=kind, lifetime=LIFETIME, text=shape.text)
    marker.header.frame_id = ROOT
    marker.color = ColorRGBA(**dict(zip("rgba", shape.colour, strict=True)))
    marker.pose.orientation.w = 1.0
    points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
    scale = marker.scale
    scale.x = shape.size
    if shape.kind in (LINE, ARROW):
        marker.points = points
        scale.y = 2 * shape.size  # of an arrow's head
    else:
        marker.pose.position = points[0]
        scale.y = scale.z = shape.size
    return marker


def main() -> None:
    """Entry point of the executable `robot_model`."""
    raise SystemExit(run(RobotModel))
