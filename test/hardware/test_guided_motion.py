# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What has thrown an arm where a torque began or a load went: judged by how fast the motors truly drive a joint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading
from exo_gravity.sim.virtual_wearer import VirtualWearer

from ..support.copies import prepared
from ..support.thorough import quick
from .compensated_arm import CYCLE, PEAK, POSE, CompensatedArm
from .test_guided_changes import CLAMPED, HALVED, ONE_G, RAISED, SAFE_SPEED, Leading, guided_arm

HANGING, LEANING = (0.0,) * 4, (0.0, 0.3, 0.2, 0.2)
UPRIGHT = TrunkReading(gravity_in_trunk(0.0, 0.0).tolist())
ZERO_G = {"mode": "zero_g"}


def let_go(now: float, theta: Sequence[float], velocity: Sequence[float]) -> Sequence[float]:
    return (0.0,) * 4


def put_down(arm: CompensatedArm) -> None:
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.safety.state is State.DISABLED)


def carry_again(arm: CompensatedArm) -> None:
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state is State.RAMPING_IN)
    arm.forget()


def test_an_empty_cuff_that_is_carried_again_rises_slowly():
    arm = guided_arm(pose=LEANING, limit=PEAK, has_wearer=False, mode="one_g")
    arm.person.hand = Leading(LEANING, 0.0)
    put_down(arm)
    arm.change(**ZERO_G)
    arm.run(1.0)
    carry_again(arm)
    arm.person.hand = let_go
    arm.run(8.0)
    assert arm.device.arm.positions[1] > 1.0  # nobody's weight holds it
    assert arm.driven < SAFE_SPEED


class Imu:
    """An IMU whose reading the test sets."""

    def __init__(self) -> None:
        self.reading = UPRIGHT

    def __call__(self, now: float, state: TrunkState) -> TrunkReading:
        return self.reading


@pytest.mark.parametrize("roll", quick([30.0], [-30.0, 30.0]))
def test_an_arm_whose_imu_is_wrong_by_30_degrees_at_the_start_moves_slowly(roll):
    imu = Imu()
    arm = CompensatedArm(HANGING, PEAK, has_wearer=False, imu=imu, rate=0.5 / CYCLE, mode="one_g")
    put_down(arm)
    for angle in np.linspace(0.0, math.radians(roll), 20):  # a jump would be refused
        imu.reading = TrunkReading(gravity_in_trunk(0.0, angle).tolist())
        arm.run(0.05)
    carry_again(arm)
    arm.run(6.0)
    assert 0.1 < arm.driven < SAFE_SPEED


@prepared
def carried_with_imu(**given: Any) -> tuple[CompensatedArm, Imu]:
    """Return a carried arm, and its IMU."""
    imu = Imu()
    return CompensatedArm(limit=PEAK, imu=imu, rate=0.5 / CYCLE, **given), imu


LOOSE = [({"pose": RAISED, "has_wearer": False, "mode": "one_g"}, 30.0), ({}, 30.0), ({}, 60.0)]


@pytest.mark.parametrize(("given", "roll"), quick(LOOSE[:1], LOOSE), ids=["empty, 30 degrees", "worn, 30", "worn, 60"])
def test_an_imu_that_comes_loose_drives_the_arm_slowly(given, roll):
    arm, imu = carried_with_imu(**given)
    duration, steps = 0.2, 20
    rate = math.radians(roll) / duration
    for angle in np.linspace(0.0, math.radians(roll), steps + 1):
        imu.reading = TrunkReading(gravity_in_trunk(0.0, angle).tolist(), None, (rate, 0.0, 0.0))
        arm.run(duration / steps)
    imu.reading = imu.reading._replace(angular_velocity=ZERO)
    arm.run(4.0)
    assert 0.1 < arm.driven < SAFE_SPEED


def sensed(now: float, state: TrunkState) -> TrunkReading:
    """Return what a perfect IMU reads."""
    return TrunkReading(gravity_in_trunk(state.pitch, state.roll).tolist(), None, state.angular_velocity)


