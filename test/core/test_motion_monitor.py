# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Torque that gravity cannot account for: what is explained, what is not, and what happens with a wrong compensator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.motion_monitor import MOTION, MotionMonitor

from ..support.compensator_run import ROBOT

LIMITS = Limits(("a", "b", "c", "d"), largest_moment=ROBOT.first_moment)
PERIOD = 0.004
HANGING, RAISED = (0.0, 0.05, 0.05, 0.05), (0.0, 1.3, 0.2, 0.3)  # rad


def joints(theta: Sequence[float], velocity: float = 0.0) -> tuple[JointSample, ...]:
    return tuple(JointSample(angle, velocity, 0.0, None, None, 0.0) for angle in theta)


def torque_of(theta: Sequence[float], load: float = 1.0) -> tuple[float, ...]:
    return tuple(load * gravity_torque(ROBOT, theta))


def judge(torque: Sequence[float], theta: Sequence[float] = RAISED, addition: Sequence[float] = NO_TORQUE) -> float:
    """Return the time in s until the monitor finds a fault in a constant torque; infinity if it finds none."""
    monitor = MotionMonitor(replace(LIMITS, largest_addition=addition))
    for cycle in range(500):
        if monitor.step(PERIOD, joints(theta), torque)[1]:
            return cycle * PERIOD
    return math.inf


@pytest.mark.parametrize("side", ["left", "right"])
def test_any_load_up_to_the_largest_moments_is_explained_in_any_pose_at_any_tilt(side: str) -> None:
    random = np.random.default_rng(0)
    monitor = MotionMonitor(LIMITS)
    for _ in range(100):
        theta, tilt = random.uniform(-1.6, 2.5, 4), Tilt.of(side, *random.uniform(-1.5, 1.5, 2))
        lighter = ArmModel.from_moments(ROBOT.length, random.uniform(0.0, 1.0, 4) * ROBOT.first_moment)
        monitor.follow(tilt, None)
        low, high = monitor.explained(theta)
        torque = gravity_torque(lighter, theta, tilt.direction)
        assert np.all(np.array(low) - 1e-3 <= torque) and np.all(torque <= np.array(high) + 1e-3)


def test_the_heaviest_load_is_no_fault_and_three_times_it_is() -> None:
    assert judge(torque_of(RAISED)) == judge(torque_of(RAISED, 0.0)) == math.inf
    assert judge(torque_of(RAISED, 3.0)) < 0.1


def test_a_torque_of_the_wrong_sign_and_one_of_another_pose_are_faults() -> None:
    assert judge(torque_of(RAISED, -1.0)) < 0.1
    assert judge(torque_of(RAISED), HANGING) < 0.1


@pytest.mark.parametrize("push", [3.0, -6.0])
def test_what_may_be_added_is_no_fault_but_only_at_its_joint(push: float) -> None:
    gravity = torque_of(RAISED)
    pushed = (gravity[0], gravity[1] + push, *gravity[2:])
    assert judge(pushed) < 0.2
    assert judge(pushed, addition=(0.0, 3.0, 0.0, 0.0)) == math.inf
    assert judge(pushed, addition=(3.0, 0.0, 3.0, 3.0)) < 0.2


def test_a_torque_may_be_as_old_as_its_ride_while_the_wearer_moves() -> None:
    moved = joints(HANGING, 2.0)  # on from a pose of 0.18 s ago
    old = torque_of((HANGING[0], HANGING[1] + 0.36, *HANGING[2:]))
    for age, is_fault in ((0.0, True), (0.18, False)):
        monitor = MotionMonitor(LIMITS)
        faults = [monitor.step(PERIOD, moved, old, age)[1] for _ in range(200)]
        assert any(faults) is is_fault


def test_a_torque_on_its_way_from_a_tilt_that_was_overtaken_is_no_fault_for_some_seconds() -> None:
    before, lying = Tilt.of("left"), Tilt.of("left", math.radians(80.0), math.radians(-60.0))
    torque = gravity_torque(ROBOT, RAISED, before.direction)
    for overtaken, fault_after in ((None, 0.0), (before, MOTION.guided)):
        monitor, now = MotionMonitor(LIMITS), 0.0
        monitor.follow(lying, overtaken)
        while not monitor.step(PERIOD, joints(RAISED), torque)[1]:
            now += PERIOD
        assert fault_after <= now + PERIOD < fault_after + 0.2


def test_an_impossible_torque_is_passed_on_to_the_check_that_names_it() -> None:
    for torque in (math.nan, math.inf, 41.0):
        assert MotionMonitor(LIMITS).step(PERIOD, joints(RAISED), (0.0, torque, 0.0, 0.0))[1] is None


def test_unexplained_torque_is_not_passed_on() -> None:
    passed, _ = MotionMonitor(LIMITS).step(PERIOD, joints(RAISED), torque_of(RAISED, 2.5))
    needed = torque_of(RAISED)
    assert needed[1] < passed[1] < 1.5 * needed[1]


def test_an_oscillation_between_two_explained_torques_is_a_fault() -> None:
    monitor, gravity, fault = MotionMonitor(LIMITS), torque_of(RAISED), None
    for cycle in range(100):
        swing = 0.5 + 0.5 * math.sin(16.0 * math.pi * cycle * PERIOD)
        fault = fault or monitor.step(PERIOD, joints(RAISED), [swing * torque for torque in gravity])[1]
    assert fault and fault.code is FaultCode.UNEXPLAINED_TORQUE and "hardly moved" in fault.reason


def test_without_moments_every_torque_passes() -> None:
    monitor = MotionMonitor(replace(LIMITS, largest_moment=(0.0,) * 4))
    assert monitor.step(PERIOD, joints(HANGING), (3.0, 9.0, 3.0, 3.0)) == ((3.0, 9.0, 3.0, 3.0), None)
