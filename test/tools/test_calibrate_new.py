# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate new: from a URDF and a list of motors to a file with which a simulated arm is carried."""

from __future__ import annotations

import math
import re

import pytest
import yaml

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.lab.calibration.new import turning_joints
from exo_gravity.lab.inputs.arms import carried_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.inputs.ros_yaml import dumped
from exo_gravity.lab.trial.from_file import simulated_trials
from exo_gravity.sim.script import TrialScript
from exo_gravity.tools.calibrate import main

from ..support.chains import random_chain

URDF = "package://exo_gravity/config/arms/three_joints.urdf"
ARM = ["--urdf", URDF, "--motors", "AK80-9", "AK80-9", "AK60-6", "--ids", "1", "2", "3", "--hand", "hand"]


def test_the_written_file_carries_the_arm_on_the_simulated_device(tmp_path, capsys):
    output = tmp_path / "arm.yaml"
    assert main(["new", *ARM, "--output", str(output)]) == 0
    assert "MEASURE in it marks" in capsys.readouterr().out
    content = yaml.safe_load(output.read_text())
    shipped = yaml.safe_load(packaged_config("three_joints.yaml").read_text())["/right/simulator"]["ros__parameters"]
    bus = content["/right/can_bridge"]["ros__parameters"]["can"]
    simulator = {**shipped, "can": {**bus}, "direction": [1, 1, 1], "zero": [0.0, 0.0, 0.0], "trial_delay": 3.0}
    content["/right/can_bridge"]["ros__parameters"]["sign_check_torque"] = 0.0
    output.write_text(dumped({**content, "/right/simulator": {"ros__parameters": simulator}}))
    script = TrialScript.parse({"name": "raise", "steps": [{"move": [0.6, 0.5, 0.8], "over": 3.0}, {"hold": 3.0}]})
    (trial,) = simulated_trials(output, script)
    recording = trial.run()
    assert not trial.trouble and recording.position.max() > 0.7


def test_limits_torques_and_where_the_arm_hangs_come_from_urdf_and_motors(tmp_path):
    output = tmp_path / "arm.yaml"
    assert main(["new", *ARM, "--side", "left", "--channel", "can1", "--output", str(output)]) == 0
    arm = carried_arm(load(output), "/left")
    assert arm.limits.position_max == (2.0, 2.4, 2.4) and arm.limits.max_effort == (9.0, 9.0, 3.0)
    assert arm.can_bridge["can.channel"] == "can1" and not arm.can_bridge["autostart"]
    torque, _ = arm.settings.torque(arm.limits.home, Tilt.of("left"))
    assert max(map(abs, torque)) < 0.01


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            ["--ids", "1", "2"],
            "motors and ids = .*: must be one motor and one ID for each of the joints abduction",
        ),
        (["--motors", "AK80-9", "AK80-9", "AK99"], "motors = 'AK99': must be one of AK10-9"),
        (["--urdf", "none.urdf"], "urdf.file = 'none.urdf': must be a URDF file"),
        (["--hand", "claw"], "urdf.hand = 'claw': must be a link of the URDF"),
        (["--ids", "1", "1", "2"], "can_id = .*: must be 3 different IDs"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(changes, problem, tmp_path, capsys):
    assert main(["new", *ARM, *changes, "--output", str(tmp_path / "arm.yaml")]) == 2
    assert re.search(problem, capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


LOWER, UPPER = 'lower="-0.1"', 'upper="2.4"'
CHANGED = {  # of the elbow's description: what is written instead, the exit code, and what is said
    "degrees": (
        {LOWER: 'lower="-10"', UPPER: 'upper="150"'},
        0,
        "-10 to 150 rad, are cut to ±3.1: are they in deg",
    ),
    "no room": ({LOWER: 'lower="0"', UPPER: 'upper="0"'}, 0, "elbow: its limits, 0 to 0 rad, leave no room"),
    "a formula": ({LOWER: 'lower="-pi/2"'}, 2, "limit lower of elbow = '-pi/2': must be a number of rad"),
    "the wrong way": ({LOWER: 'lower="3"'}, 2, "limits of elbow = [3.0, 2.4]"),
    "cut": ({"</robot>": ""}, 2, "must be well-formed XML"),
    "no joint that turns": ({"revolute": "prismatic"}, 2, "the joints (none of the URDF turns)"),
    **{name: ({'"elbow"': f"'{name}'"}, 0, "Written: ") for name in ("on", "a: [b]", "0x10", '"e"', "Arm für P01")},
}


@pytest.mark.parametrize(("changes", "code", "said"), CHANGED.values(), ids=CHANGED)
def test_a_doubtful_description_is_named_and_any_name_of_a_joint_is_written_as_it_is(
    changes, code, said, tmp_path, capsys
):
    text = packaged_config("arms/elbow.urdf").read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "my arm.urdf").write_text(text, encoding="utf-8")
    output = tmp_path / "arm.yaml"
    given = ["--urdf", str(tmp_path / "my arm.urdf"), "--motors", "AK80-64", "--ids", "1", "--channel", "can0"]
    assert main(["new", *given, "--output", str(output)]) == code
    printed = capsys.readouterr()
    assert said in printed.out + printed.err and output.exists() == (code == 0)
    if said == "Written: ":
        assert carried_arm(load(output), "/right").limits.joint_names == (changes['"elbow"'][1:-1],)


def test_every_turning_joint_that_follows_no_other_is_one_of_the_arms():
    text, names = random_chain(3, seed=1)
    assert list(turning_joints(text)) == names
    follower = text.replace(
        'name="joint_1" type="revolute">', 'name="joint_1" type="revolute"><mimic joint="joint_0"/>'
    )
    assert list(turning_joints(follower)) == [names[0], names[2]]
    free = turning_joints(text.replace('"revolute"', '"continuous"'))
    assert all(math.isclose(edge.high, 3.1) for edge in free.values())
