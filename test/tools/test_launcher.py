# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""launcher: which keys of a parameter file it accepts, which nodes start, and in which order they stop.

test/nodes starts real nodes.
"""

import importlib
import io
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.ownership import bus_lock
from exo_gravity.lab import packages
from exo_gravity.lab.anfis_file import text_of
from exo_gravity.lab.inputs.node_checks import check_nodes
from exo_gravity.lab.inputs.parameter_file import load, stages
from exo_gravity.lab.processes import WAIT, Launcher, chosen, command_of, node_modules, stop_on_signals, wearers
from exo_gravity.tools import launcher
from exo_gravity.tools.cli import print_any_character
from exo_gravity.tools.launcher import main

from ..core.test_anfis import law

NODES = Path(__file__).parents[2] / "exo_gravity" / "nodes"
SIM = Path(__file__).parents[2] / "config" / "sim.yaml"


@pytest.fixture
def refused(tmp_path, capsys):
    """Launch the packaged simulated arm with `changes` {node: {parameter: value}}; return the error."""

    def refused(changes):
        content = yaml.safe_load(SIM.read_text())
        for node, values in changes.items():
            content.setdefault(node, {"ros__parameters": {}})["ros__parameters"].update(values)
        path = tmp_path / "params.yaml"
        path.write_text(yaml.safe_dump(content))
        with pytest.raises(SystemExit) as ended:
            main(["--params", str(path)])
        assert ended.value.code == 2
        return capsys.readouterr().err

    return refused


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


def test_the_node_names_are_the_modules_with_an_entry_point():
    files = [*NODES.glob("*.py"), *NODES.glob("*/node.py")]
    with_main = [path for path in files if "\ndef main(" in path.read_text(encoding="utf-8")]
    modules = {path.parent.name if path.stem == "node" else path.stem for path in with_main}
    assert set(node_modules()) == modules >= {"can_bridge", "imu", "compensator", "simulator", "recorder"}


def test_help_lists_the_nodes_and_shows_a_key(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert ended.value.code == 0 and "/right/can_bridge" in text and ", ".join(node_modules()) in text


@pytest.mark.parametrize("key", ["/right/can_brigde", "/right/budget"], ids=["misspelt", "a tool"])
def test_a_key_that_is_not_a_node_is_refused_with_the_list_of_nodes(refused, key):
    error = refused({key: {}})
    assert error.startswith(f"launcher: node name = '{key}'") and ", ".join(node_modules()) in error


BRIDGE = yaml.safe_load(SIM.read_text())["/right/can_bridge"]["ros__parameters"]
BITRATES = {**BRIDGE["can"], "options": {**BRIDGE["can"]["options"], "bitrate": [500_000, 1_000_000]}}
CONTRADICTIONS = {  # changes, how the error begins, and what must be
    "two bridges on one bus": (
        {"/left/can_bridge": {"can": BRIDGE["can"], "can_id": [9, 8, 7, 5]}},
        "/right/can_bridge can = {'can.channel': '239.74.163.2'",
        "must be different from the bus of /left/can_bridge: one arm per bus",
    ),
    "two orders of joints": (
        {"/right/can_bridge": {"joint_names": BRIDGE["joint_names"][::-1]}},
        "/right/can_bridge joint_names",
        "those of /right/compensator",
    ),
    "an option that not every motor has": (
        {"/right/can_bridge": {"can": BITRATES}},
        "/right/can_bridge can.options.bitrate = [500000, 1000000]",
        "must be one value",
    ),
    "a list that ROS reads for minutes": (
        {"/right/compensator": {"gain": [1.0] * 50_000}},
        "/right/compensator gain = [1.0, 1.0",
        "at most 100 entries; it has 50,000",
    ),
}


@pytest.mark.parametrize(("changes", "named", "sentence"), CONTRADICTIONS.values(), ids=CONTRADICTIONS)
def test_what_no_node_could_run_with_is_refused_by_name(refused, changes, named, sentence):
    error = refused(changes)
    assert error.startswith(f"launcher: {named}") and sentence in error


SLOW = {"interface": "virtual", "channel": "slow", "options": {"bitrate": 250_000}}
WRONG = {  # a node, its changes, and what it would say itself
    "a mass": ("/right/compensator", {"robot": {"mass": [585.0] * 4}}, "robot.mass = [585.0"),
    "a rate": ("/right/can_bridge", {"rate": 20.0}, "rate = 20.0: must be at least"),
    "a slow bus": ("/right/can_bridge", {"rate": 400.0, "can": SLOW}, "Hz, the capacity of the CAN bus"),
    "a torque": ("/right/can_bridge", {"max_effort": [18.0] * 4}, "at most the motors' peak torque"),
    "a mounting": ("/imu", {"rotation_trunk_from_imu": [0.0] * 4}, "must be a unit quaternion"),
    "a model": ("/right/compensator", {"law": "anfis", "anfis_file": "none.json"}, "anfis_file = 'none.json'"),
    "a URDF": ("/arm/compensator", {"law": "urdf", "urdf": {"file": "none.urdf"}}, "urdf.file = 'none.urdf'"),
}


@pytest.mark.parametrize(("node", "changes", "said"), WRONG.values(), ids=WRONG)
def test_a_parameter_that_a_node_would_refuse_is_refused_before_any_starts(refused, node, changes, said):
    error = refused({node: changes})
    assert error.startswith(f"launcher: {node} ") and said in error


def test_a_model_in_the_home_folder_is_found_as_the_node_finds_it(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "model.json").write_text(text_of(law()))
    nodes = load(SIM)
    nodes["/right/compensator"] |= {"law": "anfis", "anfis_file": "~/model.json"}
    check_nodes(nodes)


def test_an_arm_that_a_running_bridge_may_carry_is_refused_before_any_node_starts(refused, tmp_path, monkeypatch):
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))
    channel = f"vcan{os.getpid()}"
    lock = bus_lock.BusLock(("virtual", channel, {}), "/right/can_bridge (PID 7)")
    error = refused({"/right/can_bridge": {"can": {"interface": "virtual", "channel": channel}}})
    assert error.startswith(f"launcher: /right/can_bridge: CAN bus {channel} is held by /right/can_bridge (PID 7)")
    lock.release()


def test_a_node_is_run_from_this_package_whatever_lies_in_the_folders(tmp_path, monkeypatch):
    for theirs in ("can_bridge", "can.py", "yaml.py"):  # python-can installs a can_bridge of its own
        (tmp_path / theirs).write_text(f"#!{sys.executable}\nraise SystemExit('another program')\n")
        (tmp_path / theirs).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    command = [*command_of("/right/can_bridge"), "--ros-args", "-r", "__ns:=/right"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 2 and "can.interface" in ended.stderr, ended.stderr


class Process:
    """A node's process that has printed `log`, and ends when it is terminated."""

    def __init__(self, log: Sequence[str]) -> None:
        self.stdin, self.stdout, self._code = io.StringIO(), log, None

    def poll(self) -> int | None:
        return self._code

    def wait(self, timeout: float) -> int | None:
        return self._code

    def terminate(self) -> None:
        self._code = 0


