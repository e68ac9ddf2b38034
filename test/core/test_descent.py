# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The brake of one joint on its way down: which motion it opposes, how much, and when it gives way."""

import itertools

import pytest

from exo_gravity.core.safety.descent import DESCENT, JointDescent
from exo_gravity.core.safety.limits import DAMPING, MAX_EFFORT_RATE

PERIOD = 0.004  # s


def run(joint, velocity, duration):
    """Let `joint` move at `velocity` rad/s; return the torques meanwhile."""
    efforts = []
    for _ in range(round(duration / PERIOD)):
        joint.step(PERIOD, velocity)
        efforts.append(joint.effort)
    return efforts


@pytest.mark.parametrize("carried", [2.0, -2.0])
def test_a_joint_that_the_wearer_lifts_is_damped_and_not_braked(carried):
    joint = JointDescent(carried, 0.0, 3.0)
    efforts = run(joint, carried / 2.0, 3.0)
    assert efforts[-1] == 0.0
    assert all(0.0 <= effort / carried <= 1.0 for effort in efforts)
    assert joint.damping == DAMPING


def test_the_brake_returns_at_once_to_what_the_joint_carried_and_then_grows_slowly():
    joint = JointDescent(2.0, 0.0, 9.0)
    run(joint, 1.0, 1.0)
    assert joint.effort == 0.0
    run(joint, -1.0, 0.1)
    assert joint.effort == pytest.approx(2.0, abs=0.3)
    efforts = run(joint, -1.0, 1.0)
    assert 4.0 < efforts[-1] < 5.5
    assert max(run(joint, -1.0, 10.0)) == 9.0


def test_the_brake_stays_within_max_effort_or_what_the_joint_carried():
    assert max(run(JointDescent(2.0, 0.0, 3.0), -2.0, 10.0)) == 3.0
    assert max(run(JointDescent(5.0, 0.0, 3.0), -2.0, 10.0)) == 5.0
    assert min(run(JointDescent(-5.0, 0.0, 0.5), 2.0, 10.0)) == -5.0


def test_a_torque_that_drives_its_joint_goes_to_zero_without_a_step():
    joint = JointDescent(2.0, 0.0, 9.0)
    run(joint, -1.0, 3.0)
    before = joint.effort
    efforts = [before, *run(joint, 0.5, 0.5)]
    assert efforts[-1] == 0.0
    assert max(a - b for a, b in itertools.pairwise(efforts)) <= MAX_EFFORT_RATE * PERIOD * 1.0001


def test_a_joint_that_nothing_moves_loses_its_torque_within_two_seconds_and_then_its_damping():
    joint = JointDescent(4.0, 0.0, 9.0)
    efforts = run(joint, 0.0, 2.05)
    assert efforts[240] == pytest.approx(2.0, abs=0.1)
    assert efforts[-1] == 0.0 < joint.damping
    run(joint, 0.0, 4.0)
    assert joint.is_down


def test_damping_returns_when_a_joint_without_torque_moves_too_fast():
    joint = JointDescent(0.0, 0.0, 3.0)
    run(joint, 0.0, 6.0)
    run(joint, 3.0 * DESCENT.speed, 0.25)
    assert joint.damping == DAMPING
    assert joint.effort == 0.0


@pytest.mark.parametrize("speed", [-2.2, 2.2])
def test_what_a_motor_that_replies_again_brakes_with_drives_nothing_and_does_not_step(speed):
    joint = JointDescent(-0.13, 0.0, 3.0)
    braking = -3.0 * speed  # Nm, of damping on its way to DAMPING
    joint.resume(braking, speed)
    assert joint.effort == pytest.approx(-0.13)
    assert joint.effort - joint.damping * speed == pytest.approx(braking)


def test_what_a_motor_that_replies_again_holds_at_rest_is_its_torque():
    joint = JointDescent(1.0, 0.0, 9.0)
    joint.resume(3.7, 0.02)
    assert (joint.effort, joint.damping) == (3.7, 0.0)
