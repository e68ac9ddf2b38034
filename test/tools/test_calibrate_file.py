# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What `calibrate` writes, shows and waits for.

The first file of an arm from its URDF; a calibrated file, the old one with new values and nothing else changed; the
page beside it; and the person at the terminal.
"""

from __future__ import annotations

import argparse
import datetime
import io
import json
import math
import os
import re
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from exo_gravity.core.arm.paper import ArmModel, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import BusError, DataError, ParameterError
from exo_gravity.hardware import bus_lock
from exo_gravity.lab.calibration import identification, tours
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.new import turning_joints
from exo_gravity.lab.calibration.result import CalibrationResult, Change, page_of, remainders, write_changes
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import configured_arm, configured_arms, read_arm
from exo_gravity.lab.inputs.parameter_file import can_options, load
from exo_gravity.lab.trial.offline import simulated_trials
from exo_gravity.sim.script import TrialScript

from ..support import CONFIG
from ..support.chains import random_chain

DAY = datetime.date(2026, 11, 22)

# The first file of an arm

URDF = "package://exo_gravity/config/arms/three_joints.urdf"
ARM = ["--urdf", URDF, "--motors", "AK80-9", "AK80-9", "AK60-6", "--ids", "1", "2", "3", "--hand", "hand"]


@pytest.fixture
def new(run_tool, tmp_path):
    """A function that runs `calibrate new` for the arm of three joints, with these words besides."""
    return lambda *words: run_tool("calibrate", "new", *ARM, *words, "--output", tmp_path / "arm.yaml")


def test_the_written_file_takes_limits_torques_and_home_from_urdf_and_motors(tmp_path, new):
    ended, output = new("--channel", "can1"), tmp_path / "arm.yaml"
    assert ended.code == 0 and "MEASURE in it marks" in ended.out
    assert "by its URDF the arm hangs at abduction 1, flexion 0, elbow 0 degrees" in ended.out
    arm = read_arm(load(output), "/right")
    assert arm.limits.position_max == (1.9, 2.3, 2.3) and arm.limits.position_min[2] == -0.1  # it hangs at 0
    assert arm.limits.max_effort == (9.0, 9.0, 3.0) and arm.compensator["wearer.links"] == [2, 3]
    assert arm.can_bridge["can.channel"] == "can1" and not arm.can_bridge["autostart"]
    assert max(map(abs, arm.settings.torque(arm.limits.home, Tilt.of("right"))[0])) < 0.01
    output.unlink()
    assert new("--motors", "DM-J4340", "DM-J4340", "DM-J4310", "--fd").code == 0
    assert can_options(load(output)["/right/can_bridge"]) == {"fd": True}


TABLE = """<robot name="table"><link name="base"/>
<joint name="lift" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="{}" upper="{}" effort="9" velocity="5"/></joint>
<link name="arm"><inertial><origin xyz="{} 0 {}"/><mass value="1.2"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.mark.parametrize(
    ("motor", "urdf", "target"),
    [
        (["AK80-64"], TABLE.format("-0.3", "3.0", "0.1819", "0.0832"), 1.2),  # hangs at 2.0
        (["DM-J4340", "--fd"], (CONFIG / "arms" / "elbow.urdf").read_text(), 0.8),
    ],
)
def test_a_simulated_arm_of_a_new_file_is_carried_wherever_it_is_started(
    motor, urdf, target, tmp_path, run_tool, monkeypatch
):
    (tmp_path / "arm.urdf").write_text(urdf)
    monkeypatch.chdir(tmp_path)
    arm = ("--urdf", "arm.urdf", "--motors", *motor, "--ids", 1)
    assert run_tool("calibrate", "new", *arm, "--simulate", "--output", "arm.yaml").code == 0
    monkeypatch.chdir("/")
    script = TrialScript.parse({"name": "raise", "steps": [{"move": [target], "over": 3.0}, {"hold": 3.0}]})
    (trial,) = simulated_trials(tmp_path / "arm.yaml", script)
    assert np.ptp(trial.run().position) > 0.7 and not trial.trouble