@pytest.fixture
def launched(monkeypatch, capsys):
    """A function that launches the simulated arm with `words`; it returns the commands by node, and what is printed.

    log: the lines of the bridge's process.
    """

    def launched(*words: str, log: Sequence[str] = ()) -> tuple[dict[str, list[str]], list[str]]:
        commands: dict[str, list[str]] = {}

        def start(command: list[str], **_: object) -> Process:
            node = command[command.index("--enclave") + 1]
            commands[node] = command
            return Process(log if node.endswith("/can_bridge") else ())

        ended = threading.Event()
        ended.set()
        monkeypatch.setattr(launcher, "stop_on_signals", lambda: ended)
        monkeypatch.setattr(subprocess, "Popen", start)
        main(["--params", str(SIM), *words])
        return commands, [line.partition(" ")[2] for line in capsys.readouterr().out.splitlines()]

    return launched


def test_only_a_part_of_the_nodes_is_started(launched):
    assert list(launched("--only", "*/can_bridge", "/imu")[0]) == ["/imu", "/right/can_bridge"]
    assert list(launched("--only", "*/compensator", "*/w*")[0]) == ["/right/compensator", "/right/wearer"]


def test_in_one_process_the_bridge_has_the_command_of_both_and_its_log_has_both_names(launched):
    log = ("lab.right.compensator INFO compensating\n", "lab.right.can_bridge WARN late\n", "ERROR of a watchdog\n")
    one_process = ("--namespace", "lab", "--one-process")
    commands, lines = launched(*one_process, log=log)
    assert list(commands) == ["/lab/imu", "/lab/right/can_bridge", "/lab/right/simulator", "/lab/right/wearer"]
    words = commands["/lab/right/can_bridge"]
    first, second = words[: words.index("--")], words[words.index("--") + 1 :]
    assert {"__node:=can_bridge", "/lab/right/can_bridge"} <= set(first) and "can_bridge.one_process" in first[2]
    assert {"--ros-args", "__node:=compensator", "__ns:=/lab/right", "/lab/right/compensator"} <= set(second)
    of_nodes = [line for line in lines if not line.startswith("launcher ")]
    assert [" ".join(line.split()) for line in of_nodes] == [
        "right/compensator INFO compensating",
        "right/can_bridge WARN late",
        "right/can_bridge ERROR of a watchdog",
    ]
    alone, _ = launched(*one_process, "--only", "*/can_bridge", "/imu")
    assert list(alone) == ["/lab/imu", "/lab/right/can_bridge"] and "--" not in alone["/lab/right/can_bridge"]


