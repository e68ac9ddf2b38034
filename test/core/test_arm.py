# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms by their masses or by their moments, with a wearer and a load in the hand; against Pinocchio and MuJoCo."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.arm.wearer import SEX, TABLES, Wearer
from exo_gravity.core.compensation.guidance import DropWatch
from exo_gravity.sim import SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..support.compensator_run import THETA, CompensatorRun, settings_with
from .test_gravity_oracles import random_arm, random_directions, random_poses
from .test_kinematics import ROUNDING, with_moments_across, with_rods

LENGTH, COG, MASS = (0.05, 0.13, 0.30, 0.30), (0.02, 0.05, 0.1, 0.2), (0.5, 0.4, 0.6, 0.2)


def test_a_model_cannot_be_changed_and_does_not_follow_the_array_that_it_was_made_from():
    mass = np.array(MASS)
    arm = ArmModel(LENGTH, COG, mass)
    mass[0] = 9.0
    assert arm.mass[0] == MASS[0]
    with pytest.raises(ValueError, match="read-only"):
        arm.mass[0] = 2.0
    with pytest.raises(AttributeError):
        arm.gravity = 1.0


def test_arms_with_equal_values_are_equal_and_have_the_same_hash():
    for one, same in (
        (ArmModel(LENGTH, COG, MASS), ArmModel(list(LENGTH), list(COG), list(MASS))),
        (by_moments(),) * 2,
    ):
        assert one == same and hash(one) == hash(same)
    assert by_moments() == by_moments() != by_moments(off_axis=(0.01, -0.02, 0.003, 0.0))
    for other in (ArmModel(LENGTH, COG, MASS, gravity=9.8), ArmModel(LENGTH, COG, MASS, off_axis=OFF_AXIS)):
        assert ArmModel(LENGTH, COG, MASS) != other


def test_a_wearer_adds_mass_and_first_moment_in_proportion_to_the_support():
    arm = ArmModel(LENGTH, COG, MASS)
    worn = arm.with_wearer((0, 0, 2.0, 1.5), (0, 0, 0.16, 0.18), support=0.5)
    assert worn.total_mass == pytest.approx(arm.total_mass + 1.75)
    np.testing.assert_allclose(worn.mass * worn.cog, arm.mass * arm.cog + [0, 0, 0.16, 0.135])
    massless = ArmModel(LENGTH, COG, (0.5, 0.4, 0.0, 0.0)).with_wearer((0, 0, 2.0, 0), (0, 0, 0.16, 0))
    assert massless.cog[2] == pytest.approx(0.16)


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


TINY = 1e-12  # Nm


def test_centres_of_gravity_off_the_links_axes_agree_with_pinocchio():
    rng = np.random.default_rng(3)
    for _ in range(5):
        bare, beside = random_arm(rng), rng.uniform(-0.05, 0.05, (4, 2))
        arm, (pin, model, data) = with_moments_across(bare, beside), with_rods(bare, beside)
        for pose, down in zip(random_poses(rng, 50), random_directions(rng, 50), strict=True):
            model.gravity.linear = arm.gravity * down
            expected = pin.computeGeneralizedGravity(model, data, pose)
            np.testing.assert_allclose(gravity_torque(arm, pose, down), expected, atol=TINY)


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


def test_a_womans_arm_is_lighter_than_a_mans_at_the_same_body_mass_and_twice_the_mass_needs_twice_the_torque():
    assert worn(Wearer(70.0, "female")).total_mass < worn(Wearer(70.0, "male")).total_mass
    one, two = (gravity_torque(worn(Wearer(mass)), (0.1, 0.2, 0.8, 0.4)) for mass in (40.0, 80.0))
    assert two == pytest.approx(2 * one)


def test_a_forearm_in_several_links_has_forearm_and_hand_each_at_their_own_place():
    wearer, short = Wearer(75.0, "male", "de_leva", LENGTHS), (0.06, 0.1, 0.18, 0.09, 0.15, 0.04, 0.1)
    mass, cog = wearer.on_links(short, (3, 4))
    (upper, upper_cog), (forearm, forearm_cog), (hand, hand_cog) = wearer.segments
    assert mass == pytest.approx((0, 0, upper, 0, forearm, 0, hand))
    assert cog == pytest.approx((0, 0, upper_cog, 0, forearm_cog - 0.09, 0, 0.27 + hand_cog - 0.28))


LOAD = Wearer(75.0).on_links(DEFAULT_LINKS.length)


