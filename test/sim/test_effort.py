"""What a virtual wearer's effort is made of, and what the terms `friction` and `inertia` save."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.model.kinematics import LinkInertia
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.effort import Sweep, Task, measure
from exo_gravity.sim.effort_study import MIDDLE, REACH, effort_settings
from exo_gravity.sim.perturbed_arm import perturbed_arm

from ..support.terms_run import COULOMB, MOTORS_OF_ARM

RATE = 250.0
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
MASS, COG = Wearer(75.0).on_links(ROBOT.length)
BASE = Settings(
    "right", ROBOT, wearer_mass=MASS, wearer_cog=COG, use_imu=False, max_effort=(9.0, 18.0, 9.0, 9.0), mode="zero_g"
)
SHORT = replace(REACH, poses=REACH.poses[:4])


def make_device(
    wearer: float = 1.03,
    links: ArmModel = DEFAULT_LINKS,
    friction: Sequence[float] = COULOMB,
    viscous: Sequence[float] = (0.02, 0.05, 0.02, 0.02),
) -> SimulatedDevice:
    config = ArmConfig(
        links, wearer_mass=wearer * MASS, wearer_cog=COG, coulomb_friction=friction, viscous_friction=viscous
    )
    return SimulatedDevice(SimulatedArm(config), [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])


def test_a_task_is_a_way_without_steps_from_pose_to_pose():
    task = Task("two", ((0.0,) * 4, (0.5, 0.2, 0.3, 0.4)), move=1.0, hold=0.5)
    times = np.arange(0.0, task.duration, 0.001)
    position, speed = (np.array(rows) for rows in zip(*map(task.at, times), strict=True))
    assert position[-1] == pytest.approx((0.5, 0.2, 0.3, 0.4))
    assert np.gradient(position, 0.001, axis=0) == pytest.approx(speed, abs=0.01)


def test_a_sweep_is_a_sine_that_ends_at_its_highest_frequency():
    sweep = Sweep("sweep", MIDDLE, 2)
    times = np.arange(3.0, sweep.duration, 0.001)
    position, speed = (np.array(rows)[:, 2] for rows in zip(*map(sweep.at, times), strict=True))
    assert np.gradient(position, 0.001)[1:-1] == pytest.approx(speed[1:-1], abs=0.01)
    assert np.abs(speed).max() == pytest.approx(0.1 * 2.0 * np.pi * 2.0, rel=0.03)


@pytest.mark.parametrize("joint", [1, 3])
def test_a_sweep_in_exact_zero_g_feels_the_inertia_and_friction_of_the_simulated_arm(joint):
    device = make_device(1.0)
    arm = device.arm.config.links.with_wearer(MASS, COG)
    exact = replace(BASE, robot=DEFAULT_LINKS)
    inertia, coulomb, _ = measure(device, MOTORS_OF_ARM, exact, Sweep("sweep", MIDDLE, joint), RATE).felt
    # Two masses on a link have a little more inertia than one at their common centre of gravity.
    assert 0.97 < inertia / LinkInertia.of(arm).matrix(MIDDLE)[joint, joint] < 1.25
    assert coulomb == pytest.approx(COULOMB[joint], rel=0.25)


def perturbed(seed: int) -> tuple[SimulatedDevice, list[float], list[float]]:
    """Return a device that differs from the controller's model, and the friction that was identified on it."""
    arm = perturbed_arm(seed, MASS, COG)
    motors = [SimulatedMotor(motor) for motor in MOTORS_OF_ARM]
    return SimulatedDevice(SimulatedArm(arm.config), motors), arm.coulomb, arm.viscous


@pytest.mark.parametrize("seed", range(6))
def test_friction_and_inertia_at_least_halve_the_effort_of_a_reach_in_zero_g(seed):
    compared = {}
    for name in ("Zero-G 100 %", "+ friction and inertia"):
        device, *identified = perturbed(seed)
        compared[name] = measure(device, MOTORS_OF_ARM, effort_settings(BASE, *identified)[name], SHORT, RATE).total
    assert compared["+ friction and inertia"] < 0.5 * compared["Zero-G 100 %"]


def test_more_support_means_less_effort_and_none_the_most():
    settings = effort_settings(BASE, COULOMB, (0.0,) * 4)
    order = ("nothing", "One-G", "Zero-G 50 %", "Zero-G 100 %")
    totals = [measure(make_device(), MOTORS_OF_ARM, settings[name], SHORT, RATE).total for name in order]
    assert totals == sorted(totals, reverse=True)
    same = measure(make_device(), MOTORS_OF_ARM, settings["Zero-G 0 %"], SHORT, RATE).total
    assert same == pytest.approx(totals[1], rel=1e-6)  # Zero-G without support is One-G
