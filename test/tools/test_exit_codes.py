# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Wrong use of each tool ends with exit code 2, and a sentence that names what is wrong in place of a traceback."""

import io
import json
import os
import subprocess
import sys
import sysconfig
import tempfile
from importlib import import_module, metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import yaml

import exo_gravity
from exo_gravity import with_extra
from exo_gravity.hardware import bus_lock
from exo_gravity.lab import packages
from exo_gravity.lab.processes import node_modules
from exo_gravity.tools.cli import exit_code

from ..support import CONFIG
from ..support.selection import UNDER_COLCON
from ..support.thorough import quick

EXO = str(CONFIG / "exo.yaml")
NO_FILE = ["--params", "nowhere.yaml"]
LAW = ["--output", "law.json"]
IMU = ["imu", "--params", EXO, "--output"]
BUDGET = ["--params", EXO, "--body-mass"]
LIMITS = ("--max-drift", "--max-drift-after-push", "--max-rate", "--min-hold")
WRONG = [
    ("budget", ["--body-mass", "75", *NO_FILE], "nowhere.yaml"),
    *(("budget", [*BUDGET, mass], "must be a number from") for mass in ("75000", "nan")),
    ("budget", [*BUDGET, "75", "--support", "2"], "must be a number from"),
    ("budget", [*BUDGET, "75", "--output", "/proc/none"], "budget: /proc/none: No such file"),
    ("calibrate", ["motor"], "invalid choice"),
    ("calibrate", [*IMU, "new.yaml", "--bag", "none"], "must be a recording that exists"),
    ("calibrate", [*IMU, "taken.yaml", "--bag", "."], "taken.html': must be a new file"),
    ("calibrate", [*IMU, EXO, "--bag", "."], "exo.yaml': must be a new file"),
    ("calibrate", [*IMU, "none/new.yaml", "--bag", "."], "none/new.yaml"),
    (
        "calibrate",
        ["scale", "--params", EXO, "--output", "new.yaml", "--bag", ".", "--lever", "0.3", "--mass", "0.01"],
        "mass times lever",
    ),
    ("doctor", NO_FILE, "nowhere.yaml"),
    ("report", ["nothing"], "nothing: no such file"),
    ("report", ["run[1]"], "run[1]: must be a rosbag2 folder"),
    ("report", [".", "--scheduler", "my cluster"], "scheduler = 'my cluster': must be an address"),
    *(("report", ["b", f"{o}={v}"], f"{o}: {v}: must be a num") for o in LIMITS for v in ("nan", "-1", "half")),
    ("train_anfis", [*LAW, *NO_FILE], "nowhere.yaml"),
    ("train_anfis", [*LAW, "--bag", "nowhere"], "nowhere"),
    ("train_anfis", [*LAW, "--side", "middle"], "middle"),
    ("train_anfis", [*LAW, "--functions", "1"], "functions"),
    ("trial", ["no_such_trial"], "thirteen_poses, two_poses or a YAML file"),
    ("trial", ["demo", *NO_FILE], "nowhere.yaml"),
    ("trial", ["demo", "--offline", "--params", EXO], "a file with a simulator"),
    ("trial", ["two_poses", "--params", "urdf.yaml"], "a file with a can_bridge, whose arm a trial follows"),
    ("trial", ["two_poses", "--offline", "--subject", "Anna Meier"], "subject"),
    ("urdf", NO_FILE, "nowhere.yaml"),
    ("urdf", ["--params", EXO, "--output", "missing/arm.urdf"], "arm.urdf"),
    ("validate", NO_FILE, "nowhere.yaml"),
    ("validate", ["--side", "up"], "invalid choice"),
    ("validate", ["--output", "taken.html/folder"], "taken.html"),
]


def says_what_is_absent(said: str) -> bool:
    """Whether this is the one sentence that names a package that a ROS host lacks; no other host may lack one."""
    return UNDER_COLCON and said.count("\n") == 1 and " is not installed: " in said


@pytest.mark.parametrize(("tool", "words", "sentence"), WRONG)
def test_wrong_use_ends_with_2_and_a_sentence(tool, words, sentence, tmp_path, monkeypatch, run_tool):
    monkeypatch.chdir(tmp_path)
    Path("taken.html").touch()
    for folder in ("run[1]", "run1"):
        Path(folder).mkdir()
    Path("urdf.yaml").write_text("/arm/compensator: {ros__parameters: {law: urdf, joint_names: [a1]}}\n")
    before = sorted(tmp_path.iterdir())
    code, _, said = run_tool(tool, *words)
    assert code == 2 and (sentence in said or says_what_is_absent(said))
    assert f"{tool}: " in said.splitlines()[-1] and sorted(tmp_path.iterdir()) == before