def bow(arm: CompensatedArm, angle: float, duration: float) -> list[bool]:
    """Let the trunk bow; return in which cycles of these 4 s the motors damped the joints."""
    arm.device.start(VirtualWearer(TrialScript.parse({"name": "bow", "steps": [{"bow": angle, "over": duration}]})))
    end, damped = arm.now + 4.0, []
    while arm.now < end:
        arm.loop.cycle()
        damped.append(arm.answer.damped)
    return damped


def test_a_trunk_that_falls_takes_the_arm_along_and_one_that_bows_is_not_felt():
    arm = CompensatedArm(imu=sensed, rate=0.5 / CYCLE)
    assert not any(bow(arm, 0.5, 1.0))
    bow(arm, 0.0, 1.0)
    arm.forget()
    assert any(bow(arm, 1.4, 0.8))
    assert arm.safety.state is State.ACTIVE, arm.safety.fault
    assert arm.top_speed < 4.0  # where the torque follows at once it is 7.7


MODES = [ZERO_G, ONE_G] * 4
ALL = [HALVED, ZERO_G, CLAMPED, {"max_effort": PEAK}, {"robot": DEFAULT_LINKS}, HALVED, ONE_G]


@pytest.mark.parametrize("changes", quick([ALL], [MODES, ALL]), ids=["mode", "gain, mode and max_effort"])
def test_changes_upon_changes_of_an_empty_arm_drive_it_no_faster_than_one(changes):
    arm = guided_arm(pose=RAISED, limit=PEAK, has_wearer=False, mode="one_g")
    for change in changes:
        arm.change(**change)
        arm.run(0.3)
    arm.run(4.0)
    assert arm.driven < SAFE_SPEED


@prepared
def loaded(mass: float, pose: Sequence[float]) -> CompensatedArm:
    """Return a carried arm in `pose` with a load in its hand."""
    arm = guided_arm(pose=pose, limit=PEAK)
    arm.person.hand = Leading(pose, 0.0)
    arm.device.arm.carry(mass)
    arm.change(payload_mass=mass)
    arm.run(7.0)
    arm.person.hand = let_go
    arm.run(0.5)
    arm.forget()
    return arm


def test_one_wrong_velocity_takes_no_load_from_the_hand():
    arm = loaded(2.0, POSE)
    honest, calls = arm.compensator.step, iter(range(1000))

    def once_wrong(now, theta, velocity=None):
        wrong = (velocity[0], 3.0, *velocity[2:])
        return honest(now, theta, wrong if next(calls) == 50 else velocity)

    arm.compensator.step = once_wrong
    arm.run(2.0)
    assert next(calls) > 100
    assert arm.compensator.dropped == 0.0 and arm.compensator.settings.payload_mass == 2.0
    assert arm.top_speed < 0.1


@pytest.mark.thorough
def test_a_cup_that_is_flicked_away_during_a_change_leaves_the_change_as_slow_as_it_was():
    arm = loaded(0.2, RAISED)
    arm.change(**ONE_G)
    arm.run(0.5)
    arm.device.arm.carry(0.0)
    start, efforts = arm.now, []
    arm.person.hand = lambda now, theta, velocity: (0.0, 6.0, 0.0, 4.0) if arm.now < start + 0.15 else (0.0,) * 4
    for _ in range(200):
        arm.run(0.02)
        efforts.append(arm.answer.effort)
    assert arm.compensator.dropped == 0.2
    assert arm.device.arm.positions[1] < 2.5
    still = np.abs(np.diff(efforts, axis=0))[50:]  # the flick is over
    assert still.max() < 0.02 * (GUIDANCE.rate + GUIDANCE.gain * SAFE_SPEED)


def test_a_load_of_2_kg_that_is_dropped_lets_the_arm_rise_but_not_fly():
    arm = loaded(2.0, POSE)
    start = np.array(arm.device.arm.positions)
    arm.device.arm.carry(0.0)
    arm.run(4.0)
    assert arm.compensator.dropped == 2.0
    assert arm.safety.state is State.ACTIVE
    assert arm.driven < 4.0
    assert np.abs(arm.device.arm.positions - start).max() < 1.2
