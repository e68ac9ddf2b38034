"""trial's scripts and criteria: the packaged trials, who performs them, and what counts as a hold."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from exo_gravity.bag.content import Bag
from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.tools.reporting import trial_report
from exo_gravity.tools.trial import criteria_for, missing_holds, read_script, shortest_hold
from exo_gravity.tools.trials.run import is_guided

from ..support import synthetic_bags as made

CONFIG = Path(__file__).parents[2] / "config"
RATED = (3.0, 9.0, 3.0, 3.0)  # Nm


@pytest.mark.parametrize("name", ["bow_and_walk", "demo", "two_poses", "thirteen_poses"])
def test_a_packaged_trial_stays_within_rated_torque_and_clear_of_the_joint_limits(name):
    _, script = read_script(name)
    values = yaml.safe_load((CONFIG / "exo.yaml").read_text())
    bridge, robot = (values[f"/right/{node}"]["ros__parameters"] for node in ("can_bridge", "compensator"))
    poses = np.array([step.value for step in script.steps if step.action == "move"])
    assert np.all(poses > np.array(bridge["position_min"]) + 0.15)
    assert np.all(poses < np.array(bridge["position_max"]) - 0.15)
    arm = ArmModel(robot["link_length"], robot["robot"]["cog"], robot["robot"]["mass"])
    for pitch, roll in itertools.product((-0.35, 0.0, 0.35), repeat=2):  # 20 degrees
        torque = gravity_torque(arm, poses, Tilt.of("right", pitch, roll).direction)
        assert np.all(np.abs(torque) < RATED)


def test_the_second_trial_has_thirteen_different_poses_of_a_minute_each():
    _, script = read_script("thirteen_poses")
    poses = {step.value for step in script.steps if step.action == "move"}
    assert len(poses) == 13
    assert [step.duration for step in script.steps if step.action == "hold"] == [60.0] * 13


def test_the_push_of_the_first_trial_lasts_from_17_to_20_s():
    _, script = read_script("two_poses")
    actions = [script.steps[script.at(time)[0]].action for time in (16.9, 17.1, 19.9, 20.1)]
    assert actions == ["hold", "push", "push", "hold"]


def test_an_unknown_name_is_answered_with_the_packaged_trials():
    with pytest.raises(ParameterError) as caught:
        read_script("nosuch")
    assert str(caught.value) == (
        "trial = 'nosuch': must be bow_and_walk, demo, thirteen_poses, two_poses or a YAML file with a script"
    )


def test_only_holds_of_a_minute_are_judged_by_their_rate_unless_the_user_sets_one():
    _, demo = read_script("demo")
    _, thirteen_poses = read_script("thirteen_poses")
    assert criteria_for(demo, None).max_rate == math.inf
    assert criteria_for(thirteen_poses, None).max_rate == pytest.approx(math.radians(0.2) / 60)
    assert criteria_for(demo, 1.0).max_rate == pytest.approx(math.radians(1.0) / 60)


def report_with(holds: int) -> trial_report.Report:
    """Return the report of a recording without a script, of one arm with that many holds."""
    recording = made.trial([[0.1 * n] * 4 for n in range(holds)], hold=4.0, rate=100.0)
    unscripted = dataclasses.replace(recording, steps=(), carried=((0.0, recording.time[-1]),))
    return trial_report.analyse(Bag(Path("bag"), 0, (unscripted,), (), {}, (), ()))


def test_a_hold_in_which_a_real_arm_never_came_to_rest_is_missing():
    steps = [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 4.0}]
    script = TrialScript.parse({"name": "two", "steps": steps * 2})
    assert missing_holds(script, report_with(holds=2)) == ""
    assert missing_holds(script, report_with(holds=1)) == "right: 1 of 2 holds were found"


def test_a_moment_in_which_a_person_holds_the_arm_still_is_not_a_hold():
    script = TrialScript.parse({"name": "p", "steps": [{"hold": 60.0}, {"hold": 14.0}]})
    assert shortest_hold(script, guided=True) == 7.0
    assert shortest_hold(script, guided=False) == 2.0


def test_a_trial_is_guided_unless_a_simulator_performs_it():
    assert is_guided(CONFIG / "exo.yaml") and not is_guided(CONFIG / "sim_both.yaml")
