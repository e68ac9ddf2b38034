# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms by their masses or by their moments, with a wearer and a load in the hand: gravity, inertia, laws.

Against Pinocchio, MuJoCo, the Robotics Toolbox, and the paper's equations copied by hand.
"""

import math
from math import cos, sin
from typing import Any

import mujoco
import numpy as np
import pytest

import exo_gravity.sim.arm
from exo_gravity.core import ArmModel, Tilt, gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.arm.chain import least_inertia
from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.arm.paper import mobile_torque, static_torque
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.load_change import DropWatch
from exo_gravity.lab.inputs.references import OFFSET, gravload, pinocchio, pinocchio_model
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS, in_base

from ..support.compensator_run import THETA, CompensatorRun, settings_with
from ..support.thorough import quick

LENGTH, COG, MASS = (0.05, 0.13, 0.30, 0.30), (0.02, 0.05, 0.1, 0.2), (0.5, 0.4, 0.6, 0.2)


def test_a_model_cannot_be_changed_nor_by_the_array_that_it_was_made_from_and_equals_one_of_equal_values():
    mass = np.array(MASS)
    arm = ArmModel(LENGTH, COG, mass)
    mass[0] = 9.0
    assert arm == ArmModel(list(LENGTH), list(COG), list(MASS)) and hash(arm) == hash(ArmModel(LENGTH, COG, MASS))
    others = ArmModel(LENGTH, COG, MASS, gravity=9.8), ArmModel(LENGTH, COG, MASS, off_axis=OFF_AXIS)
    assert arm not in others and by_moments() == by_moments() != by_moments(off_axis=(0.01, -0.02, 0.003, 0.0))
    with pytest.raises(ValueError, match="read-only"):
        arm.mass[0] = 2.0
    with pytest.raises(AttributeError):
        arm.gravity = 1.0


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


def test_an_arm_given_by_the_moments_of_another_has_the_same_torque_bare_and_worn():
    arm = ArmModel(LENGTH, COG, MASS, (1.0, 0.9, 1.1, 1.0), 9.8, OFF_AXIS)
    same = ArmModel.from_moments(LENGTH, arm.first_moment, OFF_AXIS, arm.gain, arm.gravity)
    assert same.by_moments and not arm.by_moments and same != arm
    for support in (0.0, 0.5):
        pair = (one.with_wearer((0, 0, 2.0, 1.5), (0, 0, 0.16, 0.18), support) for one in (arm, same))
        one, other = (gravity_torque(each, (0.3, 0.8, 0.7, 0.6), (0.6, 0.0, 0.8)) for each in pair)
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_an_arm_given_by_its_moments_weighs_at_least_what_its_links_need_for_them():
    assert by_moments().total_mass == pytest.approx(0.2 / 0.13)
    assert by_moments(length=(0.0, 0.0, 0.3, 0.3)).total_mass == pytest.approx(0.2 / 0.3)


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
    lighter = worn(Wearer(75.0, "female", table, LENGTHS)).total_mass < arm.total_mass
    assert lighter is (table == "de_leva")  # Winter has one table for both


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
    accelerations = ((20.0, 0.6), (3.0, 0.9), (3.0, 0.75), (5.0, 0.5))  # m/s^2, and m/s at most
    assert [speeds(*each) for each in accelerations] == [True, True, False, False]
    for none in ([-0.2 * n for n in range(20)], [0.0] * 50 + [3.0] + [0.0] * 50):  # it falls; one wrong velocity
        watch = DropWatch()
        assert not max(watch.step(0.01, speed, 1.0) for speed in none)


def test_the_lifting_of_a_load_is_no_drop():
    rise = 0.4  # m/s of the hand
    run = CompensatorRun(payload=Payload(2.0), mode="zero_g")
    run.cycle(1.5)
    per_mass = gravity_torque(
        ArmModel.from_moments(DEFAULT_LINKS.length, (0.0,) * 4, gravity=1.0).with_payload(1.0), THETA
    )
    velocity = per_mass * rise / (per_mass @ per_mass)
    for share in np.linspace(0.0, 1.0, 100):  # in 0.2 s
        run.cycle(velocity=(share * velocity).tolist())
    run.cycle(0.2, velocity=velocity.tolist())
    fast = (2.5 * velocity).tolist()
    run.compensator.applied = (0.0,) * 4  # motors that are off carry nothing, and no arm
    run.cycle(0.5, velocity=fast)
    assert not run.compensator.lost
    run.compensator.applied = run.efforts[-1]
    run.cycle(0.1, velocity=fast)
    assert run.compensator.lost == {"payload.mass": 0.0}
    assert math.isclose(run.compensator.settings.arm.total_mass, settings_with(mode="zero_g").arm.total_mass)


# The arm's inertia against Pinocchio's rnea and crba; the torque that turns it with its base against MuJoCo.

ROUNDING = 1e-10  # Nm; torques reach 100 Nm
NO_ROTORS = (0.0,) * 4
ON_LINKS = np.zeros((4, 2))  # m


def with_moments_across(arm: ArmModel, beside: np.ndarray) -> ArmModel:
    """Return the arm with each centre of gravity moved off its link axis by `beside`, (4, 2) m, as in `with_rods`."""
    (m1, m2, m3, m4), ((w1, _), (z2, w2), (y3, z3), (y4, z4)) = arm.mass.tolist(), beside.tolist()
    across = (m1 * w1 + m2 * w2, -m2 * z2 + m3 * z3 + m4 * z4, m3 * y3, m4 * y4)
    return ArmModel(arm.length, arm.cog, arm.mass, off_axis=across)


def with_rods(arm: ArmModel, beside: np.ndarray = ON_LINKS) -> tuple[Any, Any, Any]:
    """Return Pinocchio, and the arm as its model of thin rods without gravity.

    beside: (4, 2) m of each centre of gravity from its link, along the joint's axis x the link and along the axis.
    """
    pin, model = pinocchio_model(arm)
    for n in range(4):
        across = float(arm.mass[n] * arm.length[n] ** 2 / 12.0)
        at_cog = pin.SE3(pin.utils.rotate("z", OFFSET[n]), np.zeros(3)) * pin.SE3(
            np.eye(3), np.array((arm.cog[n], *beside[n]))
        )
        model.inertias[n + 1] = at_cog.act(pin.Inertia(float(arm.mass[n]), np.zeros(3), np.diag((0.0, across, across))))
    model.gravity.linear = np.zeros(3)
    return pin, model, model.createData()


@pytest.mark.parametrize("beside", [0.0, 0.05])  # m, largest offset of a centre of gravity from its link axis
def test_torque_mass_matrix_and_momentum_agree_with_pinocchio_for_random_arms_and_motions(beside):
    rng = np.random.default_rng(7)
    for _ in range(8):
        bare, (w, z, y3, y4) = random_arm(rng), rng.uniform(-beside, beside, 4)
        places = np.array(((w, 0.0), (-z, w), (y3, z), (y4, z)))
        pin, model, data = with_rods(bare, places)
        links = (with_moments_across(bare, places) if beside else bare).links._replace(rotors=NO_ROTORS)
        for theta, velocity, acceleration in rng.uniform(-3.0, 3.0, (20, 3, 4)):
            expected = pin.rnea(model, data, theta, velocity, acceleration)
            assert links.torque(theta, velocity, acceleration) == pytest.approx(expected, abs=ROUNDING)
            upper = np.triu(pin.crba(model, data, theta))
            mass = upper + np.triu(upper, 1).T
            assert links.matrix(theta) == pytest.approx(mass, abs=ROUNDING)
            momentum, change = links.momentum(theta, velocity)
            assert momentum == pytest.approx(mass @ velocity, abs=ROUNDING)
            coriolis = pin.computeCoriolisMatrix(model, data, theta, velocity)
            assert change == pytest.approx(coriolis.T @ velocity, abs=ROUNDING)


def test_each_rotor_turns_with_its_own_joint():
    arm, theta, acceleration = random_arm(np.random.default_rng(2)), (0.1, 0.2, 0.3, 0.4), (1.0, -2.0, 3.0, 5.0)
    rotors = (0.1, 0.2, 0.3, 0.4)
    with_rotors, without = (
        arm.links._replace(rotors=each).torque(theta, NO_ROTORS, acceleration) for each in (rotors, NO_ROTORS)
    )
    assert np.subtract(with_rotors, without) == pytest.approx(np.multiply(rotors, acceleration))


def test_the_least_inertia_is_below_that_of_any_pose():
    arm = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
    links, rng = arm.links, np.random.default_rng(3)
    poses = rng.uniform((-1.6, 0.0, 0.0, 0.0), (1.6, 2.6, 2.5, 2.6), (300, 4))
    felt = np.array([1.0 / np.diag(np.linalg.inv(links.matrix(pose))) for pose in poses])
    assert np.all(felt > 0.97 * np.array(least_inertia(links)))


FREE = {name: (0.0,) * 4 for name in ("coulomb_friction", "viscous_friction", "rotor_inertia")}


def left_behind(side, angular_acceleration, theta, torque):
    """Return by how much (4,) rad/s^2 the arm's joints accelerate on a base that turns, without gravity."""
    arm = SimulatedArm(ArmConfig(**FREE))
    arm.reset(theta)
    arm.move_base((0.0,) * 3, (0.0,) * 3, in_base(side, angular_acceleration, turning=True))
    arm.step(torque)
    return arm.data.qacc.copy()


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_torque_takes_an_arm_of_slender_rods_along_with_its_base(side, monkeypatch):
    monkeypatch.setattr(exo_gravity.sim.arm, "_TUBE_RADIUS", 1e-4)  # no parameter: the device has tubes
    rng = np.random.default_rng(5)
    for _ in range(30):
        theta, turning = rng.uniform((-1.5, 0, -0.7, 0), (1.5, 3, 2, 3)), rng.uniform(-3, 3, 3)
        torque = DEFAULT_LINKS.turning_torque(side, theta, turning)
        np.testing.assert_allclose(left_behind(side, turning, theta, torque), 0.0, atol=1e-4)


