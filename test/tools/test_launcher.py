# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""launcher: which nodes of a parameter file start, with what, and in which order they stop.

test_exit_codes.py shows what it refuses; test/nodes starts real nodes.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from unittest.mock import Mock

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.inputs.parameter_file import load, stages
from exo_gravity.lab.processes import DELAY, Launcher, chosen, command_of, node_modules, stop_on_signals, wearers
from exo_gravity.tools import launcher

from ..support import CONFIG, ROOT


def test_a_closed_terminal_stops_the_launcher_as_ctrl_c_does():
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.getsignal(number) for number in numbers]
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        stopping = stop_on_signals()
        signal.raise_signal(signal.SIGHUP)
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)
    assert stopping.wait(10.0)


def test_the_node_names_are_the_modules_with_an_entry_point_and_help_lists_them(run_tool):
    folder = ROOT / "exo_gravity" / "nodes"
    modules = {
        path.parent.name if path.stem == "node" else path.stem
        for path in (*folder.glob("*.py"), *folder.glob("*/node.py"))
        if "\ndef main(" in path.read_text(encoding="utf-8")
    }
    # The launcher runs pose_prompt on its own terminal: it is no node.
    assert {*node_modules(), "pose_prompt"} == modules >= {"can_bridge", "imu", "compensator", "simulator", "recorder"}
    code, out, _ = run_tool("launcher", "--help")
    assert code == 0 and "/right/can_bridge" in out and ", ".join(node_modules()) in " ".join(out.split())


