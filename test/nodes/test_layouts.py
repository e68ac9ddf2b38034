# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The layouts of RViz, PlotJuggler and Foxglove, and the launch file: every topic, frame and executable that they name.

The viewers themselves have no wheels. What is checked here is that each name exists, and that each layout has the form
that its program reads.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from exo_gravity.lab.inputs.arms import configured_arms
from exo_gravity.lab.processes import node_modules
from exo_gravity.lab.view.urdf import ROOT
from exo_gravity.tools.urdf import urdf_of

from ..support import CONFIG

LAUNCH = CONFIG.parent / "launch" / "view.launch.py"
ARMS = {arm.namespace: arm.joint_names for arm in configured_arms(CONFIG / "exo.yaml")}
# What robot_model publishes is checked in test_robot_model.py, the rest by the contract of the nodes.
TOPICS = {
    "/robot_description": String,
    "/joint_states": JointState,
    "/robot_model/markers": MarkerArray,
    "/imu/pitch_yaw": Vector3Stamped,
    "/diagnostics": DiagnosticArray,
    **{f"{arm}/joint_states": JointState for arm in ARMS},
}


def rviz():
    return yaml.safe_load((CONFIG / "rviz" / "exo.rviz").read_text(encoding="utf-8"))["Visualization Manager"]


def foxglove():
    return json.loads((CONFIG / "foxglove" / "exo.json").read_text(encoding="utf-8"))


def plotjuggler():
    return ElementTree.parse(CONFIG / "plotjuggler" / "exo.xml").getroot()


def frames():
    return {link.get("name") for link in ElementTree.fromstring(urdf_of(CONFIG / "exo.yaml")).iter("link")}


def panels(layout):
    """Yield the panels of a Foxglove layout, a tree of splits."""
    if isinstance(layout, str):
        yield layout
        return
    assert layout["direction"] in ("row", "column")
    for side in ("first", "second"):
        yield from panels(layout[side])


def test_rviz_shows_topics_with_the_quality_of_service_that_they_have():
    displays = {display["Class"].rpartition("/")[2]: display for display in rviz()["Displays"]}
    description, markers = displays["RobotModel"]["Description Topic"], displays["MarkerArray"]["Topic"]
    assert TOPICS[description["Value"]] is String and description["Durability Policy"] == "Transient Local"
    assert TOPICS[markers["Value"]] is MarkerArray and markers["Durability Policy"] == "Volatile"
    assert rviz()["Global Options"]["Fixed Frame"] == ROOT and ROOT in frames()


@pytest.mark.parametrize("curve", list(plotjuggler().iter("curve")), ids=lambda curve: curve.get("name"))
def test_a_curve_of_plotjuggler_is_a_number_of_a_selected_topic(curve):
    selected = plotjuggler().find(".//selected_topics").get("value").split(";")
    topic = next(topic for topic in selected if curve.get("name").startswith(f"{topic}/"))
    path = curve.get("name").removeprefix(f"{topic}/").split("/")
    if TOPICS[topic] is JointState:  # PlotJuggler names these TOPIC/JOINT/FIELD
        joint, field = path
        assert joint in ARMS[topic.removesuffix("/joint_states")]
        assert field in JointState.get_fields_and_field_types()
    else:
        assert path[0] == "vector" and hasattr(Vector3Stamped().vector, path[1])


def test_plotjugglers_plots_are_in_splitters_whose_sizes_fit():
    for splitter in plotjuggler().iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))


def test_every_path_and_topic_of_foxglove_exists():
    layout = foxglove()
    for name, panel in layout["configById"].items():
        for path in panel.get("paths", ()):
            topic, field, rest = re.fullmatch(r"(/[\w/]+)\.(\w+)(.*)", path["value"]).groups()
            assert field in TOPICS[topic].get_fields_and_field_types()
            assert rest in ("[0]", "[1]", "[2]", "[3]") if TOPICS[topic] is JointState else rest in (".x", ".y")
        assert name.split("!")[0] in ("3D", "Plot", "DiagnosticSummary")
    scene = layout["configById"]["3D!arms"]
    assert scene["followTf"] in frames()
    assert [TOPICS[topic] for topic in scene["topics"]] == [MarkerArray]
    assert TOPICS[scene["layers"]["arms"]["topic"]] is String
    assert TOPICS[scene["layers"]["arms"]["jointStatesTopic"]] is JointState
    assert TOPICS[layout["configById"]["DiagnosticSummary!nodes"]["topicToRender"]] is DiagnosticArray


def test_foxglove_places_each_panel_once():
    placed = list(panels(foxglove()["layout"]))
    assert sorted(placed) == sorted(foxglove()["configById"])


def test_the_launch_file_names_executables_and_files_that_exist():
    texts = [node.value for node in ast.walk(ast.parse(LAUNCH.read_text(encoding="utf-8"))) if is_text(node)]
    assert {"robot_model", "robot_state_publisher", "rviz2"} <= set(texts)
    assert "robot_model" in node_modules()
    for parts in (("sim.yaml",), ("rviz/exo.rviz",)):
        assert set(parts) <= set(texts) and Path(CONFIG, *parts).is_file()


def is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
