"""ArmModel rejects invalid values by name, and adds a wearer's mass correctly."""

import numpy as np
import pytest

from exo_gravity.core import ArmModel
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


def test_with_support_0_a_wearer_changes_no_first_moment():
    arm = ArmModel(LENGTH, COG, MASS)
    worn = arm.with_wearer((0, 0, 2.0, 1.5), (0, 0, 0.16, 0.18), support=0.0)
    np.testing.assert_allclose(worn.first_moment, arm.first_moment, rtol=1e-15)


def test_a_massless_link_can_carry_a_wearer():
    arm = ArmModel(LENGTH, COG, (0.5, 0.4, 0.0, 0.0)).with_wearer((0, 0, 2.0, 0), (0, 0, 0.16, 0))
    assert arm.cog[2] == pytest.approx(0.16)