BRIDGE, COMPENSATOR, SIMULATOR = "/right/can_bridge", "/right/compensator", "/right/simulator"
NODES = yaml.safe_load((CONFIG / "sim.yaml").read_text())
CAN = NODES[BRIDGE]["ros__parameters"]["can"]
SLOW = {"interface": "virtual", "channel": "slow", "options": {"bitrate": 250_000}}
LOCKED = {"interface": "virtual", "channel": f"vcan{os.getpid()}"}
JOINTS = NODES[BRIDGE]["ros__parameters"]["joint_names"]
EXECUTABLES = ", ".join(node_modules())
# By case: changes of sim.yaml, how the error begins, and what must be. No node starts.
REFUSED_FILES: dict[str, tuple[dict[str, dict[str, Any]], str, str]] = {
    "a misspelt node": ({"/right/can_brigde": {}}, "node name = '/right/can_brigde'", EXECUTABLES),
    "a tool": ({"/right/budget": {}}, "node name = '/right/budget'", EXECUTABLES),
    "two bridges on one bus": (
        {"/left/can_bridge": {"can": CAN, "can_id": [9, 8, 7, 5]}},
        "/left/can_bridge can = {'can.channel': '239.74.163.2'",
        "must be different from the bus of /right/can_bridge: one arm per bus",
    ),
    "two orders of joints": ({BRIDGE: {"joint_names": JOINTS[::-1]}}, f"{BRIDGE} joint_names", f"of {COMPENSATOR}"),
    "another order in the simulator": ({SIMULATOR: {"joint_names": JOINTS[::-1]}}, f"{BRIDGE} joint_names", SIMULATOR),
    "a side that is not the namespace's": ({COMPENSATOR: {"side": "left"}}, f"{COMPENSATOR} side = 'left'", "be right"),
    "a second imu": ({"/right/imu": {}}, "params = ['/imu', '/right/imu']", "one imu, which serves both arms"),
    "an expression": ({BRIDGE: {"zero": [0.0, "pi/8", 0.0, 0.0]}}, f"{BRIDGE} zero = 'pi/8'", "must be a number"),
    "an option that not every motor has": (
        {BRIDGE: {"can": {**CAN, "options": {**CAN["options"], "bitrate": [500_000, 1_000_000]}}}},
        f"{BRIDGE} can.options.bitrate = [500000, 1000000]", "must be one value",
    ),
    "a list that ROS reads for minutes": (
        {COMPENSATOR: {"gain": [1.0] * 5_000}}, f"{COMPENSATOR} gain = [1.0, 1.0",
        "at most 100 entries; it has 5,000",
    ),
    "a mass": ({COMPENSATOR: {"robot": {"mass": [585.0] * 4}}}, f"{COMPENSATOR} ", "robot.mass = [585.0"),
    "a rate": ({BRIDGE: {"rate": 20.0, "frozen_timeout": 0.08}}, f"{BRIDGE} ", "rate = 20.0: must be at least"),
    "a slow bus": ({BRIDGE: {"rate": 400.0, "can": SLOW}}, f"{BRIDGE} ", "Hz, the capacity of the CAN bus"),
    "a torque": ({BRIDGE: {"max_effort": [18.0] * 4}}, f"{BRIDGE} ", "at most the motors' peak torque"),
    "a mounting": ({"/imu": {"rotation_trunk_from_imu": [0.0] * 4}}, "/imu ", "must be a unit quaternion"),
    "a model": ({COMPENSATOR: {"law": "anfis", "anfis_file": "none.json"}}, f"{COMPENSATOR} anfis_file", "'none.json'"),
    "a URDF": (
        {"/arm/compensator": {"law": "urdf", "urdf": {"file": "none.urdf"}}}, "/arm/compensator ",
        "urdf.file = 'none.urdf'",
    ),
    "a carried arm": (
        {BRIDGE: {"can": LOCKED}}, f"{BRIDGE}: CAN bus {LOCKED['channel']} is held by", "/right/can_bridge (PID 7)",
    ),
    "a misspelt parameter": ({COMPENSATOR: {"max_efort": [1.0] * 4}}, f"{COMPENSATOR} max_efort", ""),
    "two types": ({COMPENSATOR: {"gain": [1, 1.0, 1.0, 1.0]}}, "", "a list of one type"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "begins", "sentence"), REFUSED_FILES.values(), ids=REFUSED_FILES)