def test_the_gravity_torque_of_an_arm_with_a_load_agrees_with_mujoco():
    rng, arm = np.random.default_rng(1), SimulatedArm()
    for _ in range(50):
        mass, cog, direction = rng.uniform(0.0, 5.0), rng.uniform(-0.3, 0.3, 3), rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        theta = rng.uniform(-1.5, 1.5, 4)
        arm.carry(mass, cog.tolist())
        arm.move_base((DEFAULT_LINKS.gravity * direction).tolist())
        arm.reset(theta)
        mujoco.mj_forward(arm.model, arm.data)
        expected = gravity_torque(DEFAULT_LINKS.with_payload(mass, cog), theta, direction)
        assert arm.data.qfrc_bias == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("by_moments", [False, True])
def test_the_mass_matrix_gets_that_of_a_point_of_mass_as_pinocchio_computes_it(by_moments):
    rng = np.random.default_rng(2)
    for _ in range(5):
        arm = random_arm(rng)
        pin, model, _ = with_rods(arm)
        mass, x = rng.uniform(0.1, 5.0), rng.uniform(-0.1, 0.3)
        known = ArmModel.from_moments(arm.length, arm.first_moment) if by_moments else arm
        bare = model.copy()
        at = pin.SE3(np.eye(3), np.array((arm.length[3] + x, 0.0, 0.0)))
        model.appendBodyToJoint(4, pin.Inertia(mass, np.zeros(3), np.zeros((3, 3))), at)
        loaded, before = known.with_payload(mass, (x, 0.0, 0.0)).links, known.links
        for theta in rng.uniform(-3.0, 3.0, (5, 4)):
            added = [np.triu(pin.crba(each, each.createData(), theta)) for each in (model, bare)]
            assert np.triu(loaded.matrix(theta) - before.matrix(theta)) == pytest.approx(
                added[0] - added[1], abs=ROUNDING
            )


def test_a_load_and_a_wearer_add_up_in_any_order_and_the_load_is_carried_in_full():
    load = 1.5, (0.05, 0.01, -0.02)
    for arm in (DEFAULT_LINKS, ArmModel.from_moments(DEFAULT_LINKS.length, DEFAULT_LINKS.first_moment)):
        one = arm.with_payload(*load).with_wearer(LOAD.mass, LOAD.cog, 0.4)
        other = arm.with_wearer(LOAD.mass, LOAD.cog, 0.4).with_payload(*load)
        assert one.moments == pytest.approx(other.moments)
        assert one.with_payload(0.0).moments == pytest.approx(arm.with_wearer(LOAD.mass, LOAD.cog, 0.4).moments)
    alone = DEFAULT_LINKS.with_payload(*load).moments - DEFAULT_LINKS.moments
    for mode, support in (("one_g", 1.0), ("zero_g", 0.0), ("zero_g", 0.3), ("zero_g", 1.0)):
        loads = ((load[0], load[1]), (0.0, load[1]))
        given, without = (
            settings_with(mode=mode, support=support, payload=Payload(mass, cog)).arm for mass, cog in loads
        )
        assert given.moments - without.moments == pytest.approx(alone)
        assert given.total_mass - without.total_mass == pytest.approx(load[0])


def speeds(acceleration: float, top: float, period: float = 0.01) -> bool:
    """Return whether a load is seen as dropped while the hand speeds up to `top` m/s, and stays so fast."""
    watch = DropWatch()
    up = [min(top, acceleration * period * n) for n in range(100)]
    return max(watch.step(period, speed, 1.0) for speed in up)


def test_a_dropped_load_is_known_by_the_hands_acceleration_and_a_light_one_by_its_speed():
    assert speeds(20.0, 0.6)
    assert speeds(3.0, 0.9)
    assert not speeds(3.0, 0.75)
    assert not speeds(5.0, 0.5)
    falling = DropWatch()
    assert not max(falling.step(0.01, -0.2 * n, 1.0) for n in range(20))


def test_the_lifting_of_a_load_is_no_drop():
    rise = 0.4  # m/s of the hand
    run = CompensatorRun(payload=Payload(2.0))
    run.cycle(1.5)
    per_mass = gravity_torque(
        ArmModel.from_moments(DEFAULT_LINKS.length, (0.0,) * 4, gravity=1.0).with_payload(1.0), THETA
    )
    velocity = per_mass * rise / (per_mass @ per_mass)
    for share in np.linspace(0.0, 1.0, 100):  # in 0.2 s
        run.cycle(velocity=(share * velocity).tolist())
    run.cycle(0.2, velocity=velocity.tolist())
    fast = (2.5 * velocity).tolist()
    run.compensator.applied = (0.0,) * 4  # motors that are off carry nothing
    run.cycle(0.1, velocity=fast)
    assert run.compensator.dropped == 0.0
    run.compensator.applied = run.efforts[-1]
    run.cycle(0.1, velocity=fast)
    assert run.compensator.dropped == 2.0
    assert math.isclose(run.compensator.settings.arm.total_mass, settings_with().arm.total_mass)
