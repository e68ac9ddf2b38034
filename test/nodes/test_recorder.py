# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The node `recorder` as a process, over real DDS: every published message is in the recording."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import serialize_message
from rclpy.time import Time
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64, String

from exo_gravity import version
from exo_gravity.lab.bag.content import Session
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.nodes.recorder.node import LiveLine
from exo_gravity.nodes.ros.messages import to_nanoseconds
from exo_gravity.nodes.ros.subscriptions import LATCHED

from ..support.node_thread import own_node
from ..support.waiting import PATIENCE, pause, wait_until

# silence in s: a busy machine sends late. grip_force: as CONTRIBUTING's "Add a topic" says.
PROGRAM = """
from dataclasses import replace
from std_msgs.msg import Float64
from exo_gravity.nodes.recorder import node
node.TIMING = replace(node.TIMING, silence=3.0)
node.TYPES["grip_force"] = Float64
node.main()
"""
# The IMU is renamed, as by `launcher --namespace lab`.
NODE = [sys.executable, "-c", PROGRAM, "--ros-args", "-r", "/imu/data_raw:=/lab/imu/data_raw"]
NAMES = ["j1", "j2", "j3", "j4"]
COUNT = 300
STEP = 1e-4  # rad by which each message's angles are larger than those of the one before
FIELDS = (("/right/joint_states", "position", STEP), ("/right/effort_commands", "effort", 1.0))
MESSAGES = {
    **dict.fromkeys(("joint_states", "effort_commands", "assist_efforts"), (JointState, 1)),
    "/lab/imu/data_raw": (Imu, qos_profile_sensor_data),
    "/diagnostics": (DiagnosticArray, 10),
    "wearer_step": (String, LATCHED),
    "/event_marker": (String, 10),
    "chatter": (String, 10),
    "grip_force": (Float64, 1),
}


def start(output, *arguments, **options):
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen([*NODE, "-p", f"output:={output}", *arguments], **pipes, text=True, **options)


class PublishingArm:
    """A node in this process that publishes like a bridge and a compensator, by topic."""

    def __init__(self, node, executor):
        self.node, self.executor = node, executor
        node.declare_parameter("robot.mass", [0.5, 0.6, 0.7, 0.8])
        node.declare_parameter("support", 0.0)
        self.topics = {topic: node.create_publisher(kind, topic, qos) for topic, (kind, qos) in MESSAGES.items()}

    def wait_until_recorded(self):
        """Spin until every topic that is to be recorded has a subscriber."""
        asked = [each for topic, each in self.topics.items() if topic != "chatter"]
        spin = partial(self.executor.spin_once, timeout_sec=0.01)
        wait_until(lambda: all(each.get_subscription_count() for each in asked), spin)

    def send(self, topic, message):
        self.topics[topic].publish(message)

    def publish(self, k):
        state = JointState(name=NAMES, position=[STEP * k] * 4, velocity=[0.0] * 4, effort=[1.0] * 4)
        effort, image = JointState(name=NAMES, effort=[float(k)] * 4), Imu()
        for message in (state, effort, image):
            message.header.stamp = Time(nanoseconds=time.time_ns()).to_msg()
        for topic, message in zip(MESSAGES, (state, effort, effort, image), strict=False):
            self.send(topic, message)
        self.executor.spin_once(timeout_sec=0.002)


