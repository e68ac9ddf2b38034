# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer who acts while the arm is let down, in virtual time, judged by the true motion of the arm.

A behaviour is a function of the time in s since it began and of the arm's true angles and velocities, (4,) rad and
rad/s; it returns the wearer's torque (4,) in Nm on the joints. A behaviour remembers: make a new one for each arm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.sim.virtual_wearer import Path, path_between

from .carried_arm import Hand, Person
from .rig import POSE, CarriedArm, raised_arm

MOVED = 0.6  # rad/s that the motors may cause,
# and ms that they may exceed it: when a fast hand lets go, damping is still bounded by its speed for a cycle or two.
RELEASE = 30


def lift(joint: int, speed: float, duration: float) -> Hand:
    """A hand that leads `joint` at `speed` rad/s, down if it is negative, for `duration` s, and lets go."""

    def path(since: float, start: Sequence[float]) -> Path:
        return [(start[n] + speed * since, speed) if n == joint else (start[n], 0.0) for n in range(4)]

    return hand(path, duration, joint)


def reach(there: Sequence[float], duration: float, period: float = 1.6) -> Hand:
    """Reach to the pose `there` (4,) rad and back, again and again, for `duration` s; period: s of both ways."""

    def path(since: float, start: Sequence[float]) -> Path:
        half, rest = divmod(since, period / 2)
        ends = (start, there) if half % 2 == 0 else (there, start)
        return path_between(*ends, rest, period / 2)

    return hand(path, duration)


def shake(torque: Sequence[float], duration: float, frequency: float = 2.0) -> Hand:
    """Shake the arm with `torque` (4,) Nm times a sine for `duration` s."""

    def behave(since: float, theta: Sequence[float], velocity: Sequence[float]) -> Sequence[float]:
        share = math.sin(2 * math.pi * frequency * since) if since < duration else 0.0
        return [share * each for each in torque]

    return behave


def hand(lead: Callable[[float, Sequence[float]], Path], duration: float, *joints: int) -> Hand:
    """A hand, compliant as a human one, that leads `joints`, or all, along a path for `duration` s and lets go."""
    person, last = Person(POSE, duration), [0.0]
    start: list[float] = []

    def behave(since: float, theta: Sequence[float], velocity: Sequence[float]) -> Sequence[float]:
        start.extend(theta if not start else ())
        period, last[0] = since - last[0], since
        if since >= duration:
            return NO_TORQUE
        torque = person.lead(lead(since, start), theta, velocity, period)
        return [torque[n] if n in (joints or range(4)) else 0.0 for n in range(4)]

    return behave


def attach(arm: CarriedArm, behaviour: Hand) -> None:
    """Trip the arm, and let a wearer act on it from 0.1 s on."""
    arm.safety.trip(FaultCode.COMMAND_STALE, "for this test", arm.clock.monotonic())
    person = Person(POSE, 1.0)
    person.hand = lambda since, *state: behaviour(since, *state) if since >= 0.0 else NO_TORQUE
    arm.rig.device.start(person, 0.1)


WEARERS = {
    "lifts the shoulder": lambda: lift(1, 1.0, 0.7),
    "pushes down": lambda: lift(1, -1.0, 0.5),
    "shakes": lambda: shake((0.0, 6.0, 3.0, 2.0), 1.0),
    "reaches": lambda: reach((0.3, 1.0, 0.8, 1.2), 1.6),
    "throws": lambda: lift(1, 3.0, 0.25),
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

    attach(carried, act)
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
    attach(carried, lift(1, 0.5, 1.0))
    carried.run_until(lambda: carried.loop.is_off)
    assert carried.safety.state is State.FAULT
    assert abs(carried.rig.device.arm.positions[1]) < 0.3
