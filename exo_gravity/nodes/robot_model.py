# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""robot_model: what viewers need of the arms that run: a description, joint states of both, and markers.

It looks for compensators, requests the parameters of each and of its bridge, and publishes

    robot_description  std_msgs/String, latched: the URDF of all arms, again whenever an arm is added or changed
    joint_states       sensor_msgs/JointState of all arms, unless this is the topic of one of them
    ~/markers          visualization_msgs/MarkerArray: gravity, torques, limits and the state of each arm

It only reads: nothing depends on it, and the arms run on if it ends.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Vector3Stamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.inputs.arms import fitting
from exo_gravity.lab.view import (
    ARROW,
    LINE,
    ROBOT_MODEL,
    ROOT,
    SPHERE,
    TEXT,
    ArmView,
    Described,
    Shape,
    arm_shapes,
    described,
    gravity_shapes,
    joint_names,
    urdf,
)
from exo_gravity.lab.vocabulary import NodeState
from exo_gravity.nodes.others import Latest, OtherNodes, Statuses
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics, by_name, to_nanoseconds
from exo_gravity.nodes.ros.parameters import declare
from exo_gravity.nodes.ros.run import run
from exo_gravity.nodes.ros.subscriptions import LATCHED, PITCH_YAW

COMPENSATOR, BRIDGE = "compensator", "can_bridge"  # the nodes of an arm


@dataclass(frozen=True)
class ModelTiming:
    """When the arms are looked for and shown, and until when."""

    discovery_period: float = 0.5  #: s between two searches for arms
    marker_period: float = 0.1  #: s between two sets of markers
    stale: float = 0.5  #: s after which a reading or a state is no longer shown
    stale_state: float = 2.0  #: s; states come twice a second


TIMING = ModelTiming()


KINDS = {ARROW: Marker.ARROW, LINE: Marker.LINE_STRIP, SPHERE: Marker.SPHERE, TEXT: Marker.TEXT_VIEW_FACING}
LIFETIME = Duration(nanosec=500_000_000)  # a marker that is no longer sent disappears


class RobotModel(Node):
    """Follows every arm that it finds."""

    def __init__(self) -> None:
        super().__init__("robot_model", automatically_declare_parameters_from_overrides=True)
        values = declare(self, ROBOT_MODEL)
        self._meshes = values["meshes"]
        self._others = OtherNodes(self, (COMPENSATOR, BRIDGE), fitting=fitting)
        self._statuses = Statuses(self)
        self._arms: dict[str, ViewedArm] = {}  # by namespace
        self._views: list[tuple[ViewedArm, ArmView]] = []
        self._described: dict[ViewedArm, Described] = {}
        self._problem = ""  # of the description
        self._tilt = Latest(self, Vector3Stamped, PITCH_YAW, lambda m: gravity_in_trunk(m.vector.y, m.vector.x))
        self._diagnostics = Diagnostics(self)
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        self._joint_states = self.create_publisher(JointState, "joint_states", 1)
        self._markers = self.create_publisher(MarkerArray, "~/markers", 1)
        self.create_timer(TIMING.discovery_period, self._discover)
        self.create_timer(1.0 / values["rate"], self._publish_states)
        self.create_timer(TIMING.marker_period, self._publish_markers)

    def _discover(self) -> None:
        self._others.update()
        for name in self._others.found:
            namespace, _, leaf = name.rpartition("/")
            if leaf == COMPENSATOR and namespace not in self._arms:
                self._arms[namespace] = ViewedArm(self, namespace)
        for namespace, arm in self._arms.items():
            arm.describe(*(self._others.values(f"{namespace}/{leaf}") for leaf in (COMPENSATOR, BRIDGE)))
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
        values = {"state": NodeState.WAITING if problem else NodeState.PUBLISHING, "arms": len(self._arms)}
        self._diagnostics.report(level, message, values | {"shown": len(self._views)})

    def _publish_states(self) -> None:
        names = dict(zip(self._described, joint_names(list(self._described.values())), strict=True))
        found = ((arm, arm.view(self._statuses.within(TIMING.stale_state, arm.bridge))) for arm in self._described)
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
        states.header.stamp = max((arm.stamp for arm, _ in views), key=to_nanoseconds)
        self._joint_states.publish(states)

    def _publish_markers(self) -> None:
        gravity = self._tilt.within(TIMING.stale)
        if not self._markers.get_subscription_count():
            return
        groups = [("", gravity_shapes(gravity))]
        groups += [(f"{view.arm.side}/", arm_shapes(view)) for _, view in self._views]
        stamp = self.get_clock().now().to_msg()
        markers = [marker(stamp, owner, n, shape) for owner, shapes in groups for n, shape in enumerate(shapes)]
        self._markers.publish(MarkerArray(markers=markers))


class ViewedArm:
    """The arm in `namespace` ('/right', '' for the root): its description and its newest joint states."""

    def __init__(self, node: Node, namespace: str) -> None:
        self.description: Described | None = None  #: None until both nodes have answered
        #: Why there is no description or no reading, '' if nothing is wrong
        self.problem = f"waiting for the parameters of {namespace}/{COMPENSATOR} and {namespace}/{BRIDGE}"
        self.states_topic = f"{namespace}/joint_states"
        self.stamp = Time()  #: of the newest joint states
        self.bridge = f"{namespace}/{BRIDGE}".lstrip("/")
        self._states = Latest(node, JointState, self.states_topic)
        self._parameters: tuple[object, ...] = ()  # that were described

    def describe(self, *parameters: dict[str, Any]) -> None:
        """Take the parameters of compensator and bridge, {} while they are not known."""
        if parameters == self._parameters or not all(parameters):
            return
        self._parameters, self.description = parameters, None
        try:
            with suppress(KeyError):  # one of them is of another kind of arm
                self.description = described(*parameters)
        except ParameterError as error:
            self.problem = f"{self.bridge.rpartition('/')[0] or 'arm'}: {error}"

    def view(self, status: Mapping[str, Any]) -> ArmView | None:
        """Return what is known of the arm now; None without a description or a fresh reading. status: its bridge's."""
        states = self._states.within(TIMING.stale)
        if self.description is None:
            return None
        if states is None:
            self.problem = f"no messages on {self.states_topic}"
            return None
        names = self.description.limits.joint_names
        try:
            theta, velocity, effort = (by_name(states, field, names) for field in ("position", "velocity", "effort"))
        except ParameterError as error:
            self.problem = f"{self.states_topic}: {error.name} must be {error.expected}"
            return None
        self.problem, self.stamp = "", states.header.stamp
        return ArmView(self.description, theta, velocity, effort, status.get("state", ""), status.get("message", ""))


def marker(stamp: Time, owner: str, number: int, shape: Shape) -> Marker:
    """Return the marker of a shape; owner: 'left/' or 'right/', or '' for what both arms share."""
    kind = KINDS[shape.kind]
    marker = Marker(ns=f"{owner}{shape.group}", id=number, type=kind, lifetime=LIFETIME, text=shape.text)
    marker.header.frame_id, marker.header.stamp = ROOT, stamp
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
