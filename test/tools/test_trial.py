# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""trial, from script to report: offline, over ROS, interrupted, and used wrongly."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader

from exo_gravity.lab import processes
from exo_gravity.tools import report, trial
from exo_gravity.tools.trial import main

from ..support import CONFIG, csv_rows
from ..support.launched_nodes import PORTS, LaunchedNodes
from ..support.trunk_trial import moved, trunk_trial
from ..support.waiting import PATIENCE

SHORT = {"name": "short", "steps": [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 4.0}]}


def by_length(path: Path) -> int:
    return len(path.name)  # attempts on a machine that was too busy have a number in addition


@pytest.fixture
def run(tmp_path):
    """Run `trial` with `changes` of sim.yaml by node; return its exit code and the folder of its last attempt.

    The folder is `tmp_path` if it wrote none.
    """
    handlers = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]

    def run(*arguments, script=SHORT, simulator=None, **changes):
        (tmp_path / "script.yaml").write_text(yaml.safe_dump(script))
        output = tmp_path / f"out_{next(PORTS)}"
        # Saves seconds. The wearer first moves after RAMPING_IN, in which a joint that moves gives up its torque.
        params = LaunchedNodes(tmp_path, simulator={"trial_delay": 3.0, **(simulator or {})}, **changes).path
        code = main([str(tmp_path / "script.yaml"), "--params", str(params), "--output", str(output), *arguments])
        return code, min(output.iterdir(), key=by_length) if output.exists() else tmp_path

    yield run
    for number, handler in handlers:
        signal.signal(number, handler)


def column(folder, name):
    return [float(row[name]) for row in csv_rows(folder / "holds.csv")]


