# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's arm, against torques worked out from the two tables and against its single segments."""

import math

import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.wearer import SEX, TABLES, Wearer
from exo_gravity.core.errors import ParameterError

LENGTHS = (0.28, 0.27, 0.086)
LINKS = (0.05, 0.13, 0.28, 0.30)  # link 3 is as long as the upper arm, so that the elbows coincide


def worn(wearer, links=LINKS):
    """The wearer's arm on a massless robot."""
    return ArmModel(links, (0, 0, 0, 0), (0, 0, 0, 0)).with_wearer(*wearer.on_links(links))


@pytest.mark.parametrize(
    ("table", "shoulder", "elbow", "mass"), [("de_leva", 10.8, 2.99, 3.70), ("winter", 9.8, 2.75, 3.75)]
)
def test_a_75_kg_mans_straight_horizontal_arm_needs_the_torques_worked_out_by_hand(table, shoulder, elbow, mass):
    arm = worn(Wearer(75.0, "male", table, LENGTHS))
    torque = gravity_torque(arm, (0, 0, math.pi / 2, 0))
    assert torque[2] == pytest.approx(shoulder, abs=0.05)
    assert torque[3] == pytest.approx(elbow, abs=0.005)
    assert arm.total_mass == pytest.approx(mass, abs=0.01)


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("sex", SEX)
def test_the_links_carry_the_mass_and_the_first_moment_of_their_segments(table, sex):
    wearer = Wearer(60.0, sex, table, LENGTHS)
    mass, cog = wearer.on_links(LINKS)
    (upper, upper_cog), (forearm, forearm_cog), (hand, hand_cog) = wearer.segments
    assert mass == pytest.approx((0, 0, upper, forearm + hand))
    assert mass * cog == pytest.approx((0, 0, upper * upper_cog, forearm * forearm_cog + hand * (0.27 + hand_cog)))


def test_a_womans_arm_is_lighter_than_a_mans_at_the_same_body_mass():
    assert worn(Wearer(70.0, "female")).total_mass < worn(Wearer(70.0, "male")).total_mass


def test_twice_the_body_mass_needs_twice_the_torque():
    one, two = (gravity_torque(worn(Wearer(mass)), (0.1, 0.2, 0.8, 0.4)) for mass in (40.0, 80.0))
    assert two == pytest.approx(2 * one)


@pytest.mark.parametrize(
    ("links", "words"), [((0.05, 0.13, 0.15, 0.30), "upper arm"), ((0.05, 0.13, 0.30, 0.15), "forearm and hand")]
)
def test_a_centre_of_gravity_beyond_its_link_is_rejected_with_the_segments_name(links, words):
    with pytest.raises(ParameterError, match=rf"link_length.*{words}.*beyond link"):
        Wearer(75.0).on_links(links)


def test_a_forearm_in_several_links_has_forearm_and_hand_each_at_their_own_place():
    wearer, short = Wearer(75.0, "male", "de_leva", LENGTHS), (0.06, 0.1, 0.18, 0.09, 0.15, 0.04, 0.1)
    mass, cog = wearer.on_links(short, (3, 4))
    (upper, upper_cog), (forearm, forearm_cog), (hand, hand_cog) = wearer.segments
    assert mass == pytest.approx((0, 0, upper, 0, forearm, 0, hand))
    assert cog == pytest.approx((0, 0, upper_cog, 0, forearm_cog - 0.09, 0, 0.27 + hand_cog - 0.28))
    with pytest.raises(ParameterError, match=r"upper arm is at 0\.162 m, beyond link 3"):  # link 4 is the forearm's
        wearer.on_links((0.06, 0.1, 0.15, 0.09, 0.15, 0.04, 0.1), (3, 4))
    with pytest.raises(ParameterError, match=r"forearm and hand is at 0\.338 m, beyond link 5"):
        wearer.on_links(short[:5], (3, 4))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("body_mass", (math.nan,)),
        ("body_mass", (75_000,)),
        ("body_mass", ("heavy",)),
        ("sex", (75, "other")),
        ("table", (75, "male", "dempster")),
        ("segment_length", (75, "male", "winter", (0.28, 0.27))),
        ("segment_length", (75, "male", "winter", (280, 270, 86))),
        ("segment_length", (75, "male", "winter", 0.28)),
        ("segment_length", (75, "male", "winter", (0.28, math.nan, 0.086))),
    ],
)
def test_an_impossible_wearer_is_rejected_by_name(name, arguments):
    with pytest.raises(ParameterError, match=name):
        Wearer(*arguments)
