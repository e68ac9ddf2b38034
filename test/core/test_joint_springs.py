# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Springs at the joints, and joints that are springs: law and MuJoCo's arm agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.optimize import root

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings, compensator_table, settings_of
from exo_gravity.core.params import values_of
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.observer.momentum import MomentumObserver
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.urdf import UrdfConfig

from ..support.chains import random_chain
from ..support.compensator_run import THETA, settings_with

STIFFNESS, REST = (0.1, 0.15, 0.2, 0.25), (0.1, -0.3, 0.8, 0.5)
SPRING = Springs(STIFFNESS, REST)


def assert_held(settings: Settings, arm: SimulatedArm, tilt: Tilt, gravity: Sequence[float], poses: np.ndarray) -> None:
    """Law and springs hold MuJoCo's arm at each of `poses` (n, joints) rad; gravity: (3,) m/s^2 in its base."""
    arm.move_base(gravity)
    for theta in poses:
        arm.reset(theta)
        torque, _ = settings.torque(theta.tolist(), tilt)
        np.testing.assert_allclose(torque, arm.data.qfrc_bias - arm.data.qfrc_passive, atol=1e-9)


def test_law_and_springs_hold_mujocos_arm_with_springs() -> None:
    arm, tilt = SimulatedArm(ArmConfig(spring_stiffness=STIFFNESS, spring_rest=REST)), Tilt.of("left", 0.2, -0.1)
    poses = np.random.default_rng(1).uniform(-2.0, 2.0, (20, 4))
    gravity = np.multiply(STANDARD_GRAVITY, tilt.direction).tolist()
    assert_held(Settings("left", DEFAULT_LINKS, joint_spring=SPRING), arm, tilt, gravity, poses)


@pytest.mark.parametrize("count", [2, 6])
def test_law_and_springs_hold_mujocos_arm_of_any_number_of_joints(count: int) -> None:
    rng = np.random.default_rng(count)
    stiffness, rest = rng.uniform(0.05, 0.3, count).tolist(), rng.uniform(-1.0, 1.0, count).tolist()
    text, names = random_chain(count, count)
    given = {"law": "urdf", "joint_names": names, "use_imu": False, "max_effort": [50.0] * count,
             "joint_spring.stiffness": stiffness, "joint_spring.rest": rest}  # fmt: skip
    settings = settings_of(values_of(compensator_table(given), given), UrdfArm(text, names, "hand"))
    arm = SimulatedArm(UrdfConfig(text=text, joint_names=names, spring_stiffness=stiffness, spring_rest=rest))
    upright, poses = Tilt.of_gravity("left", (0.0, 0.0, -1.0)), rng.uniform(-2.0, 2.0, (10, count))
    assert_held(settings, arm, upright, (0.0, 0.0, -STANDARD_GRAVITY), poses)


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


@pytest.mark.parametrize("rigid", [(), (0.0,) * 4])
def test_without_a_stiffness_the_law_is_that_of_a_rigid_arm(rigid: Sequence[float]) -> None:
    settings = Settings("left", DEFAULT_LINKS, **({"joint_stiffness": rigid} if rigid else {}))
    theta, tilt = (0.3, 0.8, 0.7, 0.6), Tilt.of("left", 0.2, -0.1)
    assert settings.torque(theta, tilt)[0] == DEFAULT_LINKS.torque(theta, tilt)