@pytest.mark.parametrize("silent", ["", "/right/simulator"], ids=["all have started", "one is silent"])
def test_a_wearer_is_told_to_start_once_all_that_an_arm_waits_for_have_started(monkeypatch, silent):
    processes: dict[str, Process] = {}

    def start(command: list[str], **_: object) -> Process:
        node = command[command.index("--enclave") + 1]
        processes[node] = Process(() if node in (silent, "/right/wearer") else ("INFO started\n", "INFO running\n"))
        return processes[node]

    monkeypatch.setattr(subprocess, "Popen", start)
    launcher = Launcher(SIM, lambda node, line: None)
    launcher.start()
    launcher.stop()  # after the last line of each log
    assert {node for node, process in processes.items() if process.stdin.getvalue()} == (
        set() if silent else {"/right/wearer"}
    )


def test_a_process_that_waits_for_the_others_begins_at_a_line_and_when_its_launcher_has_died():
    program = [sys.executable, "-c", f"{WAIT.format(patience=600.0)}print('begun')"]
    for given in ("\n", ""):
        ended = subprocess.run(program, input=given, capture_output=True, text=True, timeout=120, check=True)
        assert ended.stdout == "begun\n"


NAMES = ["/recorder", "/imu", "/left/can_bridge", "/left/compensator", "/right/can_bridge"]


def test_bridges_stop_first_and_recorders_last():
    assert stages(NAMES) == (["/left/can_bridge", "/right/can_bridge"], ["/imu", "/left/compensator"], ["/recorder"])


@pytest.mark.parametrize(
    ("nodes", "added"),
    [
        ({"/right/compensator": {}, "/left/compensator": {"law": "anfis"}}, ["/right/wearer", "/left/wearer"]),
        ({"/compensator": {}, "/right/can_bridge": {}}, ["/wearer"]),
        ({"/right/compensator": {}, "/right/wearer": {}}, []),
        ({"/right/compensator": {"law": "urdf"}}, ["/right/wearer"]),
        ({"/right/compensator": {"command_interface": "multi_array"}}, []),
    ],
    ids=["both arms", "no namespace", "a key of its own", "another arm", "ros2_control"],
)
def test_a_compensator_behind_a_bridge_gets_a_wearer_unless_the_file_has_one(nodes, added):
    assert wearers(nodes) == added


