# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The files of a47959f4 work unchanged, except that a person confirms the pose: what docs/topics.md promises."""

from __future__ import annotations

import pytest
import yaml

from exo_gravity.core.compensation.settings import compensator_table
from exo_gravity.core.motors.joint_motor import OPTIONS
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, CONFIRM
from exo_gravity.core.trunk.params import IMU
from exo_gravity.lab.inputs.arms import configured_arms
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.trial.from_file import simulated_trials
from exo_gravity.sim.params import SIMULATOR
from exo_gravity.sim.script import TrialScript

from ..support import DATA
from ..support.thorough import quick

THEN = DATA / "a47959f4"
TABLES = {"can_bridge": CAN_BRIDGE, "imu": IMU, "simulator": SIMULATOR}
SHORT = TrialScript.parse({"name": "short", "steps": [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 2.0}]})


@pytest.mark.parametrize(("file", "arms"), [("exo", 2), ("sim", 1), ("sim_both", 2)])
def test_every_node_takes_its_parameters_and_every_arm_is_made_of_them(file: str, arms: int) -> None:
    nodes = load(THEN / f"{file}.yaml")
    for name, given in nodes.items():
        executable = name.rpartition("/")[2]
        table = compensator_table(given) if executable == "compensator" else TABLES[executable]
        values = values_of(table, given, OPTIONS)
        assert {key: values[key] for key in given if key in values} == {
            key: value for key, value in given.items() if not key.startswith(f"{OPTIONS}.")
        }
    found = configured_arms(THEN / f"{file}.yaml")
    assert len(found) == arms
    for arm in found:
        assert arm.settings().side == arm.side
        assert arm.can_bridge["start_pose"] == CONFIRM  # the one thing that is new to them


@pytest.mark.parametrize("file", quick(["sim"], ["sim", "sim_both"]))
def test_every_simulated_arm_is_carried_through_a_trial(file: str) -> None:
    for trial in simulated_trials(THEN / f"{file}.yaml", SHORT):
        recording = trial.run()
        assert trial.trouble == "" and recording.carried


def test_a_script_of_then_is_still_one() -> None:
    assert TrialScript.parse(yaml.safe_load((THEN / "home.yaml").read_text(encoding="utf-8"))).steps
