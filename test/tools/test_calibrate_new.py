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


def test_every_turning_joint_that_follows_no_other_is_one_of_the_arms():
    text, names = random_chain(3, seed=1)
    assert list(turning_joints(text)) == names
    follower = text.replace(
        'name="joint_1" type="revolute">', 'name="joint_1" type="revolute"><mimic joint="joint_0"/>'
    )
    assert list(turning_joints(follower)) == [names[0], names[2]]
    free = turning_joints(text.replace('"revolute"', '"continuous"'))
    assert all(math.isclose(edge.high, 3.1) for edge in free.values())