HANG = {  # the joint's limits, where its link's mass lies at 0 in x and z; what is said, and where home is
    "falls from 0": (("-0.3", "3.0", "0.1819", "0.0832"), "the arm hangs at lift 115 degrees", 2.0),
    "is turned by less than friction": (("-1.0", "2.0", "0.001", "0"), "the arm hangs at lift 0 degrees", 0.0),
    "hangs at 0": (("-1.0", "1.0", "0", "-0.2"), "the arm hangs at lift 0 degrees", 0.0),
    "stands upright at 0": (("-0.5", "1.2", "0", "0.2"), "cannot hang within its limits: lift would rest", 1.2),
}


@pytest.mark.parametrize(("arm", "said", "home"), HANG.values(), ids=HANG)
def test_home_is_where_gravity_brings_the_arm_and_an_arm_that_cannot_hang_is_told(arm, said, home, tmp_path, run_tool):
    urdf, output = tmp_path / "arm.urdf", tmp_path / "arm.yaml"
    urdf.write_text(TABLE.format(*arm))
    ended = run_tool("calibrate", "new", "--urdf", urdf, "--motors", "AK80-9", "--ids", 1, "--output", output)
    assert ended.code == 0 and said in ended.out
    assert read_arm(load(output), "/right").limits.home == pytest.approx((home,), abs=1e-3)


UNFIT = {
    "two IDs": (
        ["--ids", 1, 2],
        "motors and ids = .*: must be one motor and one ID for each of the joints abduction",
    ),
    "no such motor": (["--motors", "AK80-9", "AK80-9", "AK99"], "motors = 'AK99': must be one of AK10-9"),
    "a motor without CAN FD": (["--fd"], "motors = 'AK80-9': must be one of DM-.* on CAN FD"),
    "no such file": (["--urdf", "none.urdf"], "urdf.file = 'none.urdf': must be a URDF file"),
    "no such link": (["--hand", "claw"], "urdf.hand = 'claw': must be a link of the URDF"),
    "out of order": (["--simulate", "--joints", "elbow", "abduction", "flexion"], "joints = .*: must be in the order"),
    "one ID twice": (["--ids", 1, 1, 2], "can_id = .*: must be 3 different IDs"),
}


@pytest.mark.parametrize(("changes", "problem"), UNFIT.values(), ids=UNFIT)
def test_what_does_not_fit_is_refused_by_name(changes, problem, tmp_path, new):
    ended = new(*changes)
    assert ended.code == 2 and re.search(problem, ended.err)
    assert not list(tmp_path.iterdir())


LOWER, UPPER = 'lower="-0.1"', 'upper="2.4"'
CHANGED = {  # of the elbow's description: what is written instead, the exit code, and what is said
    "degrees": (
        {LOWER: 'lower="-10"', UPPER: 'upper="150"'},
        0,
        "-10 to 150 rad, are cut to ±3.1: are they in deg",
    ),
    "no room": ({LOWER: 'lower="0"', UPPER: 'upper="0"'}, 0, "elbow: its limits, 0 to 0 rad, leave no room"),
    "a formula": ({LOWER: 'lower="-pi/2"'}, 2, "limit lower of the joint elbow = '-pi/2': must be a finite number"),
    "the wrong way": ({LOWER: 'lower="3"'}, 2, "limits of elbow = [3.0, 2.4]"),
    "cut": ({"</robot>": ""}, 2, "must be well-formed XML"),
    "no joint that turns": ({"revolute": "prismatic"}, 2, "the joints (none of the URDF turns)"),
    **{name: ({'"elbow"': f"'{name}'"}, 0, "Written: ") for name in ("on", "a: [b]", "0x10", '"e"', "Arm für P01")},
}


@pytest.mark.parametrize(("changes", "code", "said"), CHANGED.values(), ids=CHANGED)
def test_a_doubtful_description_is_named_and_any_name_of_a_joint_is_written_as_it_is(
    changes, code, said, tmp_path, run_tool
):
    text = (CONFIG / "arms" / "elbow.urdf").read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    urdf, output = tmp_path / "my arm.urdf", tmp_path / "arm.yaml"
    urdf.write_text(text, encoding="utf-8")
    ended = run_tool("calibrate", "new", "--urdf", urdf, "--motors", "AK80-64", "--ids", 1, "--output", output)
    assert ended.code == code and said in ended.text and output.exists() == (code == 0)
    if said == "Written: ":
        assert read_arm(load(output), "/right").limits.joint_names == (changes['"elbow"'][1:-1],)


