# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer's exertion: what it is made of, from torques that are known, and what the terms save in the simulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.effort.exertion import MIDDLE, POSES, RATE, REACH, Sweep, Task, exertion_of, measure
from bench.effort.holds import hold, perturbed_arm
from bench.effort.study import NOTHING, ONE_G, ZERO_G, Study
from exo_gravity.core.arm.kinematics import links_of
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.params import device_of

SHORT = replace(REACH, poses=REACH.poses[:4])


@pytest.fixture(scope="module")
def study():
    return Study.of()


def swept(joint: int, inertia: float, coulomb: float, viscous: float) -> tuple[np.ndarray, np.ndarray]:
    """Return torque and speed (n, 4) of a joint of known properties that swings at 0.3 and at 1.2 Hz."""
    time = np.arange(0.0, 20.0, 1.0 / RATE)
    speed, torque = np.zeros((len(time), 4)), np.zeros((len(time), 4))
    slow, fast = 2.0 * math.pi * 0.3, 2.0 * math.pi * 1.2
    speed[:, joint] = np.cos(slow * time) + 0.7 * np.cos(fast * time)
    acceleration = -slow * np.sin(slow * time) - 0.7 * fast * np.sin(fast * time)
    torque[:, joint] = inertia * acceleration + coulomb * np.sign(speed[:, joint]) + viscous * speed[:, joint] + 0.4
    return torque, speed


@pytest.mark.parametrize(("inertia", "coulomb", "viscous"), [(0.3, 0.4, 0.05), (0.02, 0.2, 0.3)])
def test_a_sweep_shows_the_inertia_and_friction_that_the_wearer_feels(inertia, coulomb, viscous):
    felt = exertion_of(*swept(1, inertia, coulomb, viscous), RATE, 1).felt
    assert felt == pytest.approx((inertia, coulomb, viscous), abs=0.01)


def test_rms_peak_work_and_jerk_of_a_known_motion():
    time = np.arange(0.0, 10.0, 1.0 / RATE)
    swing = 2.0 * math.pi
    speed = np.outer(np.sin(swing * time), (1.0, 0.0, 0.0, 0.0))
    torque = np.add(2.0 * speed, (0.0, 3.0, 0.0, 0.0))
    found = exertion_of(torque, speed, RATE)
    assert found.rms == pytest.approx((math.sqrt(2.0), 3.0, 0.0, 0.0))
    assert found.total == pytest.approx(math.sqrt(11.0))
    assert found.peak == pytest.approx((2.0, 3.0, 0.0, 0.0), abs=1e-3)
    assert found.work == pytest.approx(1.0, rel=1e-3)  # W: 2 sin^2 on average
    assert found.jerk == pytest.approx(swing**2 / math.sqrt(2.0), rel=0.02)
    assert found.felt is None
    assert exertion_of(-speed, speed, RATE).work == 0.0  # what the arm does on the wearer is not credited


@pytest.mark.parametrize("task", [Task("two", ((0.0,) * 4, (0.5, 0.2, 0.3, 0.4)), 1.0, 0.5), Sweep("s", MIDDLE, 2)])
def test_a_task_is_a_way_without_steps(task):
    times = np.arange(0.0 if isinstance(task, Task) else 3.0, task.duration, 0.001)
    position, speed = np.moveaxis([task.at(time) for time in times], 2, 0)
    assert np.gradient(position, 0.001, axis=0)[1:-1] == pytest.approx(speed[1:-1], abs=0.01)
    if isinstance(task, Sweep):  # it ends at its highest frequency
        assert np.abs(speed).max() == pytest.approx(0.1 * 2.0 * np.pi * 2.0, rel=0.03)


def test_a_sweep_in_exact_zero_g_feels_the_inertia_and_friction_of_the_simulated_arm(study):
    joint = 3
    true = {**study.simulator, "wearer.mass": study.settings[ZERO_G].wearer_mass}
    config = device_of(true).arm.config
    exact = replace(study.settings[ZERO_G], robot=config.links)
    inertia, coulomb, _ = measure(device_of(true), study.arm.motors, exact, Sweep("sweep", MIDDLE, joint)).felt
    # Two masses on a link have a little more inertia than one at their common centre of gravity.
    assert 0.97 < inertia / links_of(exact.arm).matrix(MIDDLE)[joint, joint] < 1.25
    assert coulomb == pytest.approx(config.coulomb_friction[joint], rel=0.25)


def test_friction_and_inertia_at_least_halve_the_exertion_of_a_reach_in_zero_g(study):
    arm = perturbed_arm(0, body_mass=75.0)
    without = replace(arm.settings, terms=study.settings[ZERO_G].terms)
    totals = []
    for settings in (without, arm.settings):
        device = SimulatedDevice(SimulatedArm(arm.config), [SimulatedMotor(motor) for motor in study.arm.motors])
        totals.append(measure(device, study.arm.motors, settings, SHORT).total)
    assert totals[1] < 0.5 * totals[0]


def test_more_support_means_less_exertion_and_none_the_most(study):
    order = (NOTHING, ONE_G, "Zero-G 0 %", ZERO_G)
    totals = [
        measure(device_of(study.simulator), study.arm.motors, study.settings[name], SHORT).total for name in order
    ]
    assert totals[0] > totals[1] > totals[3] and totals[2] == pytest.approx(totals[1], rel=1e-6)


def test_a_weak_arm_reaches_more_of_the_workspace_with_more_support(study):
    reached = {(name, share): value for name, share, value in study.workspaces()}
    order = (NOTHING, ONE_G, "Zero-G 25 %", "Zero-G 50 %", "Zero-G 75 %", ZERO_G)
    for share in (0.25, 0.35, 0.5):
        shares = [reached[name, share] for name in order]
        assert shares == sorted(shares) and shares[-1] > 0.9 > 0.1 > shares[1]
        assert reached["Zero-G 0 %", share] == reached[ONE_G, share]


def test_an_arm_with_friction_and_inertia_creeps_less_than_a_fifth_of_a_degree_per_minute():
    drift, swing = hold(perturbed_arm(2), POSES.poses[11], 3.0)
    assert drift < 0.2 and swing < 0.01


def test_an_arm_whose_wearer_is_a_tenth_heavier_than_known_is_seen_to_fall():
    assert hold(perturbed_arm(0, wearer_error=0.9), POSES.poses[9], 3.0)[0] > 10.0
