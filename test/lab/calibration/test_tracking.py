# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tracker on a single light joint with Stribeck friction, and what it takes for a vibration of a motor."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from exo_gravity.lab.calibration.tracking import MOTION, Line, Station, Sweep, Tracker, Vibration, followed

LIGHT = 0.005  # kg m^2
COULOMB, STRIBECK, STRIBECK_SPEED = 0.3, 0.1, 0.05  # Nm, Nm, rad/s
RATE, STEPS = 100.0, 20  # Hz, and steps of the joint in each cycle
POSITION_CODE, VELOCITY_CODE = 0.0004, 0.0235  # rad and rad/s
STATION = Station((0.5,))


class Joint:
    """A light joint at rest at the station, whose torque is a cycle late."""

    def __init__(self) -> None:
        self.angle, self.speed, self._torque = STATION.theta[0], 0.0, 0.0

    def cycle(self, torque: float) -> tuple[float, float]:
        """Return angle and speed as a motor reports them, a cycle after `torque` in Nm was commanded."""
        dt = 1.0 / RATE / STEPS
        for _ in range(STEPS):
            friction = COULOMB + STRIBECK * math.exp(-((self.speed / STRIBECK_SPEED) ** 2))
            way = self.speed or self._torque
            if self.speed == 0.0 and abs(self._torque) <= friction:
                continue
            after = self.speed + (self._torque - math.copysign(friction, way)) / LIGHT * dt
            self.speed = 0.0 if after * self.speed < 0.0 else after
            self.angle += self.speed * dt
        self._torque = torque
        return (
            POSITION_CODE * round(self.angle / POSITION_CODE),
            VELOCITY_CODE * round(self.speed / VELOCITY_CODE),
        )


def shares(sticks: bool) -> list[float]:
    """Return which share of its way the joint followed in each of eight pairs of sweeps."""
    tracker, joint, found = Tracker(RATE, (9.0,)), Joint(), list[float]()
    tracker.friction, tracker.sticks = np.array([COULOMB]), np.array([sticks])

    def lines() -> Iterator[Line]:
        yield Line(np.array(STATION.theta), STATION.ends[0])
        for _ in range(8):
            sweeps: list[Sweep] = yield from tracker.sweep(STATION)
            found.append(float(followed(sweeps, STATION)[0]))
        while True:
            yield Line(STATION.ends[0], STATION.ends[0])

    tracker.lines, seen, matrix = lines(), joint.cycle(0.0), np.array([[LIGHT]])
    while len(found) < 8:
        seen = joint.cycle(tracker.step(1.0 / RATE, seen[:1], seen[1:], (0.0,), (0.0, 0.0, 1.0), matrix)[0])
    return found


def test_a_light_joint_that_sticks_follows_once_it_is_pushed_off() -> None:
    assert min(shares(False)) < MOTION.followed
    assert min(shares(True)) > 0.75


def test_a_path_comes_to_a_joint_that_sticks_ahead_of_it() -> None:
    """It waited for the elbow, which needed 1 Nm to come back: 'a hand is on the arm'."""
    tracker, matrix = Tracker(RATE, (9.0,)), np.array([[LIGHT]])
    tracker.lines = iter([Line(np.zeros(1), np.ones(1))])
    for _ in range(100):
        tracker.step(1.0 / RATE, (0.09,), (0.0,), (0.0,), (0.0, 0.0, 1.0), matrix)
        if tracker.error[0] > 0.0:
            return
    pytest.fail(f"the joint is {tracker.error[0]:.2f} rad off")


def vibrates(speeds: list[float], rate: float) -> bool:
    """Return whether these speeds of a motor in rad/s, at `rate` Hz, are a vibration."""
    vibration = Vibration(1)
    return any(vibration.step(1.0 / rate, (speed,)).any() for speed in speeds)


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
@pytest.mark.parametrize("frequency", [28.0, 66.0, 170.0])  # Hz, of an AK80-9 on 150 Nm/rad, an AK60-6 on it, on 1,000
def test_a_rotor_that_rings_vibrates_at_any_rate(frequency: float, rate: float) -> None:
    assert vibrates((0.3 + 0.3 * np.sin(2.0 * np.pi * frequency / rate * np.arange(rate))).tolist(), rate)


def test_a_joint_that_leaves_its_friction_again_and_again_does_not_vibrate() -> None:
    assert not vibrates([*[0.0] * 40, 0.2, 0.4, 0.5, 0.3, 0.1, -0.15, -0.1, 0.0] * 20, 250.0)
