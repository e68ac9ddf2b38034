# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Springs at the joints, of the robot and of its wearer, and joints that are springs: law and MuJoCo's arm agree."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.optimize import root

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import TISSUE_REACH, Wearer
from exo_gravity.core.compensation.settings import COMPENSATOR, Settings, compensator_table, settings_of
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.params import values_of
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.observer import MomentumObserver
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.urdf import UrdfConfig

from ..support.chains import random_chain
from ..support.compensator_run import THETA, settings_with

STIFFNESS, REST = (0.1, 0.15, 0.2, 0.25), (0.1, -0.3, 0.8, 0.5)
SPRING = Springs(STIFFNESS, REST)


def test_law_and_springs_hold_mujocos_arm_with_springs() -> None:
    arm, tilt = SimulatedArm(ArmConfig(spring_stiffness=STIFFNESS, spring_rest=REST)), Tilt.of("left", 0.2, -0.1)
    settings = Settings("left", DEFAULT_LINKS, joint_spring=SPRING)
    arm.move_base(np.multiply(STANDARD_GRAVITY, tilt.direction).tolist())
    for theta in np.random.default_rng(1).uniform(-2.0, 2.0, (20, 4)):
        arm.reset(theta)
        torque, _ = settings.torque(theta.tolist(), tilt)
        np.testing.assert_allclose(torque, arm.data.qfrc_bias - arm.data.qfrc_passive, atol=1e-9)


@pytest.mark.parametrize("law", ["exact", "paper_static", "paper_mobile"])
def test_every_law_gets_the_springs(law: str) -> None:
    plain, sprung = settings_with(law=law), settings_with(law=law, joint_spring=SPRING)
    tilt = Tilt.of("left")
    added = np.subtract(sprung.torque(THETA, tilt)[0], plain.torque(THETA, tilt)[0])
    np.testing.assert_allclose(added, np.multiply(STIFFNESS, np.subtract(THETA, REST)), atol=1e-12)


def test_a_still_arm_that_its_motors_hold_against_its_springs_has_no_wearers_torque() -> None:
    settings = settings_with(joint_spring=SPRING)
    plain = replace(settings, mode="zero_g", support=1.0)
    tilt = Tilt.of("left")
    effort, _ = plain.torque(THETA, tilt)
    observer = MomentumObserver(settings)
    for n in range(100):
        estimate = observer.update(0.01 * n, (THETA, (0.0,) * 4, effort), tilt)
    np.testing.assert_allclose(estimate.torque, 0.0, atol=1e-9)


WORN = {"wearer_mass": (0.0, 0.0, 2.1, 1.6), "wearer_cog": (0.0, 0.0, 0.16, 0.18)}
NO_STOPS = {"position_min": (-3.14,) * 4, "position_max": (3.14,) * 4}