def test_a_file_with_which_a_node_could_not_run_is_refused_before_any_starts(
    changes, begins, sentence, params_with, run_tool, tmp_path, monkeypatch
):
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))
    lock = bus_lock.BusLock((LOCKED["interface"], LOCKED["channel"], {}), "/right/can_bridge (PID 7)")
    ended = run_tool("launcher", "--params", params_with("sim.yaml", changes))
    lock.release()
    assert ended.code == 2 and ended.err.startswith(f"launcher: {begins}") and sentence in ended.err


# By case: the command and its words, changes of sim.yaml, nodes that the file lacks, and what is said.
OF_OTHER_TOOLS: dict[str, tuple[list[str], dict[str, dict[str, Any]], tuple[str, ...], str]] = {
    "doctor, a parameter": (["doctor"], {COMPENSATOR: {"max_efort": [1.0] * 4}}, (), f"{COMPENSATOR} max_efort"),
    "doctor, a model": (["doctor"], {COMPENSATOR: {"law": "anfis", "anfis_file": "no"}}, (), "compensator anfis_file"),
    "doctor, a rate": (
        ["doctor"], {BRIDGE: {"rate": 500.0, "wire_format": ["mit_v3"] * 4}}, (), "rate = 500.0: must be at most 400",
    ),
    **{
        f"doctor, {interface}": (
            ["doctor"], {BRIDGE: {"can": {"interface": interface, "channel": "/dev/ttyUSB0", "options": {}}}}, (),
            f"{BRIDGE} can.options.bitrate = None: must be set for {interface}",
        )
        for interface in ("seeedstudio", "systec", "iscan", "nixnet", "neousys", "pcan", "robotell")
    },
    "trial": (["trial", "demo", "--offline"], {"/right/simulator": {"robot": {"cog": [0.5] * 4}}}, (), "simulator cog"),
    "budget, a short link": (
        ["budget", "--body-mass", "75"], {COMPENSATOR: {"link_length": [0.05, 0.13, 0.3, 0.15]}}, (), COMPENSATOR,
    ),
    "budget, no bridge": (["budget", "--body-mass", "75"], {}, (BRIDGE,), BRIDGE),
}  # fmt: skip


