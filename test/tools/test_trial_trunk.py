"""An arm with little friction stays where it is while its wearer bows and walks, in trials without ROS."""

from __future__ import annotations

import math

import pytest

from ..support.trunk_trial import moved, trunk_trial

BOW = {"bow": math.radians(30.0), "over": 3.0}
WALK, SHORT_WALK = {"walk": 6.0}, {"walk": 4.0}


@pytest.mark.parametrize(
    ("step", "limit"), [(BOW, 2.0), pytest.param(WALK, 3.0, marks=pytest.mark.thorough)], ids=["bow", "walk"]
)
def test_the_arm_stays_where_it_is_if_the_trunks_acceleration_is_compensated(step, limit):
    trial = trunk_trial(step, {"hold": 1.0}, inertial=True)
    assert moved(trial.run(), ("bow", "walk")) < limit
    assert trial.trouble == ""


@pytest.mark.thorough
def test_the_arm_stays_where_it_is_in_a_bow_even_if_only_its_tilt_is_compensated():
    assert moved(trunk_trial(BOW, {"hold": 1.0}).run(), ("bow",)) < 2.0


@pytest.mark.thorough
def test_walking_shakes_an_arm_of_which_only_the_tilt_is_compensated():
    assert moved(trunk_trial(SHORT_WALK).run(), ("walk",)) > 5.0
