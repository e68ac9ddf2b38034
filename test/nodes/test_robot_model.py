# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `robot_model` in this process, with what the nodes of both arms publish; and the viewers' layouts."""

import re
from collections.abc import Iterator

import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.params import table_for, values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.hardware.network import restrict_to_localhost
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.view import ROOT
from exo_gravity.nodes.robot_model import RobotModel
from exo_gravity.nodes.ros.subscriptions import LATCHED
from exo_gravity.tools.urdf import urdf_of

from ..support import CONFIG, PARTS
from ..support.node_thread import NodeRig

restrict_to_localhost()
READINGS = {"left": (0.1, 0.2, 0.3, 0.4), "right": (-0.1, 0.5, 0.6, 0.7)}
EFFORT = (0.0, 1.5, 1.2, 0.2)
BOTH = CONFIG / "sim_both.yaml"


def names(side):
    return [f"{side}_{part}" for part in PARTS]


class Viewer(NodeRig):
    """A robot_model, nodes with the parameters of both arms, and a viewer that keeps the newest of what it sends.

    The viewer sends the tilt, and the states of bridges and joints of `sides`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.model = self.add(RobotModel())
        for name, given in load(BOTH).items():
            side, _, leaf = name[1:].partition("/")
            table = {"compensator": COMPENSATOR, "can_bridge": CAN_BRIDGE}.get(leaf)
            if table:
                node = self.add(rclpy.create_node(leaf, namespace=side))
                for parameter, value in values_of(table_for(table, given), given, "can.options").items():
                    node.declare_parameter(parameter, value)
        create, subscribe = self.user.create_publisher, self.user.create_subscription
        self.sent = {side: create(JointState, f"/{side}/joint_states", 1) for side in READINGS}
        self.tilt, self.reports = (
            create(Vector3Stamped, "/imu/pitch_yaw", 1),
            create(DiagnosticArray, "/diagnostics", 10),
        )
        self.description, self.states = String(), JointState()
        self.markers: dict[tuple[str, int], Marker] = {}
        subscribe(String, "/robot_description", lambda message: setattr(self, "description", message), LATCHED)
        subscribe(JointState, "/joint_states", lambda message: setattr(self, "states", message), 1)
        subscribe(MarkerArray, "/robot_model/markers", self._on_markers, 1)
        self.sides = set(READINGS)
        self.user.create_timer(0.05, self._send)

    def _send(self):
        tilt = Vector3Stamped()
        tilt.header.stamp, tilt.vector.y = self.user.get_clock().now().to_msg(), 0.5
        self.tilt.publish(tilt)
        for side in self.sides:
            message = JointState(name=names(side), position=READINGS[side], velocity=(0.0,) * 4, effort=EFFORT)
            message.header.stamp = tilt.header.stamp
            self.sent[side].publish(message)
            values = [KeyValue(key="state", value="inactive")]
            status = DiagnosticStatus(name=f"{side}/can_bridge", message="inactive", values=values)
            self.reports.publish(DiagnosticArray(status=[status]))

    def _on_markers(self, message):
        self.markers = {(marker.ns, marker.id): marker for marker in message.markers}


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    viewer = Viewer()
    yield viewer
    viewer.close()


def test_a_viewer_gets_the_description_the_joint_states_of_both_arms_and_markers_until_an_arm_falls_silent(
    viewer, tmp_path
):
    sorted_by_arm = tmp_path / "sorted.yaml"
    sorted_by_arm.write_text(yaml.safe_dump(yaml.safe_load(BOTH.read_text("utf-8"))))
    described = urdf_of(sorted_by_arm)
    viewer.wait_until(lambda: viewer.description.data == described and len(viewer.states.name) == 8)
    position = dict(zip(viewer.states.name, viewer.states.position, strict=True))
    effort = dict(zip(viewer.states.name, viewer.states.effort, strict=True))
    for side, theta in READINGS.items():
        assert [position[name] for name in names(side)] == list(theta)
        assert [effort[name] for name in names(side)] == list(EFFORT)
    groups = {"gravity"} | {f"{side}/{kind}" for side in READINGS for kind in ("limits", "torques", "states")}
    shown: list[dict[tuple[str, int], Marker]] = []

    def is_complete():
        shown.append(viewer.markers)
        texts = {marker.text for marker in shown[-1].values() if marker.type == Marker.TEXT_VIEW_FACING}
        is_tilted = ("gravity", 0) in shown[-1] and shown[-1]["gravity", 0].points  # a fresh tilt has arrived
        wanted = {"1.50 Nm", "right: inactive", "left: inactive"}
        return is_tilted and {group for group, _ in shown[-1]} == groups and wanted <= texts

    viewer.wait_until(is_complete)
    assert {marker.header.frame_id for marker in shown[-1].values()} == {ROOT}
    arrow = shown[-1]["gravity", 0]
    forward, down = (getattr(arrow.points[1], axis) - getattr(arrow.points[0], axis) for axis in "xz")
    assert forward > 0 > down and forward / -down == pytest.approx(0.5463, abs=1e-3)  # tan of the pitch
    viewer.sides = {"right"}
    viewer.wait_until(lambda: list(viewer.states.name) == names("right"))
    viewer.wait_until(lambda: not any(group.startswith("left") for group, _ in viewer.markers))
    viewer.wait_until(lambda: viewer.statuses["robot_model"].message == "no messages on /left/joint_states")
    arm = viewer.model._arms["/right"]
    arm.describe({**arm._parameters[0], "link_length": [-1.0] * 4}, arm._parameters[1])  # by a restart
    assert arm.view({}) is None and "length" in arm.problem  # the last description is no longer shown


# The layouts of RViz, PlotJuggler and Foxglove, and the launch file: what they name exists. The viewers have no wheels

SHOWN = re.compile(
    r"/robot_description|/joint_states|/robot_model/markers|/diagnostics|/imu/pitch_yaw([./]vector[./][xy])?"
    rf"|/(?P<side>left|right)/joint_states(\.(position|velocity|effort)\[[0-3]\]"
    rf"|/(?P=side)_({'|'.join(PARTS)})/(position|velocity|effort))?"
)


@pytest.mark.parametrize("layout", ["rviz/exo.rviz", "plotjuggler/exo.xml", "foxglove/exo.json"])
def test_a_layout_names_topics_fields_and_frames_that_exist(layout):
    text = (CONFIG / layout).read_text(encoding="utf-8")
    found = re.findall(r"[\s\";](/[a-z][\w/.\[\]]*)", text)
    assert found and not [name for name in found if not SHOWN.fullmatch(name)]
    assert {*re.findall(r"(?:Fixed Frame: |\"followTf\": \")(\w+)", text)} <= {ROOT}
