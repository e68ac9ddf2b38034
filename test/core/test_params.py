"""The compensator's parameters as settings: every value is either applied or rejected with a message."""

import math
import random
from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.guidance import LONGEST_STEP
from exo_gravity.core.compensation.settings import COMPENSATOR, settings_of, urdf_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import GONE, values_of
from exo_gravity.lab.inputs.parameter_file import load

LIVE = [param for param in COMPENSATOR if not param.fixed]
WRONG = (-0.1, math.nan, math.inf, 900.0, "", "heavy", True, None, [], [0.1] * 3, [0.1] * 5, [0.1, math.nan, 0.1, 0.1])
WRONG += ([0.0, 0.0, 0.31, 0.0], [0.1, -1e-9, 0.1, 0.1], [1e308] * 4, ["0.1"] * 4, b"0.1", {}, 1e308)


def possible(param, rng):
    """Draw a value within the bounds of the parameter."""
    if param.choices:
        return rng.choice(param.choices)
    if not param.bounds:
        return param.default
    low, high = param.bounds
    low, high = (5.0, 10.0) if param.name == "gravity" else (low, high)  # m/s^2, which go with any gain
    high = high * rng.choice([1.0, 0.1]) if low == 0.0 else high
    if isinstance(param.default, list):
        return [rng.uniform(low, high) for _ in param.default]
    return rng.choice([low, rng.uniform(low, high)])


def test_hundreds_of_valid_and_invalid_changes_are_applied_or_rejected_and_never_step_the_torque():
    rng = random.Random(7)
    values = values_of(COMPENSATOR, {"use_imu": False})
    compensator = Compensator(settings_of(values))
    now, last, refused, moved = 100.0, np.zeros(4), 0, 0.0
    for _ in range(300):
        changed = {p.name: possible(p, rng) for p in rng.sample(LIVE, rng.choice([1, 1, 2, 5]))}
        if rng.random() < 0.4:
            changed[rng.choice([*LIVE]).name if rng.random() < 0.9 else "suport"] = rng.choice(WRONG)
        try:
            checked = values_of(COMPENSATOR, {**values, **changed})
            compensator.apply(settings_of(checked))
            values = checked
        except ParameterError as error:
            assert len(str(error).split()) > 4
            refused += 1
        theta = [rng.uniform(-1.5, 1.5) for _ in range(4)]
        for _ in range(rng.randrange(8)):
            period = rng.choice([0.001, 0.002, 0.004, 0.009, 0.011, 0.03, 0.045])  # late ones too
            now += period
            effort = np.array(compensator.step(now, theta).effort)
            step = np.abs(effort - last).max()
            assert step <= values["max_effort_rate"] * min(period, LONGEST_STEP) * (1 + 1e-9)
            last, moved = effort, moved + step
    assert 90 < refused < 210
    assert moved > 100.0  # Nm; the torque followed the changes


@pytest.mark.parametrize(
    "name", ["use_sim_time", "start_type_description_service", "qos_overrides./tf.publisher.depth"]
)
def test_parameters_that_ros_declares_on_every_node_are_ignored(name):
    assert name not in values_of(COMPENSATOR, {name: True})


def test_a_list_of_whole_and_other_numbers_which_ros_cannot_load_is_refused_by_name(tmp_path: Path):
    path = tmp_path / "params.yaml"
    path.write_text("/right/compensator: {ros__parameters: {robot: {mass: [0.6, 1, 0.6, 0.2]}}}")
    with pytest.raises(ParameterError, match=r"robot.mass = \[0.6, 1, 0.6, 0.2\]: must be a list of one type"):
        load(path)


def test_the_wearers_arm_follows_from_the_body_mass():
    wearer = {"wearer.body_mass": 75.0, "mode": "zero_g"}
    assert settings_of(values_of(COMPENSATOR, wearer)).arm.total_mass == pytest.approx(5.559, abs=1e-3)
    half = values_of(COMPENSATOR, {**wearer, "support": 0.5})
    assert settings_of(half).arm.total_mass == pytest.approx(3.707, abs=1e-3)


def test_a_parameter_that_is_gone_is_refused_with_what_replaces_it():
    with pytest.raises(ParameterError, match=r"^limits.lower = .*it is gone: limits.range"):
        values_of(COMPENSATOR, {"limits.lower": [0.0] * 4})
    names = {param.name for param in (*COMPENSATOR, *urdf_table(4, ["command_interface"]))}
    assert len(COMPENSATOR) <= 35  # each of them has users
    assert names & set(GONE) == {"max_effort_rate"}  # gone from can_bridge only


def test_first_moments_replace_masses_and_centres_of_gravity():
    plain = settings_of(values_of(COMPENSATOR, {"robot.moments": [0.0] * 5 + [0.01, 0.0, 0.0]})).robot
    given = {"robot.moments": [*plain.first_moment, 0.0, 0.01, 0.0, 0.0]}
    moments = settings_of(values_of(COMPENSATOR, {**given, "robot.mass": [9.0] * 4})).robot
    assert moments.by_moments and not plain.by_moments
    assert (moments.first_moment, moments.off_axis) == (plain.first_moment, plain.off_axis)
    assert moments.off_axis == (0.0, 0.01, 0.0, 0.0)


@pytest.mark.parametrize("law", ["paper_static", "paper_mobile"])
@pytest.mark.parametrize("moments", [(0.1, 0.2, 0.2, 0.03, *[0.0] * 4), (*[0.0] * 4, 0.1, 0.2, 0.2, 0.03)])
def test_a_law_that_needs_masses_refuses_moments(law, moments):
    values = values_of(COMPENSATOR, {"robot.moments": list(moments), "law": law})
    with pytest.raises(ParameterError, match=rf"robot.moments = .*must be 0 for law {law}"):
        settings_of(values)


def test_moments_that_only_too_heavy_an_arm_can_have_are_refused():
    values = values_of(COMPENSATOR, {"robot.moments": [0.1, 0.2, 6.0, 0.03, *[0.0] * 4]})
    with pytest.raises(ParameterError, match=r"total mass in kg = 20.0: must be at most 10 "):
        settings_of(values)