def test_every_turning_joint_that_follows_no_other_is_one_of_the_arms():
    text, names = random_chain(3, seed=1)
    second = 'name="joint_1" type="revolute">'
    assert list(turning_joints(text)) == names
    assert list(turning_joints(text.replace(second, f'{second}<mimic joint="joint_0"/>'))) == [names[0], names[2]]
    free = turning_joints(text.replace('"revolute"', '"continuous"'))
    assert all(math.isclose(edge.high, 3.1) for edge in free.values())


# A calibrated file

OLD = """\
# The whole arm.
/right/can_bridge:
  ros__parameters:
    can: {interface: socketcan, channel: can0}  # the black box
    zero: [0.0, 0.0,
           # the odd one
           0.0, 0.0]
    direction:
      - 1   # shoulder
      - 1
      - 1
      - 1   # elbow

    # Limits of the stops.
    position_min: [-1.6, -0.1, -0.7, -0.1]

/right/compensator:
  ros__parameters:
    side: right
    robot: {mass: [0.5, 0.4, 0.5, 0.2], cog: [0.04, 0.11, 0.23, 0.12]}
    wearer:
      # of the wearer
      mass: [0.0, 0.0, 0.0, 0.0]
    max_effort: [3.0, 9.0, 3.0, 3.0]"""
BRIDGE, COMPENSATOR, DATED = "/right/can_bridge", "/right/compensator", "# 2026-11-22 calibrate motors"
ROBOT = "robot: {mass: [0.5, 0.4, 0.5, 0.2], cog: [0.04, 0.11, 0.23, 0.12]"
WRITTEN = {  # changes, and what is written in place of which part of the file
    "a value": (
        [Change(BRIDGE, "position_min", [-1.5, -0.1, -0.7, 0.0], "rad, ±0.01")],
        {"position_min: [-1.6, -0.1, -0.7, -0.1]": f"{DATED}: rad, ±0.01\n    position_min: [-1.5, -0.1, -0.7, 0.0]"},
    ),
    "lists with comments in them": (
        [Change(BRIDGE, "direction", [1, -1, 1, -1]), Change(BRIDGE, "zero", [0.1, 0.2, 0.3, 0.4])],
        {
            "zero: [0.0, 0.0,": f"{DATED}\n    zero: [0.1, 0.2,",
            "           0.0, 0.0]": "           0.3, 0.4]",
            "direction:": f"{DATED}\n    direction:",
            "- 1\n      - 1\n      - 1   # elbow": "- -1\n      - 1\n      - -1   # elbow",
        },
    ),
    "names that the file lacks, each in its mapping": (
        [
            Change(COMPENSATOR, "robot.first_moment", [0.1, 0.2, 0.3, 0.05], "kg m"),
            Change(COMPENSATOR, "wearer.cog", [0.0, 0.0, 0.1, 0.1], "m"),
            Change(COMPENSATOR, "gain", [1.0, 1.0, 1.0, 1.0], "none"),
        ],
        {
            ROBOT: f"{DATED}: kg m\n    {ROBOT}, first_moment: [0.1, 0.2, 0.3, 0.05]",
            "0.0, 0.0]\n    max": f"0.0, 0.0]\n      {DATED}: m\n      cog: [0.0, 0.0, 0.1, 0.1]\n    max",
            "3.0, 3.0]": f"3.0, 3.0]\n    {DATED}: none\n    gain: [1.0, 1.0, 1.0, 1.0]",
        },
    ),
    "notes alone, in their order": (
        [Change(BRIDGE, "", 0, note) for note in (f"first, {15 * 'many words '}", "second")],
        {
            f"{BRIDGE}:\n": f"{BRIDGE}:\n  {DATED}: first, {' '.join(7 * ['many words'])}\n"
            f"  # {' '.join(8 * ['many words'])}\n  {DATED}: second\n"
        },
    ),
}


