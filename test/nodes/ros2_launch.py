# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The launch file under `ros2 launch`, and the documents' commands of `ros2`, where ROS 2 is installed.

Run them by their path; PyPI carries no `launch`. Judged by the simulated arm's true motion: the arm is let down
before the simulator, and with it the motors, ends.
"""

import os
import re
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ..support import ROOT
from ..support.document_commands import ROS2
from ..support.launched_nodes import CALM, LaunchedNodes, children
from ..support.ros_probe import RosProbe
from ..support.truth import Truth
from ..support.waiting import wait_until

ANSWER_TIMEOUT = 60.0  # s for a command's output
STOP_TIMEOUT = 60.0  # s
LARGEST_SPEED = 1.0  # rad/s of an arm that is let down


class Launched:
    """`ros2 launch` on the simulated right arm. log: its lines so far."""

    def __init__(self, nodes: LaunchedNodes, *arguments: str, file: Path | None = None) -> None:
        self.truth = Truth(nodes.truth_path())
        self.log: list[str] = []
        command = [
            "ros2",
            "launch",
            *([file] if file else ("exo_gravity", "exo.launch.py")),
            f"params:={nodes.path}",
            *arguments,
        ]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self.log.append(line.rstrip())

    def ctrl_c(self) -> None:
        """Send SIGINT to every process, as a terminal does."""
        os.killpg(self.process.pid, signal.SIGINT)

    def wait(self) -> int:
        code = self.process.wait(STOP_TIMEOUT)
        self._reader.join(STOP_TIMEOUT)
        return int(code)

    def was_let_down(self) -> bool:
        """Return whether the motors went off, and the arm was never fast."""
        return self.truth.motors_are_off() and float(abs(self.truth.since(0.0)["velocity"]).max()) < LARGEST_SPEED


@pytest.fixture
def launched(prepare: Callable[..., LaunchedNodes], probe: RosProbe) -> Iterator[Launched]:
    nodes = prepare(truth=True)
    launched = Launched(nodes)
    try:
        probe.get_carried()
        yield launched
    finally:
        if launched.process.poll() is None:
            launched.ctrl_c()
            launched.wait()
        nodes.stop()
        print("\n".join(launched.log))  # pytest shows it if the test failed


ENDS = {  # what happens, and the exit code of `ros2 launch` if it does not die by that
    "Ctrl-C": (Launched.ctrl_c, 0),
    "launch alone is interrupted": (lambda launched: os.kill(launched.process.pid, signal.SIGINT), 0),
    "launch is killed": (lambda launched: os.kill(launched.process.pid, signal.SIGKILL), None),
    "its terminal is closed": (lambda launched: os.killpg(launched.process.pid, signal.SIGHUP), None),
}


@pytest.mark.parametrize("end", ENDS)
def test_however_it_ends_the_arm_is_let_down_before_the_other_nodes_stop(launched, end):
    happens, expected = ENDS[end]
    happens(launched)
    code = launched.wait()
    wait_until(launched.truth.motors_are_off, timeout=STOP_TIMEOUT)
    assert launched.was_let_down() and expected in (None, code)


def test_a_node_that_dies_ends_it_with_an_error(launched):
    (launcher,) = children(launched.process.pid)
    name = b"/right/compensator"
    nodes = [pid for pid in children(launcher) if name in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")]
    os.kill(*nodes, signal.SIGKILL)
    assert launched.wait() == 1 and launched.was_let_down()
    assert any("right/compensator ended with exit code -9; all nodes were stopped" in line for line in launched.log)


@contextmanager
def in_lab(nodes: LaunchedNodes, *arguments: str, **options: Path) -> Iterator[tuple[RosProbe, set[str]]]:
    """Launch an arm in the namespace /lab; once it is carried, yield a probe and the names of all topics."""
    probe, launched = RosProbe("/lab/right"), Launched(nodes, *arguments, **options)
    try:
        probe.get_carried()
        yield probe, {name for name, _ in probe.node.get_topic_names_and_types()}
    finally:
        launched.ctrl_c()
        assert launched.wait() == 0
        probe.close()


def test_a_namespace_is_in_front_of_every_node_and_of_the_imus_topics(prepare):
    with in_lab(prepare(), "namespace:=lab", "log_level:=warn") as (_, topics):
        assert "/lab/imu/data" in topics and "/imu/data" not in topics


INCLUDING = """
from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import PushRosNamespace, SetRemap