def test_an_arm_given_by_its_moments_needs_about_the_same_and_its_gains_scale_it():
    arm = ArmModel.from_moments(DEFAULT_LINKS.length, DEFAULT_LINKS.first_moment)
    rng = np.random.default_rng(6)
    theta, turning = rng.uniform(0.0, 1.5, (30, 4)), rng.uniform(-3, 3, (30, 3))
    exact, guessed = (
        np.array([links.turning_torque("left", *row) for row in zip(theta, turning, strict=True)])
        for links in (DEFAULT_LINKS, arm)
    )
    assert np.sqrt(np.mean((guessed - exact) ** 2)) < 0.15 * np.sqrt(np.mean(exact**2))
    half = ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass, (0.5,) * 4)
    np.testing.assert_allclose(half.turning_torque("left", theta[0], turning[0]), 0.5 * exact[0])


# The gravity laws against Pinocchio, the Robotics Toolbox, and the paper's equations copied by hand.

EXACT = 1e-12  # Nm


def random_arm(rng, at_link_ends=False):
    length = rng.uniform(0.03, 0.5, 4)
    cog = length if at_link_ends else length * rng.uniform(0.0, 1.0, 4)
    return ArmModel(length, cog, rng.uniform(0.1, 3.0, 4), rng.uniform(0.0, 2.0, 4), rng.uniform(1.0, 20.0))