@pytest.fixture
def written(tmp_path):
    """A function that writes changes of a file; it returns the new file's text."""

    def written(changes, old=OLD):
        params, output = tmp_path / "old.yaml", tmp_path / "new.yaml"
        params.write_text(old, encoding="utf-8")
        write_changes(params, output, changes, "calibrate motors", DAY)
        return output.read_text(encoding="utf-8")

    return written


@pytest.mark.parametrize(("changes", "replaced"), WRITTEN.values(), ids=WRITTEN)
def test_new_values_with_date_and_accuracy_are_all_that_changes(written, changes, replaced):
    expected = OLD
    for old, new in replaced.items():
        assert old in expected
        expected = expected.replace(old, new)
    assert written(changes) == expected


def test_of_a_value_that_changes_again_both_dates_stay(written, tmp_path):
    again = [Change(BRIDGE, "zero", [0.1, 0.2, 0.3, 0.4])]
    once = written(again)
    (tmp_path / "new.yaml").unlink()
    assert written(again, once).count(DATED) == 2


@pytest.mark.parametrize("name", ["exo.yaml", "sim.yaml", "sim_both.yaml"])
def test_a_packaged_file_keeps_every_line_and_still_describes_its_arms(written, tmp_path, name):
    old, zeros = (CONFIG / name).read_text(encoding="utf-8"), [1e-5, -0.4, 0.1, 1 / 3]
    changes = [Change(BRIDGE, "can_id", [4, 3, 2, 1]), Change(BRIDGE, "zero", zeros)]
    new = written([*changes, Change(COMPENSATOR, "robot.mass", [0.5, 0.4, 0.3, 0.2])], old)
    assert len(new.splitlines()) == len(old.splitlines()) + 3
    arm = next(arm for arm in configured_arms(tmp_path / "new.yaml") if arm.side == "right")
    assert [motor.can_id for motor in arm.motors] == [4, 3, 2, 1]
    assert [motor.zero for motor in arm.motors] == pytest.approx(zeros, rel=1e-6)


SHARED = "/a/x:\n  ros__parameters: &both\n    zero: [0.0]\n/b/x:\n  ros__parameters: *both\n"


@pytest.mark.parametrize(("old", "node", "named"), [(SHARED, "/b/x", "&both"), (OLD, *2 * ("/left/can_bridge",))])
def test_a_value_that_other_entries_share_and_a_node_that_the_file_lacks_are_refused(
    tmp_path, written, old, node, named
):
    with pytest.raises(ParameterError, match=named):
        written([Change(node, "zero", [1.0])], old)
    assert not (tmp_path / "new.yaml").exists()


# The page

DOWN = Tilt.of("right", 0.3, -0.2).direction
LOAD = (1.0, 0.25)  # kg, m from the elbow
FRICTION = np.array((0.12, 0.2, 0.12, 0.1))
POSES = np.radians(
    [
        (0, 10, 0, 20), (30, 60, 20, 30), (-40, 40, 60, 90), (20, 90, 0, 0), (0, 30, 90, 60), (-20, 70, 45, 110),
        (45, 100, 30, 45), (0, 50, 110, 20), (-60, 80, 10, 70), (10, 20, 40, 120), (30, 80, 60, 10), (-30, 60, 90, 30),
    ]
)  # fmt: skip
IN_FILE = configured_arm().robot
PAPERS = MomentModel(IN_FILE, True)
#: The links of the configured arm, a fifth heavier, with centres of gravity off their axes.
TRUE = ArmModel.from_moments(IN_FILE.length, 1.2 * np.array(IN_FILE.first_moment), (0.004, -0.006, 0.003, 0.002))
LOADED = np.arange(len(POSES)) % 2 == 1  # every second pose has the weight on link 4


def predicted(arm: ArmModel) -> np.ndarray:
    """Return the torque (n, 4) in Nm that holds `arm` in each pose."""
    return gravity_torque(arm, POSES, DOWN) + LOADED[:, None] * (PAPERS.rows(POSES, DOWN) @ PAPERS.load(*LOAD))