def generate_launch_description():
    source = PythonLaunchDescriptionSource({path!r})
    included = IncludeLaunchDescription(source, launch_arguments={{"params": LaunchConfiguration("params")}}.items())
    return LaunchDescription([
        GroupAction([PushRosNamespace("lab"), SetRemap("assist_efforts", "my_controller/efforts"), included])
    ])
"""


def test_a_file_that_includes_this_one_pushes_its_namespace_and_its_remappings(prepare, tmp_path):
    file = tmp_path / "mine.launch.py"
    file.write_text(INCLUDING.format(path=str(ROOT / "launch" / "exo.launch.py")))
    with in_lab(prepare(compensator={"assist.max_effort": [1.0] * 4}), file=file) as (probe, topics):
        assert {"/lab/imu/data", "/lab/right/my_controller/efforts"} <= topics and "/imu/data" not in topics
        assert probe.diagnostic("compensator", "mass carried (kg)") == "1.854"  # of the file, and not the defaults'


def test_the_panel_starts_alone_by_arguments(prepare):
    launched = Launched(prepare(), "panel:=true", "only:=/panel")
    is_open = lambda: any("the panel is at http://" in line for line in launched.log)  # noqa: E731
    wait_until(is_open, timeout=ANSWER_TIMEOUT, seen=lambda: launched.log)
    launched.ctrl_c()
    assert launched.wait() == 0
    assert not any("right/" in line for line in launched.log)


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosProbe]:
    """A probe, and a simulated arm whose bridge is not yet configured: the commands of `ros2` run on it in order."""
    nodes = LaunchedNodes(tmp_path_factory.mktemp("commands"), timing=CALM, can_bridge={"autostart": False})
    launched, probe = Launched(nodes), RosProbe()
    probe.wait_until(lambda: probe.status_contains("can_bridge", "inactive"))
    # By the daemon that the first command starts.
    wait_until(lambda: "/right/can_bridge" in typed("ros2 node list", ""), timeout=ANSWER_TIMEOUT)
    yield probe
    launched.ctrl_c()
    launched.wait()
    nodes.stop()
    probe.close()
    print("\n".join(launched.log))  # pytest shows it if a test failed


def typed(command: str, expected: str) -> str:
    """Return what a command of a document prints: all of it, or until it shows `expected`, if it does not end."""
    process = subprocess.Popen(
        ["bash", "-c", f"SHARE=$(ros2 pkg prefix --share exo_gravity); {command}"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    timer = threading.Timer(ANSWER_TIMEOUT, os.killpg, (process.pid, signal.SIGKILL))
    timer.start()
    text = ""
    for line in process.stdout:
        text += line
        if (" echo " in command or " pub " in command) and re.search(expected, text):
            os.killpg(process.pid, signal.SIGINT)
            break
    process.stdout.close()
    process.wait()
    timer.cancel()
    return text


# What the state of the arm must be before a command, if it does not answer in each.
BEFORE = {"data: false": "active", "data: true": "disabled", "90.0, 30.0": "active", "clear_fault": "fault"}


@pytest.mark.parametrize(("command", "expected"), ROS2.items())
def test_a_command_of_the_documents_answers(standing, command, expected):
    for part, state in BEFORE.items():
        if part in command and state == "active":
            standing.get_carried()
        elif part in command:
            standing.wait_until(lambda state=state: standing.state in (state, "fault"))
            assert standing.state == state or standing.trigger("clear_fault").success  # of a busy computer
    said = typed(command, expected)
    assert re.search(expected, said), said