def resting(arm: SimulatedArm, motors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where MuJoCo's links rest behind motors at `motors` rad, and the torque in Nm that each joint carries."""
    count = len(motors)

    def unbalanced(links: np.ndarray) -> np.ndarray:
        arm.data.qpos[:count], arm.data.qpos[count:], arm.data.qvel[:] = links, motors, 0.0
        mujoco.mj_forward(arm.model, arm.data)
        return np.asarray(arm.data.qfrc_bias[:count] - arm.data.qfrc_passive[:count])

    found = root(unbalanced, motors, tol=1e-10)
    assert np.abs(unbalanced(found.x)).max() < 1e-6
    return found.x, arm.data.qfrc_bias[:count].copy()


def errors(settings: Settings, arm: SimulatedArm, tilt: Tilt, poses: np.ndarray) -> tuple[float, float]:
    """Return the largest error in Nm of the rigid law, and with the stiffness of `settings`."""
    rigid = replace(settings, joint_stiffness=(0.0,) * poses.shape[1])
    true = np.array([resting(arm, theta)[1] for theta in poses])
    before, after = (
        float(np.abs([one.torque(theta, tilt)[0] for theta in poses.tolist()] - true).max())
        for one in (rigid, settings)
    )
    return before, after


@pytest.mark.parametrize("stiffness", [150.0, 500.0, 1000.0])
def test_the_law_holds_a_worn_elastic_arm(stiffness: float) -> None:
    elastic = (stiffness,) * 4
    arm = SimulatedArm(ArmConfig(joint_stiffness=elastic, **WORN, **NO_STOPS))
    tilt = Tilt.of("left", 0.2, -0.1)
    arm.move_base(np.multiply(STANDARD_GRAVITY, tilt.direction).tolist())
    settings = Settings(
        "left", DEFAULT_LINKS, mode="zero_g", support=1.0, joint_stiffness=elastic, max_effort=(18.0,) * 4, **WORN
    )
    poses = np.random.default_rng(1).uniform((-0.8, 0.0, -0.3, 0.0), (0.8, 1.6, 1.5, 1.6), (20, 4))
    before, after = errors(settings, arm, tilt, poses)
    assert before > 60.0 / stiffness
    assert after < 0.02


@pytest.mark.parametrize("count", [2, 7])
def test_the_law_holds_an_elastic_arm_from_a_urdf(count: int) -> None:
    text, names = random_chain(count, count)
    stiffness = np.linspace(150.0, 400.0, count).tolist()
    arm = SimulatedArm(
        UrdfConfig(
            text=text, joint_names=names, joint_stiffness=stiffness,
            position_min=(-3.14,) * count, position_max=(3.14,) * count,
        )
    )  # fmt: skip
    given = {
        "law": "urdf",
        "joint_names": names,
        "use_imu": False,
        "max_effort": [50.0] * count,
        "joint_stiffness": stiffness,
    }
    settings = settings_of(values_of(compensator_table(given), given), UrdfArm(text, names, "hand"))
    arm.move_base((0.0, 0.0, -STANDARD_GRAVITY))
    poses = np.random.default_rng(count).uniform(-1.5, 1.5, (10, count))
    before, after = errors(settings, arm, Tilt.of_gravity("left", (0.0, 0.0, -1.0)), poses)
    assert before > 0.002
    assert after < 0.05 * before


# A wearer's arm that is known by its moments and the springs of its joints.

PERSON = ArmConfig(
    wearer_mass=(0.0, 0.0, 2.0, 1.6), wearer_cog=(0.0, 0.0, 0.16, 0.17), wearer_cog_y=(0.0, 0.0, 0.02, 0.03),
    wearer_cog_z=(0.0, 0.0, 0.01, -0.04), wearer_stiffness=(1.5, 1.0, 0.5, 0.8), wearer_rest=(0.1, 0.4, 0.3, 0.9),
)  # fmt: skip
ALONG = (3.6 * 0.05, 3.6 * 0.13, 2.0 * 0.16 + 1.6 * 0.3, 1.6 * 0.17)
ACROSS = (0.0, 2.0 * 0.01 - 1.6 * 0.04, 2.0 * 0.02, 1.6 * 0.03)
TISSUE = Springs(PERSON.wearer_stiffness, PERSON.wearer_rest, TISSUE_REACH)
SETTINGS = Settings(
    "left", DEFAULT_LINKS, mode="zero_g", support=1.0, wearer_mass=PERSON.wearer_mass, wearer_cog=PERSON.wearer_cog,
    wearer_moments=(ALONG, ACROSS), tissue=TISSUE, max_effort=(30.0,) * 4,
)  # fmt: skip
POSES = np.random.default_rng(3).uniform((-0.5, 0.0, -0.5, 0.0), (0.9, 1.3, 1.2, 1.5), (20, 4)).tolist()


def held(config, pose):
    """Return the torque (n,) in Nm that holds a simulated arm on an upright trunk."""
    arm = SimulatedArm(config)
    arm.reset(pose)
    return arm.data.qfrc_bias - arm.data.qfrc_passive


def test_zero_g_holds_segments_beside_their_links_and_springs_and_the_observer_sees_no_wearer():
    tilt, bare = Tilt.of("left"), replace(PERSON, wearer_mass=NO_TORQUE, wearer_stiffness=NO_TORQUE)
    for pose in POSES:
        needed, own = held(PERSON, pose), held(bare, pose)
        assert SETTINGS.torque(pose, tilt)[0] == pytest.approx(needed, abs=1e-9)
        part = replace(SETTINGS, support=0.4).torque(pose, tilt)[0]
        assert part == pytest.approx(own + 0.4 * (needed - own), abs=1e-9)
        assert replace(SETTINGS, mode="one_g").torque(pose, tilt)[0] == pytest.approx(own, abs=1e-9)
        estimate = MomentumObserver(SETTINGS).update(0.0, (pose, NO_TORQUE, needed.tolist()), tilt)
        assert estimate.torque == pytest.approx(NO_TORQUE, abs=1e-9)
        weight = needed - own - TISSUE.torque(pose)
        assert estimate.weight == pytest.approx(weight, abs=1e-9)  # gravity's alone


def test_beyond_its_reach_a_spring_pulls_no_harder():
    tissue = Springs((1.0, 0.0, 2.0), (0.1, 0.0, -0.2), TISSUE_REACH)
    assert tissue.torque((0.6, 3.0, -0.7)) == pytest.approx((0.5, 0.0, -1.0))
    assert tissue.torque((3.0, 3.0, -3.0)) == pytest.approx((TISSUE_REACH, 0.0, -2.0 * TISSUE_REACH))


GIVEN = {"wearer.first_moment": list(ALONG), "wearer.off_axis": list(ACROSS)}
VALUES = values_of(COMPENSATOR, {"mode": "zero_g", "support": 1.0, **GIVEN})


def test_moments_stand_in_place_of_masses():
    alone, tabled = settings_of(VALUES), settings_of({**VALUES, "wearer.body_mass": 75.0})
    assert alone.arm.first_moment == pytest.approx(np.add(alone.robot.first_moment, ALONG))
    assert sum(alone.wearer_mass) == pytest.approx(3.6, rel=0.3)  # for the inertia
    mass, _ = Wearer(75.0).on_links(tabled.robot.length)
    assert tabled.arm == alone.arm and tuple(tabled.wearer_mass) == tuple(mass)