@pytest.fixture(scope="module")
def found() -> CalibrationResult:
    """The result of a calibration of `TRUE`."""
    effort = predicted(TRUE) + 0.005 * np.random.default_rng(1).standard_normal(POSES.shape)
    taken = tuple(
        Observation(theta, DOWN, torque, FRICTION, np.full(4, 0.005), *(LOAD if loaded else (0.0, 0.0)))
        for theta, torque, loaded in zip(POSES, effort, LOADED, strict=True)
    )
    result = identification.identify(taken, PAPERS)
    change = Change(COMPENSATOR, "robot.first_moment", result.value.moment.tolist(), "kg m, <±0.001>")
    return CalibrationResult((change,), ("M4 is 20 % larger.",), (), configured_arm(), PAPERS, taken, result)


def test_the_page_compares_the_old_and_the_new_file_with_what_was_measured(found):
    old, new = remainders(found.identified, found.arm, PAPERS, found.observations)
    assert [one.effort for one in found.observations] - old == pytest.approx(predicted(IN_FILE))
    assert np.abs(old).max() > 10.0 * np.abs(new).max()


@pytest.mark.usefixtures("without_pictures")
def test_a_refusal_is_on_the_page_without_new_values(found):
    page = page_of(replace(found, refusals=("pose 3 slipped",), identified=None), "gravity", "old.yaml", DAY)
    assert "Not calibrated" in page and "<li>pose 3 slipped</li>" in page
    assert "robot.first_moment" not in page and "<img" not in page


# The person at the terminal


def test_the_motors_are_watched_until_enter_is_pressed_and_without_a_person_the_program_ends():
    reading, writing = os.pipe()
    shown, watched = io.StringIO(), threading.Event()
    with os.fdopen(reading) as program, os.fdopen(writing, "w", buffering=1) as keys:
        person = tours.Person(Console(file=shown, width=40), program)

        def watch() -> str:
            if not watched.is_set():
                watched.set()
                keys.write("\n")
            return "a table"

        person.wait("bend the elbow", watch)
        assert watched.is_set() and "bend the elbow; then press Enter" in shown.getvalue()
        line = "pose [3] of 12: " + 20 * "long "
        person.say(line)
        assert shown.getvalue().endswith(f"{line}\n")
        keys.close()
        with pytest.raises(DataError, match="standard input"):
            person.wait("bow")


def test_lines_of_the_calibrator_are_followed_and_observations_are_kept(tmp_path):
    record, said, tour = tmp_path / "new.jsonl", list[str](), tours.LiveTour()
    values = {"theta": [0.0] * 4, "direction": [0, 0, 1], "effort": [1.0] * 4, "friction": [0.1] * 4}
    values |= {"spread": [0.01] * 4, "load_mass": 0.0, "load_lever": 0.0, "speed": 0.1}
    for event in ({"progress": "pose 1"}, {"observation": values}, {"trouble": "elbow: a hand"}, {"done": True}):
        tour.follow(json.dumps(event), record, said.append)
    tour.follow('{"half": ', record, said.append)
    assert said == ["pose 1"] and tour.trouble == "elbow: a hand" and tour.done
    assert tour.measured[0].speed == 0.1 and json.loads(record.read_text())["observation"] == values
    with pytest.raises(DataError, match=r"elbow: a hand; what was measured is kept in .*new.jsonl"):
        tour.complete(record)
    tour.follow(json.dumps({"observation": values}), Path("/dev/full"), said.append)
    assert len(tour.measured) == 2 and said[1] == "pose 2 is used, but is missing in /dev/full: No space left on device"


def test_no_tour_begins_on_an_arm_that_a_running_bridge_may_carry(tmp_path, monkeypatch):
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))
    channel = f"tour{os.getpid()}"
    bridge = load(CONFIG / "sim.yaml")[BRIDGE]
    lock = bus_lock.BusLock(("virtual", channel, can_options(bridge)), "/right/can_bridge (PID 7)")
    nodes = {BRIDGE: {**bridge, "can.interface": "virtual", "can.channel": channel}}
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(BusError, match=r"held by /right/can_bridge \(PID 7\)"):
        tours.run_tour(argparse.Namespace(output=tmp_path / "new.yaml", record=None), nodes, print)
    assert signal.getsignal(signal.SIGINT) is before
    lock.release()
