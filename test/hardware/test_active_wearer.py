# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The active wearer moves the simulated arm as each behaviour says."""

import math

import pytest

from exo_gravity.core.arm.gravity import gravity_torque

from ..support.active_wearer import attach, hold_still, lift, push, reach, shake, throw
from .rig import POSE, VirtualRig


@pytest.fixture
def rig():
    """An arm whose motors hold it in `POSE` with constant torques."""
    return VirtualRig()


def run(rig, duration):
    """Run for `duration` s; return the velocities (n, 4) and the positions (n, 4) meanwhile."""
    seen = []
    for _ in range(round(duration / 0.004)):
        rig.clock.sleep(0.004)
        seen.append((rig.device.arm.velocities, rig.device.arm.positions))
    return zip(*seen, strict=True)


@pytest.mark.parametrize(("joint", "speed"), [(1, 1.0), (3, 1.0), (1, -0.4)])
def test_a_hand_that_lifts_or_lowers_leads_its_joint_and_lets_go(rig, joint, speed):
    attach(rig.device, lift(joint, speed, 0.5))
    velocities, positions = run(rig, 0.5)
    assert positions[-1][joint] - POSE[joint] == pytest.approx(0.5 * speed, abs=0.1)
    assert velocities[-1][joint] == pytest.approx(speed, abs=0.2)


def test_a_throw_leaves_the_arm_in_fast_motion(rig):
    attach(rig.device, throw(3))
    velocities, _ = run(rig, 0.25)
    assert velocities[-1][3] > 2.0


def test_a_stiff_hand_holds_the_arm_against_its_motors(rig):
    attach(rig.device, hold_still())
    rig.device.exchange(2, b"\x80\x00\x80\x00\x00\x00\x08\x00")  # motor 2: about zero torque
    _, positions = run(rig, 3.0)
    assert max(math.dist(position, POSE) for position in positions) < 0.1


def test_reaching_goes_there_and_back(rig):
    there = (0.0, 1.0, 0.5, 1.0)
    attach(rig.device, reach(there, 1.6))
    _, positions = run(rig, 1.6)
    assert min(math.dist(position, there) for position in positions) < 0.15
    assert math.dist(positions[-1], POSE) < 0.15


def test_a_push_and_a_shake_end(rig):
    drive = tuple(gravity_torque(rig.links, POSE))
    assert push((0.0, 1.0, 0.0, 0.0), 1.0)(1.1, POSE, drive) == (0.0,) * 4
    attach(rig.device, shake((0.0, 6.0, 0.0, 0.0), 1.0))
    velocities, _ = run(rig, 1.0)
    assert min(velocity[1] for velocity in velocities) < -0.3 < 0.3 < max(velocity[1] for velocity in velocities)