def test_an_offline_trial_ends_with_a_report_of_its_recording(run, capsys):
    code, folder = run("--offline")
    assert code == 0
    report_files = {"holds.csv", "motions.csv", "report.html", "right_overview.png"}  # it held: no drift to draw
    assert {path.name for path in folder.iterdir()} == {"params.yaml", "bag", *report_files}
    text = capsys.readouterr().out
    assert "times real time" in text and "It held." in text
    np.testing.assert_allclose(column(folder, "pose_deg"), np.degrees(SHORT["steps"][0]["move"]), atol=2.0)
    with Reader(folder / "bag") as recorded:  # rosbags' own
        assert {"/right/joint_states", "/right/effort_commands", "/diagnostics"} <= set(recorded.topics)
    metadata = yaml.safe_load((folder / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["custom_data"] == {"source.right": "simulated"}
    assert "Simulated: programs made" in (folder / "report.html").read_text(encoding="utf-8")
    assert report.main([str(folder / "bag"), "--output", str(folder / "again")]) == 0
    for table in ("holds.csv", "motions.csv"):
        assert csv_rows(folder / "again" / table) == csv_rows(folder / table)


@pytest.mark.usefixtures("without_pictures")
def test_a_trial_of_a_subject_is_in_the_folder_of_the_subject_and_the_day_and_a_name_is_refused(run, capsys):
    code, folder = run("--offline", "--subject", "P01", "--protocol", "pilot", "--note=- stiff")
    (found,) = folder.glob("*-*-*/short_*")
    assert code == 0 and folder.name == "P01"
    rows = {(row["subject"], row["trial"], row["mode"]) for row in csv_rows(found / "holds.csv")}
    assert rows == {("P01", found.name, "one_g")}
    page = (found / "report.html").read_text(encoding="utf-8")
    assert "Protocol: pilot" in page and "Note: - stiff" in page
    code, folder = run("--offline", "--subject", "Anna Meier")
    assert code == 2 and "subject" in capsys.readouterr().err and not list(folder.rglob("Anna*"))


def test_a_trial_goes_on_when_its_progress_is_no_longer_read():
    code = "import sys; from exo_gravity.tools.trial import _print_json as p; p(step=0); input(); p(step=1); p(step=2)"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True)
    assert process.stdout.readline() == '{"step": 0}\n'
    process.stdout.close()
    process.stdin.write("\n")
    process.stdin.close()
    assert process.wait(PATIENCE) == 0 and process.stderr.read() == ""
    process.stderr.close()


def thirteen(poses=13):
    content = yaml.safe_load((CONFIG / "trials" / "thirteen_poses.yaml").read_text())
    steps = [{"hold": 2.5} if "hold" in step else step for step in content["steps"][: 2 * poses]]
    return {"name": "thirteen", "steps": steps}


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.thorough
def test_the_packaged_arm_drifts_less_than_a_fifth_of_a_degree_per_minute_in_all_thirteen_poses(run):
    code, folder = run("--offline", script=thirteen())
    rates = np.abs(column(folder, "drift_deg_per_min"))
    assert code == 0 and len(rates) == 4 * 13 and max(rates) < 0.2


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.thorough
def test_with_masses_a_tenth_off_and_half_the_friction_the_report_names_the_poses_that_give_way(run, capsys):
    masses = [round(1.1 * mass, 4) for mass in (0.585, 0.468, 0.598, 0.203)]
    heavy = {"robot": {"mass": masses, "cog": [0.046, 0.113, 0.237, 0.128]}}
    slippery = {"friction": {"coulomb": [0.1, 0.2, 0.1, 0.1]}}
    code, _ = run("--offline", script=thirteen(poses=4), compensator=heavy, simulator=slippery)
    said = capsys.readouterr().out
    assert code == 1 and "It did not hold." in said
    assert said.count("the arm was still moving at the end of a hold") > 1


def test_a_wrong_parameter_ends_with_exit_code_2_one_sentence_and_no_folder(run, capsys):
    """Of the other nodes: test_doctor.py, by the same reader."""
    code, folder = run("--offline", simulator={"robot": {"cog": [0.5] * 4}})
    error = capsys.readouterr().err
    assert code == 2 and not list(folder.glob("out_*"))
    assert "/right/simulator cog" in error and error.count("\n") == 1


@pytest.mark.usefixtures("without_pictures")
def test_ctrl_c_lets_the_arm_down_and_reports_what_was_recorded(run, capsys, monkeypatch):
    def stop_on_signals() -> threading.Event:
        stopped = processes.stop_on_signals()
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        return stopped

    monkeypatch.setattr(trial, "stop_on_signals", stop_on_signals)
    code, folder = run("--offline", script={"name": "long", "steps": [SHORT["steps"][0], {"hold": 3000.0}]})
    assert code == 1 and (folder / "report.html").exists()
    text = capsys.readouterr().out
    assert "stopped by the operator" in text and "slipped" not in text


@pytest.mark.thorough
@pytest.mark.real_time
def test_over_ros_the_arm_holds_in_the_pose_that_it_has_offline(run):
    code, folder = run()
    assert code == 0, (folder / "log.txt").read_text()
    assert {"bag", "log.txt", "params.yaml", "report.html"} <= {path.name for path in folder.iterdir()}
    _, offline = run("--offline")
    np.testing.assert_allclose(column(folder, "pose_deg"), column(offline, "pose_deg"), atol=0.3)


BOW = {"bow": math.radians(30.0), "over": 3.0}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("steps", "inertial", "least", "most"),
    [
        ((BOW, {"hold": 1.0}), True, 0.0, 2.0),
        (({"walk": 6.0}, {"hold": 1.0}), True, 0.0, 3.0),
        ((BOW, {"hold": 1.0}), False, 0.0, 2.0),
        (({"walk": 4.0},), False, 5.0, math.inf),
    ],
    ids=["bow", "walk", "bow, tilt alone", "walk, tilt alone"],
)
def test_an_arm_with_little_friction_stays_where_it_is_unless_a_walking_trunks_acceleration_is_left_out(
    steps, inertial, least, most
):
    trial = trunk_trial(*steps, inertial=inertial)
    assert least < moved(trial.run(), ("bow", "walk")) < most  # degrees
    assert trial.trouble == ""