@pytest.fixture
def arm():
    with own_node("bridge") as own:
        yield PublishingArm(*own)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A complete recording: its folder, the lines of JSON, the exit code, and the type hash that DDS announces."""
    path = tmp_path_factory.mktemp("recorder") / "bag"
    with own_node("bridge") as own:
        arm = PublishingArm(*own)
        arm.send("wearer_step", String(data=json.dumps({"step": 0, "action": "hold", "duration": 9.0})))
        of_whom = ("-p", "subject:=P01", "-p", "protocol:=pilot", "-p", "note:='second: visit'")
        process = start(path, "-p", "live:=true", *of_whom)
        arm.wait_until_recorded()
        known = arm.node.get_publishers_info_by_topic("/right/joint_states")[0]
        for k in range(COUNT):
            arm.publish(k)
        arm.send("/event_marker", String(data="cramp"))
        arm.send("grip_force", Float64(data=12.5))
        silent = {"name": "right/bridge", "message": "motor 2 is silent"}
        arm.send("/diagnostics", DiagnosticArray(status=[DiagnosticStatus(level=DiagnosticStatus.ERROR, **silent)]))
        arm.node.set_parameters([Parameter("support", value=0.5)])
        lines = []
        while not lines or (lines[-1] and "motor 2 is silent" not in lines[-1]):
            lines.append(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
    return path, lines, process.returncode, known.topic_type_hash


def recorded(path, topic):
    with AnyReader([path]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic == topic]
        return [(stamp, reader.deserialize(data, c.msgtype)) for c, stamp, data in reader.messages(chosen)]


@pytest.mark.parametrize(("topic", "field", "step"), [*FIELDS, ("/right/assist_efforts", "effort", 1.0)])
def test_every_message_of_an_arm_is_recorded_with_its_time_of_arrival(session, topic, field, step):
    path, _, code, _ = session
    assert code == 0 and (path / "metadata.yaml").exists()  # closed by Ctrl-C
    messages = recorded(path, topic)
    assert [round(getattr(message, field)[0] / step) for _, message in messages] == list(range(COUNT))
    for stamp, message in messages:
        assert 0 < stamp - to_nanoseconds(message.header.stamp) < PATIENCE * 10**9


def test_topics_are_recorded_as_they_are_published_and_others_are_not(session):
    with AnyReader([session[0]]) as reader:
        (imu,) = (c for c in reader.connections if c.topic == "/imu/data_raw")
        assert "/right/chatter" not in reader.topics
    assert [grip.data for _, grip in recorded(session[0], "/right/grip_force")] == [12.5]
    assert imu.ext.offered_qos_profiles[0].reliability.name == "BEST_EFFORT" and imu.msgcount > 0
    ((_, latched),) = recorded(session[0], "/right/wearer_step")  # from before the recorder started
    assert json.loads(latched.data)["action"] == "hold"
    metadata = yaml.safe_load((session[0] / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = [entry["topic_metadata"] for entry in metadata["topics_with_message_count"]]
    (states,) = (topic for topic in topics if topic["name"] == "/right/joint_states")
    assert states["type_description_hash"] == str(session[3])  # which its publisher announces


def test_parameters_their_changes_session_and_markers_are_recorded_and_shown_live(session):
    bag = read_bag(session[0])
    parameters = yaml.safe_load(bag.parameters["/right/bridge"])["/right/bridge"]["ros__parameters"]
    assert parameters["robot.mass"] == [0.5, 0.6, 0.7, 0.8] and parameters["support"] == 0.0
    assert "/right/bridge: support = 0.5" in [event.text for event in bag.events]
    assert bag.session == Session("P01", "pilot", "second: visit", version())
    assert [marker.text for marker in bag.markers] == ["cramp"]
    assert 0.0 < bag.markers[0].time <= bag.recordings[0].time[-1] + 1.0
    line = json.loads(session[1][-1])
    assert line["right"]["names"] == NAMES and line["right"]["position"] == [STEP * (COUNT - 1)] * 4
    assert line["right"]["effort"] == [1.0] * 4 and line["right"]["step"]["action"] == "hold"
    assert line["faults"] == ["right/bridge: motor 2 is silent"]


def test_a_wrong_parameter_ends_the_recorder_with_2_and_is_named(tmp_path):
    process = start("bag", "-p", "subject:='Anna Meier'", cwd=tmp_path)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2 and "must be a code" in errors and not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_a_full_disk_ends_the_recorder_with_the_reason_and_keeps_what_fits(arm, tmp_path):
    small = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (200_000, 200_000))  # chunks of up to 60,000
    # A compiled module that is cut would keep every later process of this environment from starting.
    process = start(tmp_path / "bag", preexec_fn=small, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"})
    arm.wait_until_recorded()
    wait_until(process.poll, lambda: arm.publish(1) or pause())  # slowly enough for several chunks
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1 and "recording ended after" in errors and "File too large" in errors
    assert len(read_bag(tmp_path / "bag").recordings[0].time) > 20  # all but what was in the last chunk


@pytest.mark.thorough
def test_a_recorder_whose_launcher_died_records_until_the_arm_is_down(arm, tmp_path):
    process = start(tmp_path / "bag", env=dict(os.environ, EXO_GRAVITY_SUPERVISED="1"))
    arm.wait_until_recorded()
    k = 0
    for duration in (0.3, 1.0):
        end, before = time.monotonic() + duration, k
        while time.monotonic() < end:  # the bridge lets the arm down
            arm.publish(k := k + 1)
        process.stdin.close()  # the launcher has died
    assert process.poll() is None
    assert process.wait(PATIENCE) == 0
    assert before < round(recorded(tmp_path / "bag", "/right/joint_states")[-1][1].position[0] / STEP) <= k
    assert (tmp_path / "bag" / "metadata.yaml").exists()


def test_the_live_line_has_no_step_that_is_no_json_and_no_status_of_a_node_that_has_died(capsys, monkeypatch):
    live = LiveLine()
    with monkeypatch.context() as before:
        before.setattr(time, "monotonic", lambda: -3.1)
        live.note(
            "/diagnostics", serialize_message(DiagnosticArray(status=[DiagnosticStatus(name="right/can_bridge")]))
        )
    live.note("/right/wearer_step", serialize_message(String(data="no JSON")))
    live.note("/right/joint_states", serialize_message(JointState(name=NAMES, position=[1.0] * 4)))
    live.write()
    line = json.loads(capsys.readouterr().out)
    assert line["right"]["position"] == [1.0] * 4 and "step" not in line["right"] and not line["status"]
