# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The files of other arms that come with the package: carried without ROS, and judged by the device."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.drive import State
from exo_gravity.lab.inputs.arms import carried_arm, read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.trial.from_file import simulated_trials
from exo_gravity.lab.trial.scripted import read_script
from exo_gravity.sim.script import TrialScript

from ..support.thorough import quick
from ..support.urdf_oracle import MujocoArm

POSES = {
    "elbow": [1.2],
    "three_joints": [0.6, 0.5, 0.8],
    "seven_joints": [0.5, 0.5, 0.3, 0.8, 0.2, 0.3, -0.2],
}
HELD = 0.05  # rad that a joint may turn while nobody touches the arm
FRICTION = 0.1  # Nm: the torque command has codes, and the trial's efforts those of the motors' replies


def script_to(pose: list[float]) -> TrialScript:
    return TrialScript.parse({"name": "raise", "steps": [{"move": pose, "over": 3.0}, {"hold": 3.0}]})


@pytest.mark.parametrize("name", quick(["three_joints"], POSES))
def test_an_arm_that_ships_is_raised_by_its_wearer_and_stays(name: str) -> None:
    params, script = packaged_config(f"{name}.yaml"), script_to(POSES[name])
    (trial,) = simulated_trials(params, script)
    held: list[list[float]] = []

    def look(now: float) -> bool:
        if trial.safety.state is State.ACTIVE:
            held.append(trial.arm.device.arm.positions)
        return False

    recording = trial.run(look)
    assert not trial.trouble and not trial.events
    released = next(step.start for step in recording.steps if step.action == "hold")
    during = (recording.time > released + 0.5) & (recording.time < released + 2.9)
    positions, commands = recording.position[during], recording.command[during]
    assert np.ptp(positions, axis=0).max() < HELD
    assert np.abs(positions[0] - POSES[name]).max() < 0.2
    arm = carried_arm(load(params), "/right")
    text = Path(packaged_config(f"arms/{name}.urdf")).read_text(encoding="utf-8")
    oracle = MujocoArm(text, arm.limits.joint_names)
    needed = oracle.torque(positions[-1], (0.0, 0.0, -9.80665))
    assert np.abs(commands[-1] - needed).max() < 1e-9
    assert np.abs(recording.effort[during][-1] - needed).max() < FRICTION
    assert not trial.arm.device.powered


def test_the_script_that_ships_bends_the_elbow() -> None:
    (trial,) = simulated_trials(packaged_config("elbow.yaml"), read_script("elbow")[1])
    assert trial.run().position.max() > 1.1 and not trial.trouble


def test_a_script_for_another_number_of_joints_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"steps\[0\]\.move = .*: must be 3 numbers, one per joint"):
        simulated_trials(packaged_config("three_joints.yaml"), script_to([0.1, 0.2]))


def test_a_tool_for_the_papers_arm_refuses_another_one_and_says_why() -> None:
    with pytest.raises(
        ParameterError, match=r"/right/compensator law = 'urdf': must be exact: this is for the paper's arm"
    ):
        read_arm(load(packaged_config("elbow.yaml")), "/right")


def test_the_elbow_is_complete_in_forty_lines() -> None:
    lines = packaged_config("elbow.yaml").read_text(encoding="utf-8").splitlines()
    assert sum(bool(line) and not line.startswith("#") for line in lines) <= 40
