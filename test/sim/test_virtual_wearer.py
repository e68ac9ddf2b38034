# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The virtual wearer moves the arm to a pose, releases it and pushes it."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.sim import STEP, ArmConfig, SimulatedArm, VirtualWearer
from exo_gravity.sim.script import TrialScript

POSE = (-0.6, 0.9, 0.8, 0.7)
PUSH = (0.5, 2.0, 1.5, 1.0)
NO_TORQUE = (0.0,) * 4
SCRIPT = TrialScript.parse(
    {
        "name": "test",
        "steps": [{"move": POSE, "over": 2.0}, {"hold": 1.0}, {"push": PUSH, "over": 0.4}, {"hold": 1.0}],
    }
)


def simulate(arm, wearer, begin, end, supported=0.0):
    """Run the script from `begin` to `end` s and return the wearer's torques (n, 4).

    supported: share of gravity that is compensated.
    """
    torques = []
    for step in range(round(begin / STEP), round(end / STEP)):
        theta = arm.positions
        torque = wearer.torque(step * STEP, theta, arm.velocities)
        arm.step(np.add(torque, supported * gravity_torque(arm.config.links, theta)))
        torques.append(torque)
    return np.array(torques)


@pytest.mark.parametrize(("supported", "wearer_mass"), [(0.0, (0.0, 0.0, 1.5, 1.2)), (1.0, (0.0,) * 4)])
def test_the_hand_moves_any_arm_to_the_pose_and_to_rest(supported, wearer_mass):
    arm = SimulatedArm(ArmConfig(wearer_mass=wearer_mass, wearer_cog=(0, 0, 0.16, 0.18)))
    simulate(arm, VirtualWearer(SCRIPT), 0.0, 2.0, supported)
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) < 1.0
    assert np.abs(arm.velocities).max() < 0.1


def test_the_hand_releases_at_once_and_a_supported_arm_stays():
    arm, wearer = SimulatedArm(), VirtualWearer(SCRIPT)
    simulate(arm, wearer, 0.0, 2.0, supported=1.0)
    torques = simulate(arm, wearer, 2.0, 3.0, supported=1.0)
    assert not torques.any()
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) < 1.0


def test_the_hand_moves_the_arm_along_a_minimum_jerk_path():
    arm, wearer = SimulatedArm(), VirtualWearer(SCRIPT)
    simulate(arm, wearer, 0.0, 0.75, supported=1.0)
    # Halfway through a motion of 1.5 s: half the distance, at 15/8 of the mean speed.
    np.testing.assert_allclose(arm.positions, np.divide(POSE, 2), atol=np.radians(3))
    np.testing.assert_allclose(arm.velocities, np.multiply(POSE, 15 / 8 / 1.5), rtol=0.2)


def test_a_motion_starts_at_the_present_pose():
    torque = VirtualWearer(SCRIPT).torque(0.0, (0.2, 0.3, 0.4, 0.5), NO_TORQUE)
    assert torque == NO_TORQUE


def test_the_hand_is_limited_to_its_strength():
    arm, wearer = SimulatedArm(), VirtualWearer(SCRIPT, strength=1.0)
    torques = simulate(arm, wearer, 0.0, 2.0)
    assert np.abs(torques).max() == 1.0
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) > 5


def test_a_push_is_a_half_sine_with_the_torques_of_the_script():
    wearer = VirtualWearer(SCRIPT)
    for share, elapsed in ((0.0, 3.0), (np.sqrt(0.5), 3.1), (1.0, 3.2), (np.sqrt(0.5), 3.3)):
        np.testing.assert_allclose(wearer.torque(elapsed, POSE, NO_TORQUE), np.multiply(PUSH, share), atol=1e-9)


@pytest.mark.parametrize("elapsed", [-0.001, SCRIPT.duration, 1e6])
def test_the_wearer_gives_no_torque_before_the_start_and_after_the_end(elapsed):
    assert VirtualWearer(SCRIPT).torque(elapsed, POSE, (1.0,) * 4) == NO_TORQUE


def test_the_wearer_reports_the_active_step():
    wearer, seen = VirtualWearer(SCRIPT), []
    for elapsed in (-1.0, 0.0, 2.0, 3.0, 3.5, 4.5):
        wearer.torque(elapsed, POSE, NO_TORQUE)
        seen.append(wearer.step)
    assert seen == [None, 0, 1, 2, 3, 4]