@pytest.mark.parametrize(("words", "changes", "without", "said"), OF_OTHER_TOOLS.values(), ids=OF_OTHER_TOOLS)
def test_every_tool_refuses_a_wrong_file_in_one_line_that_names_the_parameter_and_writes_nothing(
    words, changes, without, said, params_with, run_tool, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    path = params_with("sim.yaml", changes, without)
    ended = run_tool(*words, "--params", path)
    assert ended.code == 2 and ended.err.startswith(f"{words[0]}: ") and said in ended.err
    assert ended.err.count("\n") == 1 and list(tmp_path.iterdir()) == [path]


def test_a_full_or_missing_temporary_folder_is_named(monkeypatch, run_tool, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path / "none"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    code, _, error = run_tool("launcher")
    assert code == 2 and error.startswith("launcher: TMPDIR = ") and "none': must be a folder with room" in error


@pytest.mark.parametrize(("output", "code", "said"), [("pipe", 141, ""), ("/dev/full", 2, "No space left on device")])
def test_an_output_that_cannot_be_written_ends_with_a_code_and_no_traceback(output, code, said, monkeypatch, capsys):
    if output == "pipe":
        reader, descriptor = os.pipe()
        os.close(reader)  # as `head` does
    else:
        descriptor = os.open(output, os.O_WRONLY)
    stream = os.fdopen(descriptor, "w")
    monkeypatch.setattr(sys, "stdout", stream)
    assert exit_code("tool", "report", lambda: print("a table") or 0) == code
    assert said in capsys.readouterr().err
    stream.close()  # as Python does at its end


def test_ctrl_c_is_one_line_and_a_terminal_without_a_character_shows_its_code(monkeypatch, capsys):
    assert exit_code("tool", "report", Mock(side_effect=KeyboardInterrupt)) == 130
    assert capsys.readouterr().err == "tool: stopped\n"
    ascii_alone = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", ascii_alone)
    assert exit_code("tool", "report", lambda: print("0.1 ± 0.2") or 0) == 0
    assert ascii_alone.buffer.getvalue() == b"0.1 \\xb1 0.2\n"


# Packages that are missing: of a tool or a node, and what installs each
WITHOUT = {
    "report b": ("exo_gravity.tools.report", "rosbags.typesys", with_extra("report")),
    f"budget {' '.join(BUDGET)} 75": ("exo_gravity.tools.budget", "matplotlib.figure", with_extra("report")),
    f"train_anfis {' '.join(LAW)}": ("exo_gravity.tools.train_anfis", "threadpoolctl", "python3-threadpoolctl"),
    "validate --quick": ("exo_gravity.tools.validate", "pinocchio", with_extra("report,validate")),
    "launcher": ("exo_gravity.tools.launcher", "rclpy", "/opt/ros/jazzy/setup.bash"),
    "doctor --seconds 0": ("exo_gravity.tools.doctor", "rich", "python3-rich"),
    "can_bridge": (node_modules()["can_bridge"], "rclpy", with_extra("ros")),
    "simulator": (node_modules()["simulator"], "mujoco", with_extra("sim")),
    "recorder": (node_modules()["recorder"], "rosbags", with_extra("report")),
    "panel": (node_modules()["panel"], "uvicorn", with_extra("report")),
}
PROGRAM = """
import sys
from importlib import import_module
sys.modules[{package!r}] = None
sys.argv = {words!r}
sys.exit(import_module({module!r}).main())
"""


@pytest.mark.parametrize("words", quick(["launcher", "recorder"], WITHOUT))
def test_a_missing_package_is_named_in_one_line_with_what_installs_it_and_help_still_works(words, tmp_path):
    module, package, installs = WITHOUT[words]
    helps = words.partition(" ")[0] not in node_modules()
    for given, code in [(words.split(), 2)] + helps * [([*words.split(), "--help"], 0)]:
        ended = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(module=module, package=package, words=given)],
            cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip
        assert ended.returncode == code, ended.stderr
        assert (installs in ended.stderr and ended.stderr.count("\n") == 1) if code else "usage: " in ended.stdout


@pytest.mark.parametrize(
    ("came_from", "stands_in", "environment", "command"),
    [
        ("a.whl", "site", "venv", "pip install '{0}/a.whl[report,sim]'"),
        ("my source", "site", "venv", "pip install '{0}/my source[report,sim]'"),
        ("", "my source", "venv", "pip install '{0}/my source[report,sim]'"),
        ("", "my source", "my source/.venv", "'{0}/my source/.ci/setup' report sim"),
        ("", "site", "venv", "pip install '.[report,sim]' in the source folder of exo_gravity"),
        ("a.whl", "site", "usr", "pip install --break-system-packages '{0}/a.whl[report,sim]' 'numpy<2'"),
    ],
    ids=["wheel", "source folder", "editable", "a clone's environment", "workspace", "Ubuntu's own Python"],
)
def test_the_command_for_a_missing_package_fits_how_this_one_was_installed(
    came_from, stands_in, environment, command, tmp_path, monkeypatch
):
    (tmp_path / "my source").mkdir()
    for name in ("a.whl", "my source/setup.py", "EXTERNALLY-MANAGED"):
        (tmp_path / name).touch()
    told = json.dumps({"url": (tmp_path / came_from).as_uri()}) if came_from else None
    monkeypatch.setattr(metadata, "distribution", lambda name: SimpleNamespace(read_text=lambda name: told))
    monkeypatch.setattr(exo_gravity, "__file__", str(tmp_path / stands_in / "exo_gravity" / "__init__.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / environment))
    monkeypatch.setattr(sys, "base_prefix", str(tmp_path / "usr"))
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    assert with_extra("report,sim") == command.format(tmp_path)


def test_a_node_whose_package_is_missing_is_refused_before_any_starts(monkeypatch, run_tool):
    monkeypatch.setattr(packages, "find_spec", lambda name: None)
    assert run_tool("launcher") == (
        2,
        "",
        f"launcher: simulator cannot start: the Python package mujoco is not installed: {with_extra('sim')}\n",
    )


@pytest.mark.parametrize("node", node_modules())
def test_each_node_answers_help_with_what_it_does(node, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [node, "--help"])
    with pytest.raises(SystemExit) as ended:
        import_module(node_modules()[node]).main()
    said, error = capsys.readouterr()
    if not says_what_is_absent(error):
        assert ended.value.code == 0 and said.startswith(f"{node}: ") and f"{node} --ros-args" in said
