# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""ArmModel rejects invalid values by name, and adds a wearer's mass correctly."""

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.errors import ParameterError

LENGTH, COG, MASS = (0.05, 0.13, 0.30, 0.30), (0.02, 0.05, 0.1, 0.2), (0.5, 0.4, 0.6, 0.2)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("length", (0.05, 0.13, 0.30)),
        ("length", (50, 130, 300, 300)),
        ("cog", (0.06, 0.05, 0.1, 0.2)),
        ("cog", (0.02, 0.05, float("nan"), 0.2)),
        ("mass", (0.5, 0.4, 900.0, 0.2)),
        ("mass", (0.5, 0.4, -0.1, 0.2)),
        ("mass", "heavy"),
        ("gain", (1.0, 1.0, 1.0, -1.0)),
        ("gravity", float("inf")),
        ("gravity", None),
    ],
)
def test_an_impossible_value_is_rejected_by_name(field, value):
    good = {"length": LENGTH, "cog": COG, "mass": MASS}
    with pytest.raises(ParameterError) as caught:
        ArmModel(**{**good, field: value})
    assert caught.value.name == field
    assert str(caught.value).startswith(f"{field} = ")


def test_a_model_cannot_be_changed():
    arm = ArmModel(LENGTH, COG, MASS)
    with pytest.raises(ValueError, match="read-only"):
        arm.mass[0] = 2.0
    with pytest.raises(AttributeError):
        arm.gravity = 1.0


def test_a_model_does_not_follow_changes_of_the_array_it_was_made_from():
    mass = np.array(MASS)
    arm = ArmModel(LENGTH, COG, mass)
    mass[0] = 9.0
    assert arm.mass[0] == MASS[0]


def test_arms_with_equal_values_are_equal_and_have_the_same_hash():
    assert ArmModel(LENGTH, COG, MASS) == ArmModel(list(LENGTH), list(COG), list(MASS))
    assert hash(ArmModel(LENGTH, COG, MASS)) == hash(ArmModel(LENGTH, COG, MASS))
    assert ArmModel(LENGTH, COG, MASS) != ArmModel(LENGTH, COG, MASS, gravity=9.8)


def test_a_wearer_adds_mass_and_first_moment_in_proportion_to_the_support():
    arm = ArmModel(LENGTH, COG, MASS)
    worn = arm.with_wearer((0, 0, 2.0, 1.5), (0, 0, 0.16, 0.18), support=0.5)
    assert worn.total_mass == pytest.approx(arm.total_mass + 1.75)
    np.testing.assert_allclose(worn.mass * worn.cog, arm.mass * arm.cog + [0, 0, 0.16, 0.135])


def test_a_massless_link_can_carry_a_wearer():
    arm = ArmModel(LENGTH, COG, (0.5, 0.4, 0.0, 0.0)).with_wearer((0, 0, 2.0, 0), (0, 0, 0.16, 0))
    assert arm.cog[2] == pytest.approx(0.16)


MOMENTS, OFF_AXIS = (0.05, 0.2, 0.2, 0.04), (0.01, -0.02, 0.003, 0.002)


def by_moments(**changes):
    return ArmModel.from_moments(**{"length": LENGTH, "first_moment": MOMENTS, "off_axis": OFF_AXIS, **changes})


def test_an_arm_given_by_the_moments_of_another_has_the_same_torque():
    arm = ArmModel(LENGTH, COG, MASS, (1.0, 0.9, 1.1, 1.0), 9.8, OFF_AXIS)
    same = ArmModel.from_moments(LENGTH, arm.first_moment, OFF_AXIS, arm.gain, arm.gravity)
    theta, direction = (0.3, 0.8, 0.7, 0.6), (0.6, 0.0, 0.8)
    assert gravity_torque(same, theta, direction).tolist() == gravity_torque(arm, theta, direction).tolist()
    assert same.by_moments and not arm.by_moments and same != arm


def test_a_wearer_adds_the_same_moments_to_an_arm_given_by_its_moments():
    arm = ArmModel(LENGTH, COG, MASS, off_axis=OFF_AXIS)
    worn, same = (
        one.with_wearer((0, 0, 2.0, 1.5), (0, 0, 0.16, 0.18), 0.5)
        for one in (arm, ArmModel.from_moments(LENGTH, arm.first_moment, OFF_AXIS))
    )
    np.testing.assert_allclose(same.first_moment, worn.first_moment, rtol=1e-12)
    assert same.off_axis == worn.off_axis == OFF_AXIS


def test_an_arm_given_by_its_moments_weighs_at_least_what_its_links_need_for_them():
    assert by_moments().total_mass == pytest.approx(0.2 / 0.13)
    assert by_moments(length=(0.0, 0.0, 0.3, 0.3)).total_mass == pytest.approx(0.2 / 0.3)


def test_arms_given_by_moments_are_equal_if_their_moments_are():
    assert by_moments() == by_moments() and hash(by_moments()) == hash(by_moments())
    assert by_moments() != by_moments(off_axis=(0.01, -0.02, 0.003, 0.0))
    assert ArmModel(LENGTH, COG, MASS) != ArmModel(LENGTH, COG, MASS, off_axis=OFF_AXIS)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("first_moment", (50, 200, 200, 40)),
        ("first_moment", (0.05, 0.2, 0.2, -0.04)),
        ("first_moment", (0.05, 0.2, 0.2, float("nan"))),
        ("off_axis", (0.01, -0.02, 0.003)),
        ("off_axis", (0.01, -20.0, 0.003, 0.0)),
    ],
)
def test_an_impossible_moment_is_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        by_moments(**{field: value})
    assert caught.value.name == field


@pytest.mark.parametrize(
    ("arm", "reason"),
    [
        (by_moments(off_axis=(0,) * 4), "which needs mass and cog"),
        (ArmModel(LENGTH, COG, MASS, off_axis=OFF_AXIS), "which knows no moments across links"),
    ],
)
def test_the_papers_laws_refuse_an_arm_without_masses_or_with_moments_across_its_links(arm, reason):
    for law in (lambda: paper_static_torque(arm, (0.0,) * 4), lambda: paper_mobile_torque(arm, (0.0,) * 4, 0.0, 0.0)):
        with pytest.raises(ParameterError, match=rf"robot.(first_moment|off_axis) = .*must be 0 for paper_.*{reason}"):
            law()