def random_poses(rng, count=200):
    return rng.uniform(-math.pi, math.pi, (count, 4))


def random_directions(rng, count=200):
    direction = rng.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def upright(rng, count=200):
    """Poses with the paper's theta_1, the angle between joint 1's axis and gravity, equal to 0."""
    return random_poses(rng, count) * (0.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize("reference", quick([pinocchio], [pinocchio, gravload]))
def test_the_exact_law_agrees_for_random_arms_poses_and_gravity_directions_with(reference):
    rng = np.random.default_rng(1)
    for _ in range(4):
        arm, theta, direction = random_arm(rng), random_poses(rng, 50), random_directions(rng, 50)
        expected = reference(arm)(theta, direction)
        assert gravity_torque(arm, theta, direction) == pytest.approx(expected, abs=EXACT)


@pytest.mark.parametrize(
    "law", [paper_static_torque, lambda arm, theta: paper_mobile_torque(arm, theta, 0.0, 0.0)], ids=("static", "mobile")
)
def test_a_paper_law_equals_the_exact_law_at_link_ends_and_upright(law):
    rng = np.random.default_rng(4)
    arm, theta = random_arm(rng, at_link_ends=True), upright(rng)
    assert law(arm, theta) == pytest.approx(gravity_torque(arm, theta), abs=EXACT)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("law", [ArmModel.torque, static_torque, mobile_torque])
def test_a_single_pose_in_plain_floats_agrees_with_the_arrays(law, side):
    rng = np.random.default_rng(5)
    arm = random_arm(rng)
    for theta, (pitch, roll) in zip(random_poses(rng, 100), rng.uniform(-1.5, 1.5, (100, 2)), strict=True):
        tilt = Tilt.of(side, pitch, roll)
        on_axis = np.array((tilt.axis_angle, *theta[1:]))
        arrays = {
            ArmModel.torque: lambda theta=theta, tilt=tilt: gravity_torque(arm, theta, tilt.direction),
            static_torque: lambda on_axis=on_axis: paper_static_torque(arm, on_axis),
            mobile_torque: lambda on_axis=on_axis, tilt=tilt: paper_mobile_torque(arm, on_axis, tilt.beta, tilt.phi),
        }
        assert law(arm, theta.tolist(), tilt) == pytest.approx(arrays[law](), abs=EXACT)


def eq2_to_eq5(arm, t1, t2, t3, t4):
    (_, l2, l3, l4), (d1, d2, d3, d4) = arm.length, arm.cog
    (m1, m2, m3, m4), (c1, c2, c3, c4), g = arm.mass, arm.gain, arm.gravity
    return (
        c1 * g * (d1 * (m1 + m2 + m3 + m4) + l2 * (m2 + m3 + m4) * sin(t2)
                  + l3 * (m3 + m4) * cos(t3) + l4 * m4 * cos(t3 + t4)) * sin(t1),
        c2 * g * (d2 * (m2 + m3 + m4) + l3 * (m3 + m4) * cos(t3) + l4 * m4 * cos(t3 + t4)) * sin(t2),
        c3 * g * (d3 * (m3 + m4) * sin(t3) + l4 * m4 * sin(t3 + t4)) * cos(t2),
        c4 * g * d4 * m4 * sin(t3 + t4) * cos(t2),
    )  # fmt: skip


def eq1m_to_eq4m(arm, t1, t2, t3, t4, beta, phi):
    (_, l2, l3, l4), (d1, d2, d3, d4) = arm.length, arm.cog
    (m1, m2, m3, m4), (c1, c2, c3, c4), g = arm.mass, arm.gain, arm.gravity
    return (
        c1 * g * (d1 * (m1 + m2 + m3 + m4) + l2 * (m2 + m3 + m4) * sin(t2 + phi) + l3 * (m3 + m4) * cos(t3 + beta)
                  + l4 * m4 * cos(t3 + t4 + beta)) * sin(t1) * cos(phi) * cos(beta),
        c2 * g * (d2 * (m2 + m3 + m4) + l3 * (m3 + m4) * cos(t3 + beta) + l4 * m4 * cos(t3 + t4 + beta))
        * sin(t2 + phi) * cos(t1) * cos(phi) * cos(beta),
        c3 * g * (d3 * (m3 + m4) * sin(t3 + beta) + l4 * m4 * sin(t3 + t4 + beta))
        * cos(t2 + phi) * cos(t1) * cos(phi) * cos(beta),
        c4 * g * d4 * m4 * sin(t3 + t4 + beta) * cos(t2 + phi) * cos(t1) * cos(phi) * cos(beta),
    )  # fmt: skip


def test_the_static_and_the_mobile_law_are_the_equations_of_the_paper_word_for_word():
    rng = np.random.default_rng(7)
    arm, theta, tilt = random_arm(rng), random_poses(rng), rng.uniform(-1.0, 1.0, (200, 2))
    static = np.array([eq2_to_eq5(arm, *pose) for pose in theta])
    mobile = np.array([eq1m_to_eq4m(arm, *pose, *angles) for pose, angles in zip(theta, tilt, strict=True)])
    assert paper_static_torque(arm, theta) == pytest.approx(static, abs=EXACT)
    assert paper_mobile_torque(arm, theta, *tilt.T) == pytest.approx(mobile, abs=EXACT)