@pytest.mark.parametrize(
    ("only", "names"),
    [
        ((), NAMES),
        (("/left/*",), ["/left/can_bridge", "/left/compensator"]),
        (("*/can_bridge", "/imu"), ["/imu", "/left/can_bridge", "/right/can_bridge"]),
        (("/IMU",), None),
        (("can_bridge",), None),
    ],
)
def test_patterns_are_compared_with_full_names(only, names):
    if names is None:
        with pytest.raises(ParameterError, match=r"only = .*must be a pattern that matches one of /recorder, /imu"):
            chosen(NAMES, only)
    else:
        assert chosen(NAMES, only) == names


HARD = """
/right/compensator:
  ros__parameters:
    robot: {mass: [5e-1, 4e-1, 6e-1, 2e-1], cog: [.05, .1, .2, .1]}
    use_imu: off
    support_adapts: n
    anfis_file: "5e-1"
    max_effort: [3., 9., 3., 3.]
"""


@pytest.mark.parametrize("namespace", ["", "/lab"])
def test_in_whatever_namespace_a_node_gets_what_the_tools_have_read(namespace, tmp_path):
    path = tmp_path / "hard.yaml"
    path.write_text(HARD)
    expected = {
        "robot.mass": [0.5, 0.4, 0.6, 0.2], "robot.cog": [0.05, 0.1, 0.2, 0.1], "use_imu": False,
        "support_adapts": False, "anfis_file": "5e-1", "max_effort": [3.0, 9.0, 3.0, 3.0],
    }  # fmt: skip
    launcher = Launcher(path, print, namespace=namespace)
    given = load(launcher.params)
    assert given == {f"{namespace}/right/compensator": expected, f"{namespace}/right/wearer": {}}
    launcher.stop()
    assert not launcher.params.exists()


def test_a_node_whose_package_is_missing_is_refused_before_any_starts(monkeypatch, refused):
    monkeypatch.setattr(packages, "find_spec", lambda name: None)
    error = refused({})
    assert error == (
        "launcher: simulator cannot start: the Python package mujoco is not installed: pip install '.[sim]' in the "
        "source folder of exo_gravity\n"
    )


TOOLS = {
    "launcher": ["--params"], "doctor": ["--params"], "urdf": ["--params"], "trial": ["demo", "--offline", "--params"],
    "budget": ["--body-mass", "70", "--params"],
}  # fmt: skip


@pytest.mark.parametrize("tool", TOOLS)
def test_every_tool_refuses_what_ros_would_read_otherwise_with_its_line(tool, tmp_path, capsys):
    """What else it would: nodes/test_parameter_file.py."""
    path, before = tmp_path / "params.yaml", SIM.read_text()
    path.write_text(f"{before}/right/compensator: {{ros__parameters: {{max_effort: [2.5, 6.0, 2.5, 2.5]}}}}\n")
    said = f"line {len(before.splitlines()) + 1} = '/right/compensator': must be given once: line "
    try:
        code = importlib.import_module(f"exo_gravity.tools.{tool}").main([*TOOLS[tool], str(path)])
    except SystemExit as ended:
        code = ended.code
    error = capsys.readouterr().err
    assert code == 2 and error.startswith(f"{tool}: ") and f"params.yaml, {said}" in error, error


def test_a_namespace_and_a_log_level_reach_every_node_and_the_imus_topics(launched):
    commands, _ = launched("--namespace", "lab/", "--log-level", "warn")
    words = commands["/lab/right/compensator"]
    assert {"__ns:=/lab/right", "/imu/data:=/lab/imu/data", "/lab/right/compensator", "warn"} <= set(words)


def test_a_line_with_characters_that_the_terminal_lacks_is_printed(monkeypatch):
    """One that raises ends the reader, and a node whose log is not read stands still."""
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    print_any_character()
    launcher.print_line("/right/can_bridge", "Jos\xe9 holds control")
    assert written.getvalue().endswith(b"right/can_bridge   Jos\\xe9 holds control\n")


def test_a_full_or_missing_temporary_folder_is_named(monkeypatch, refused, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path / "none"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    error = refused({})
    assert error.startswith("launcher: TMPDIR = ") and "none" in error and "must be a folder with room" in error
