# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The device's own springs: what holds a joint against them by MuJoCo, in every law, live, and in the observer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.joint_spring import JointSpring
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import COMPENSATOR, Settings, settings_of, urdf_settings_of, urdf_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.observer.momentum import MomentumObserver
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.urdf import UrdfConfig

from ..support.chains import random_chain
from ..support.compensator_run import THETA, settings_with

STIFFNESS, REST = (0.1, 0.15, 0.2, 0.25), (0.1, -0.3, 0.8, 0.5)
SPRING = JointSpring(STIFFNESS, REST)


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
    given = {"joint_names": names, "use_imu": False, "max_effort": [50.0] * count,
             "joint_spring.stiffness": stiffness, "joint_spring.rest": rest}  # fmt: skip
    settings = urdf_settings_of(values_of(urdf_table(given), given), UrdfArm(text, names, "hand"))
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


@pytest.mark.parametrize(
    ("name", "value"),
    [("stiffness", [0.0, -0.1, 0.0, 0.0]), ("stiffness", [2.1] * 4), ("stiffness", [0.1] * 3), ("rest", [4.0] * 4)],
)
def test_springs_that_no_device_has_are_refused_by_name(name: str, value: list[float]) -> None:
    with pytest.raises(ParameterError, match=f"joint_spring.{name}"):
        settings_of(values_of(COMPENSATOR, {f"joint_spring.{name}": value}))