def test_a_node_is_run_from_this_package_whatever_lies_in_the_folders(tmp_path, monkeypatch):
    for theirs in ("can_bridge", "can.py", "yaml.py"):  # python-can installs a can_bridge of its own
        (tmp_path / theirs).write_text(f"#!{sys.executable}\nraise SystemExit('another program')\n")
        (tmp_path / theirs).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    command = [*command_of("/right/can_bridge"), "--ros-args", "-r", "__ns:=/right"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 2 and "can.interface" in ended.stderr, ended.stderr


@pytest.fixture
def launched(monkeypatch, run_tool):
    """A function that launches the simulated arm with `words`; it returns the commands by node, and what is printed.

    log: the lines of the bridge's process.
    """

    def launched(*words: str, log: Sequence[str] = ()) -> tuple[dict[str, list[str]], list[str]]:
        commands: dict[str, list[str]] = {}

        def start(command: list[str], env: dict[str, str], **_: object) -> Mock:
            node = command[command.index("--enclave") + 1]
            commands[node] = command
            assert (node.endswith("/wearer")) == (DELAY.items() <= env.items())  # no arm waits for it
            ends = {"poll.return_value": None, "wait.return_value": 0}
            process = Mock(stdout=log if node.endswith("/can_bridge") else (), **ends)
            process.terminate.side_effect = lambda: process.poll.configure_mock(return_value=0)
            return process

        ended = threading.Event()
        ended.set()
        monkeypatch.setattr(launcher, "stop_on_signals", lambda: ended)
        monkeypatch.setattr(subprocess, "Popen", start)
        printed = run_tool("launcher", "--params", CONFIG / "sim.yaml", *words).out
        return commands, [" ".join(line.split()[1:]) for line in printed.splitlines()]

    return launched


def test_a_part_of_the_nodes_is_started_and_a_namespace_remappings_and_a_log_level_reach_every_one(launched):
    assert list(launched("--only", "*/can_bridge", "*/w*")[0]) == ["/right/can_bridge", "/right/wearer"]
    remap = "assist_efforts:=mine"
    commands, _ = launched("--namespace", "lab/", "--log-level", "warn", "--remap", remap)
    words = commands["/lab/right/compensator"]
    assert {"__ns:=/lab/right", "/imu/data:=/lab/imu/data", "/lab/right/compensator", remap, "warn"} <= set(words)


def test_in_one_process_the_bridge_has_the_command_of_both_and_its_log_has_both_names(launched):
    log = ("lab.right.compensator INFO compensating\n", "lab.right.can_bridge WARN late\n", "ERROR of a watchdog\n")
    one_process = ("--namespace", "lab", "--one-process")
    commands, lines = launched(*one_process, log=log)
    assert list(commands) == ["/lab/imu", "/lab/right/can_bridge", "/lab/right/simulator", "/lab/right/wearer"]
    words = commands["/lab/right/can_bridge"]
    first, second = words[: words.index("--")], words[words.index("--") + 1 :]
    assert {"__node:=can_bridge", "/lab/right/can_bridge"} <= set(first) and "can_bridge.one_process" in first[2]
    assert {"--ros-args", "__node:=compensator", "__ns:=/lab/right", "/lab/right/compensator"} <= set(second)
    assert [line for line in lines if not line.startswith("launcher ")] == [
        "right/compensator INFO compensating",
        "right/can_bridge WARN late",
        "right/can_bridge ERROR of a watchdog",
    ]
    alone, _ = launched(*one_process, "--only", "*/can_bridge", "/imu")
    assert list(alone) == ["/lab/imu", "/lab/right/can_bridge"] and "--" not in alone["/lab/right/can_bridge"]


@pytest.mark.parametrize(
    ("file", "code", "runs"), [("sim.yaml", -9, 4), ("sim.yaml", 2, 1), ("exo.yaml", -9, 1)], ids=str
)
def test_a_simulation_that_dies_starts_again_three_times_and_a_real_arm_never(monkeypatch, run_tool, file, code, runs):
    ran: list[None] = []
    died = "/right/can_bridge", code
    monkeypatch.setattr(Launcher, "run", lambda self, _stopping: ran.append(self.stop()) or died)
    monkeypatch.setattr(launcher, "check_start", lambda nodes: None)  # another process may hold the bus
    ended = run_tool("launcher", "--params", CONFIG / file)
    assert ended.code == 1 and len(ran) == runs
    assert ended.out.count("right/can_bridge ended with exit code -9: the simulation starts again") == runs - 1


NAMES = ["/recorder", "/imu", "/left/can_bridge", "/left/compensator", "/right/can_bridge"]


WEARERS = {  # the nodes of a file, and the wearers that start with them
    "both arms": (
        {"/right/compensator": {}, "/left/compensator": {"law": "anfis"}}, ["/right/wearer", "/left/wearer"],
    ),
    "no namespace": ({"/compensator": {}, "/right/can_bridge": {}}, ["/wearer"]),
    "a key of its own": ({"/right/compensator": {}, "/right/wearer": {}}, []),
    "another arm": ({"/right/compensator": {"law": "urdf"}}, ["/right/wearer"]),
    "ros2_control": ({"/right/compensator": {"command_interface": "multi_array"}}, []),
}  # fmt: skip


@pytest.mark.parametrize(("nodes", "added"), WEARERS.values(), ids=WEARERS)
def test_a_compensator_behind_a_bridge_gets_a_wearer_unless_the_file_has_one(nodes, added):
    assert wearers(nodes) == added


def test_bridges_stop_first_and_recorders_last_and_patterns_are_compared_with_full_names():
    assert stages(NAMES) == (["/left/can_bridge", "/right/can_bridge"], ["/imu", "/left/compensator"], ["/recorder"])
    assert chosen(NAMES, ()) == NAMES
    assert chosen(NAMES, ("/left/*",)) == ["/left/can_bridge", "/left/compensator"]
    assert chosen(NAMES, ("*/can_bridge", "/imu")) == ["/imu", "/left/can_bridge", "/right/can_bridge"]
    for pattern in ("/IMU", "can_bridge"):
        with pytest.raises(ParameterError, match=r"only = .*must be a pattern that matches one of /recorder, /imu"):
            chosen(NAMES, (pattern,))


HARD = """
/right/compensator:
  ros__parameters:
    robot: {mass: [5e-1, 4e-1, 6e-1, 2e-1], cog: [.05, .1, .2, .1]}
    use_imu: off
    support_adapts: n
    anfis_file: "5e-1"
    max_effort: [3., 9., 3., 3.]
"""
READ = {
    "robot.mass": [0.5, 0.4, 0.6, 0.2], "robot.cog": [0.05, 0.1, 0.2, 0.1], "use_imu": False,
    "support_adapts": False, "anfis_file": "5e-1", "max_effort": [3.0, 9.0, 3.0, 3.0],
}  # fmt: skip


@pytest.mark.parametrize("namespace", ["", "/lab"])
def test_in_whatever_namespace_a_node_gets_what_the_tools_have_read(namespace, tmp_path):
    path = tmp_path / "hard.yaml"
    path.write_text(HARD)
    prepared = Launcher(path, print, namespace=namespace)
    assert load(prepared.params) == {f"{namespace}/right/compensator": READ, f"{namespace}/right/wearer": {}}
    prepared.stop()
    assert not prepared.params.exists()
