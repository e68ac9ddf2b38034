# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer who acts while the arm is let down, in virtual time, judged by the true motion of the arm."""

import numpy as np
import pytest

from exo_gravity.core.safety.drive import FaultCode, State

from ..support.active_wearer import attach, lift, reach, shake, throw
from .rig import POSE, raised_arm

MOVED = 0.6  # rad/s that the motors may cause,
# and ms that they may exceed it: when a fast hand lets go, damping is still bounded by its speed for a cycle or two.
RELEASE = 30

WEARERS = {
    "lifts the shoulder": lambda: lift(1, 1.0, 0.7),
    "pushes down": lambda: lift(1, -1.0, 0.5),
    "shakes": lambda: shake((0.0, 6.0, 3.0, 2.0), 1.0),
    "reaches": lambda: reach((0.3, 1.0, 0.8, 1.2), 1.6),
    "throws": lambda: throw(1),
}


@pytest.mark.parametrize("wearer", WEARERS.values(), ids=WEARERS)
def test_an_arm_that_is_let_down_neither_fights_nor_throws_its_wearer(wearer):
    carried = raised_arm()
    arm, motors, behave = carried.rig.device.arm, carried.rig.device.motors, wearer()
    seen = []  # whether a hand was on the arm, its velocities, and the motors' torques

    def act(since, theta, velocity):
        torque = behave(since, theta, velocity)
        pulls = [motor.torque(*state) for motor, *state in zip(motors, theta, velocity, strict=True)]
        seen.append((any(torque), velocity, pulls))
        return torque

    carried.safety.trip(FaultCode.COMMAND_STALE, "for this test", carried.clock.monotonic())
    attach(carried.rig.device, act, 0.1)
    carried.run(3.5)
    touched, velocity, torque = map(np.array, zip(*seen, strict=True))
    free = np.flatnonzero(touched)[-1] + 1  # when the hand lets go
    speed = np.abs(velocity[free:])
    driven = (speed - np.minimum.accumulate(speed)) * (torque[free:] * velocity[free:] > 0.0)
    assert np.sum(driven.max(axis=1) > MOVED) <= RELEASE
    most = [max(abs(drive.effort[joint]) for drive in carried.drives) for joint in range(4)]
    assert all(np.array(most) <= np.maximum(carried.safety.limits.max_effort, np.abs(carried.rig.carrying)))
    assert arm.positions[1] < POSE[1] + 1.0


def test_the_arm_comes_down_after_the_wearer_let_go():
    carried = raised_arm()
    carried.safety.trip(FaultCode.COMMAND_STALE, "for this test", carried.clock.monotonic())
    attach(carried.rig.device, lift(1, 0.5, 1.0), 0.1)
    carried.run_until(lambda: carried.loop.is_off)
    assert carried.safety.state is State.FAULT
    assert abs(carried.rig.device.arm.positions[1]) < 0.3
