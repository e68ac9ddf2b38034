# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `robot_model` with the real compensators and bridges of both arms, and the viewers' layouts."""

from __future__ import annotations

import ast
import re

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from exo_gravity.lab.processes import node_modules
from exo_gravity.lab.view.urdf import ROOT
from exo_gravity.nodes.ros.subscriptions import LATCHED
from exo_gravity.tools.urdf import urdf_of

from ..support import CONFIG, PARTS
from ..support.launched_nodes import LaunchedNodes
from ..support.node_thread import NodeThread
from ..support.waiting import wait_until

READINGS = {"left": (0.1, 0.2, 0.3, 0.4), "right": (-0.1, 0.5, 0.6, 0.7)}
EFFORT = (0.0, 1.5, 1.2, 0.2)


def names(side):
    return [f"{side}_{part}" for part in PARTS]


def texts(markers):
    return {marker.text for marker in markers.values() if marker.type == Marker.TEXT_VIEW_FACING}


class Viewer:
    """A node that sends the joint states of both arms and the tilt, and keeps the newest of what robot_model sends."""

    def __init__(self):
        self._thread = NodeThread("viewer")
        (self.node,) = self._thread.nodes
        self.close = self._thread.close
        self.sent = {side: self.node.create_publisher(JointState, f"/{side}/joint_states", 1) for side in READINGS}
        self.tilt = self.node.create_publisher(Vector3Stamped, "/imu/pitch_yaw", 1)
        self.description, self.problem = String(), ""
        self.states = JointState()
        self.whole: JointState | None = None  # the newest with the joints of both arms
        self.markers: dict[tuple[str, int], Marker] = {}
        subscribe = self.node.create_subscription
        subscribe(String, "/robot_description", lambda message: setattr(self, "description", message), LATCHED)
        subscribe(JointState, "/joint_states", self._on_states, 1)
        subscribe(MarkerArray, "/robot_model/markers", self._on_markers, 1)
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.sides = set(READINGS)
        self.node.create_timer(0.05, self._send)
        self._thread.start()

    def _send(self):
        stamp = self.node.get_clock().now().to_msg()
        for side in tuple(self.sides):
            message = JointState(name=names(side), position=READINGS[side], velocity=(0.0,) * 4, effort=EFFORT)
            message.header.stamp = stamp
            self.sent[side].publish(message)
        tilt = Vector3Stamped()
        tilt.header.stamp, tilt.vector.y = stamp, 0.5
        self.tilt.publish(tilt)

    def _on_states(self, message):
        self.states = message
        self.whole = message if len(message.name) == 8 else self.whole

    def _on_markers(self, message):
        self.markers = {(marker.ns, marker.id): marker for marker in message.markers}

    def _on_diagnostics(self, message):
        self.problem = next((s.message for s in message.status if s.name == "robot_model"), self.problem)

    def wait_until(self, condition):
        wait_until(condition, seen=lambda: f"{self.problem!r}, joints {list(self.states.name)}")


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """Both arms without simulators; the bridges stay inactive, so that the only joint states are those of the test."""
    without, waiting = ("simulator", "imu"), {"autostart": False}
    nodes = LaunchedNodes(
        tmp_path_factory.mktemp("robot_model"), base="sim_both.yaml", without=without, can_bridge=waiting
    )
    nodes.add("/robot_model", rate=20.0)
    yield nodes.start()
    nodes.stop()
    print("\n".join(nodes.log))


@pytest.fixture
def viewer():
    viewer = Viewer()
    yield viewer
    viewer.close()


def test_a_viewer_gets_the_description_the_joint_states_of_both_arms_and_markers(nodes, viewer):
    viewer.wait_until(lambda: viewer.description.data == urdf_of(nodes.path) and viewer.whole)
    position = dict(zip(viewer.whole.name, viewer.whole.position, strict=True))
    effort = dict(zip(viewer.whole.name, viewer.whole.effort, strict=True))
    for side, theta in READINGS.items():
        assert [position[name] for name in names(side)] == list(theta)
        assert [effort[name] for name in names(side)] == list(EFFORT)
    groups = {"gravity"} | {f"{side}/{kind}" for side in READINGS for kind in ("limits", "torques", "states")}
    shown: list[dict[tuple[str, int], Marker]] = []

    def is_complete():
        shown.append(viewer.markers)
        wanted = {"1.50 Nm", "right: inactive", "left: inactive"}
        is_tilted = ("gravity", 0) in shown[-1] and shown[-1]["gravity", 0].points  # a fresh tilt has arrived
        return is_tilted and {group for group, _ in shown[-1]} == groups and wanted <= texts(shown[-1])

    viewer.wait_until(is_complete)
    assert {marker.header.frame_id for marker in shown[-1].values()} == {ROOT}
    arrow = shown[-1]["gravity", 0]
    forward, down = (getattr(arrow.points[1], axis) - getattr(arrow.points[0], axis) for axis in "xz")
    assert forward > 0 > down and forward / -down == pytest.approx(0.5463, abs=1e-3)  # tan of the pitch


def test_an_arm_that_falls_silent_disappears_and_the_other_stays(nodes, viewer):
    viewer.wait_until(lambda: len(viewer.states.name) == 8)
    viewer.sides = {"right"}
    viewer.wait_until(lambda: list(viewer.states.name) == names("right"))
    viewer.wait_until(lambda: not any(group.startswith("left") for group, _ in viewer.markers))
    viewer.wait_until(lambda: viewer.problem == "no messages on /left/joint_states")


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


def test_rviz_subscribes_with_the_quality_of_service_that_the_topics_have():
    displays = yaml.safe_load((CONFIG / "rviz" / "exo.rviz").read_text("utf-8"))["Visualization Manager"]["Displays"]
    topics = [each[key] for each in displays for key in each if key in ("Description Topic", "Topic")]
    assert {topic["Value"]: topic["Durability Policy"] for topic in topics} == {
        "/robot_description": "Transient Local",
        "/robot_model/markers": "Volatile",
    }


def test_the_launch_file_names_executables_and_files_that_exist():
    tree = ast.parse((CONFIG.parent / "launch" / "view.launch.py").read_text(encoding="utf-8"))
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert {"robot_model", "robot_state_publisher", "rviz2", "sim.yaml", "rviz/exo.rviz"} <= texts
    assert "robot_model" in node_modules() and (CONFIG / "rviz/exo.rviz").is_file()
