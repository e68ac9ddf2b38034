# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Wrong use of each tool ends with exit code 2, and a sentence that names what is wrong in place of a traceback."""

from __future__ import annotations

import importlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from exo_gravity.lab.processes import node_modules
from exo_gravity.tools.cli import exit_code

from ..support import CONFIG
from ..support.selection import UNDER_COLCON
from ..support.thorough import quick

EXO = str(CONFIG / "exo.yaml")
NO_FILE = ["--params", "nowhere.yaml"]
LAW = ["--output", "law.json"]
IMU = ["imu", "--params", EXO, "--output"]
LIMITS = ("--max-drift", "--max-drift-after-push", "--max-rate", "--min-hold")
WRONG = [
    ("budget", ["--body-mass", "75", *NO_FILE], "nowhere.yaml"),
    *(("budget", ["--params", EXO, "--body-mass", mass], "must be a number from") for mass in ("75000", "nan")),
    ("budget", ["--params", EXO, "--body-mass", "75", "--support", "2"], "must be a number from"),
    ("calibrate", ["motor"], "invalid choice"),
    ("calibrate", [*IMU, "new.yaml", "--bag", "none"], "must be a recording that exists"),
    ("calibrate", [*IMU, "taken.yaml", "--bag", "."], "taken.html': must be a new file"),
    ("doctor", NO_FILE, "nowhere.yaml"),
    ("report", ["nothing"], "nothing: no such file"),
    ("report", ["--repair", "nothing"], "no such file"),
    *(("report", ["b", f"{o}={v}"], f"{o}: {v}: must be a num") for o in LIMITS for v in ("nan", "-1", "half")),
    ("train_anfis", [*LAW, *NO_FILE], "nowhere.yaml"),
    ("train_anfis", [*LAW, "--bag", "nowhere"], "nowhere"),
    ("train_anfis", [*LAW, "--side", "middle"], "middle"),
    ("train_anfis", [*LAW, "--functions", "1"], "functions"),
    ("trial", ["no_such_trial"], "thirteen_poses, two_poses or a YAML file"),
    ("trial", ["demo", *NO_FILE], "nowhere.yaml"),
    ("trial", ["demo", "--offline", "--params", EXO], "a file with a simulator"),
    ("trial", ["two_poses", "--params", "urdf.yaml"], "a file with a can_bridge, whose arm a trial follows"),
    ("urdf", NO_FILE, "nowhere.yaml"),
    ("urdf", ["--params", EXO, "--output", "missing/arm.urdf"], "arm.urdf"),
    ("validate", NO_FILE, "nowhere.yaml"),
    ("validate", ["--side", "up"], "invalid choice"),
    ("validate", ["--output", "taken.html/folder"], "taken.html"),
]
WITHOUT = {  # by tool: the package, words that need it, and how it is installed
    "report": ("rosbags.typesys", ["b"], ".[report]"),
    "budget": ("matplotlib.figure", ["--params", EXO, "--body-mass", "75"], ".[report]"),
    "train_anfis": ("threadpoolctl", LAW, "python3-threadpoolctl"),
    "launcher": ("rclpy", [], "/opt/ros/jazzy/setup.bash"),
    "doctor": ("rich", ["--seconds", "0"], "python3-rich"),
}
# By node: the package, and the extra that has it.
NODES_WITHOUT = {"simulator": ("mujoco", "sim"), "recorder": ("rosbags", "bag"), "panel": ("uvicorn", "panel")}
NODE = """
import sys
sys.modules[{module!r}] = None
sys.argv = [{node!r}]
from importlib import import_module
import_module({where!r}).main()
"""
ABSENT = " is not installed: "
MAIN = """
import sys
sys.modules[{module!r}] = None
from exo_gravity.tools import {tool}
for words, expected in (({words!r}, 2), (["--help"], 0)):
    try:
        code = {tool}.main(words)
    except SystemExit as ended:
        code = ended.code
    assert code == expected, (words, code)
"""


def says_what_is_absent(said: str) -> bool:
    """Whether this is the one sentence that names a package that a ROS host lacks; no other host may lack one."""
    return UNDER_COLCON and said.count("\n") == 1 and ABSENT in said


@pytest.mark.parametrize(("tool", "words", "sentence"), WRONG)
def test_wrong_use_ends_with_2_and_a_sentence(tool, words, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("taken.html").touch()
    Path("urdf.yaml").write_text("/arm/compensator: {ros__parameters: {law: urdf, joint_names: [a1]}}\n")
    try:
        code = importlib.import_module(f"exo_gravity.tools.{tool}").main(words)
    except SystemExit as ended:
        code = ended.code
    said = capsys.readouterr().err
    assert code == 2 and (sentence in said or says_what_is_absent(said))
    assert f"{tool}: " in said.splitlines()[-1]


def raised(error: type[BaseException]) -> int:
    raise error


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
    assert exit_code("tool", "report", lambda: raised(KeyboardInterrupt)) == 130
    assert capsys.readouterr().err == "tool: stopped\n"
    ascii_alone = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", ascii_alone)
    assert exit_code("tool", "report", lambda: print("0.1 ± 0.2") or 0) == 0
    assert ascii_alone.buffer.getvalue() == b"0.1 \\xb1 0.2\n"


@pytest.mark.parametrize("tool", quick(["launcher"], WITHOUT))
def test_a_missing_package_is_named_with_what_installs_it_and_help_still_works(tool, tmp_path):
    module, words, installs = WITHOUT[tool]
    program = MAIN.format(module=module, tool=tool, words=words)
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert ended.returncode == 0, ended.stderr
    assert f"{module.partition('.')[0]} " in ended.stderr and installs in ended.stderr
    assert ended.stderr.count("\n") == 1 and "usage: " in ended.stdout


@pytest.mark.parametrize("node", quick(["recorder"], NODES_WITHOUT))
def test_a_node_whose_package_is_missing_ends_with_one_sentence_in_place_of_a_traceback(node, tmp_path):
    module, extra = NODES_WITHOUT[node]
    program = NODE.format(module=module, node=node, where=node_modules()[node])
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 2 and module in line and f"pip install '.[{extra}]' in the source folder" in line


@pytest.mark.parametrize("node", node_modules())
def test_each_node_answers_help_with_what_it_does(node, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [node, "--help"])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(node_modules()[node]).main()
    said, error = capsys.readouterr()
    if not says_what_is_absent(error):
        assert ended.value.code == 0 and said.startswith(f"{node}: ") and f"{node} --ros-args" in said
