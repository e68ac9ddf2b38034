# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Live changes of load, and what has thrown an arm where a torque began or a load went.

With a person's arm in the device: judged by the true motion of the joints, and by how fast the motors drive them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.compensation.terms.catalogue import Spring
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.events import ACTS

from ..support.thorough import quick
from .arms import CARRIED_IN, PEAK, RATE, CarriedArm, raised_usual_arm, usual_arm

SAFE_SPEED = 0.65  # rad/s, at which an arm without friction sinks under the damping of the motors
CODE = 0.009  # Nm, of a torque of the AK80-9 on the wire
RAISED = (0.0, 1.2, 0.3, 0.3)  # rad
ONE_G = {"mode": "one_g"}
SPRING = {"terms": TermSettings(spring=Spring((4.0, 14.0, 7.0, 3.9), (0.0, 0.0, -0.3, 1.3)))}
CLAMPED = {"max_effort": (0.5,) * 4}
HALVED = {"robot": ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass, (0.5,) * 4)}

BARE = {"pose": RAISED, "has_wearer": False, "mode": "one_g"}
guided_arm = partial(raised_usual_arm, rate=RATE, peak=PEAK, use_imu=True)  # with few options: each takes seconds


def fastest_driven(arm: CarriedArm) -> float:
    """The largest true speed of a joint along its motor's torque in rad/s."""
    records = arm.truth.records
    return float(np.abs(records["velocity"][records["velocity"] * records["torque"] > 0.0]).max(initial=0.0))


class Leading:
    """A hand that leads joints 2 and 4 to and fro at up to `speed` rad/s, 0 to hold them. torques: (n, 4) Nm so far."""

    def __init__(self, start: Sequence[float], speed: float) -> None:
        self.torques: list[np.ndarray] = []
        self._start, self._speed = np.array(start), speed
        self._weight = np.zeros(4)
        self._begin: float | None = None

    def __call__(self, now: float, theta: Sequence[float], velocity: Sequence[float]) -> Sequence[float]:
        self._begin = now if self._begin is None else self._begin
        pace, moving = 2.5, np.array((0.0, 1.0, 0.0, 1.0))
        phase = pace * (now - self._begin)
        error = self._start + moving * self._speed / pace * np.sin(phase) - theta
        self._weight += np.array((120.0, 160.0, 150.0, 80.0)) * error * 0.001
        damping = np.array((3.0, 6.0, 5.0, 2.0)) * (moving * self._speed * np.cos(phase) - velocity)
        self.torques.append(np.array((60.0, 80.0, 60.0, 30.0)) * error + damping + self._weight)
        return self.torques[-1].tolist()


def test_a_wearer_who_holds_still_feels_the_new_load_come_slowly_and_nothing_else():
    arm = guided_arm()
    arm.lead(Leading(arm.device.arm.positions, 0.0))
    arm.run(1.0)
    arm.forget()
    arm.change(**ONE_G)
    arm.run(4.5)
    assert arm.direct.answer.remainder == ()
    each_tenth = arm.truth.records["torque"][::100]
    assert np.abs(np.diff(each_tenth, axis=0)).max() < 0.1 * GUIDANCE.rate + 2 * CODE
    assert arm.fastest < 0.1


def test_a_wearer_who_moves_on_is_not_stopped():
    felt, speed = {}, 1.0
    for is_damped in (True, False):
        arm = guided_arm()
        arm.controller.change = None if is_damped else lambda efforts: efforts._replace(damped=False)
        hand = Leading(arm.device.arm.positions, speed)
        arm.lead(hand)
        arm.run(1.0)
        hand.torques.clear()
        arm.forget()
        arm.change(**ONE_G)
        arm.run(3.5)
        assert arm.safety.state is State.ACTIVE
        assert arm.fastest < 1.3 * speed + 0.1
        felt[is_damped] = np.array(hand.torques)
    length = min(map(len, felt.values()))
    assert np.abs(felt[True][:length] - felt[False][:length]).max() < GUIDANCE.brake + 1.0  # Nm that damping costs


# What has thrown an arm.

HANGING, LEANING = (0.0,) * 4, (0.0, 0.3, 0.2, 0.2)
ZERO_G = {"mode": "zero_g"}


# Carried again: in the mode for a wearer whose weight is not there, or by an IMU that is wrong by so many degrees.
AGAIN = [(LEANING, 0.0), (HANGING, 30.0), (HANGING, -30.0)]


@pytest.mark.parametrize(("pose", "roll"), quick(AGAIN[:2], AGAIN))
def test_an_empty_arm_whose_load_is_not_as_believed_when_it_is_carried_again_moves_slowly(pose, roll):
    arm = usual_arm(pose, RATE, peak=PEAK, has_wearer=False, use_imu=bool(roll), mode="one_g")
    arm.lead(Leading(pose, 0.0))
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.state is State.DISABLED)
    if roll:
        ACTS["imu_wrong"](arm, 0.0, math.radians(roll), 1.0)  # a jump would be refused
    else:
        arm.change(mode="zero_g")
    arm.run(1.0)
    arm.enable()
    assert arm.run_until(lambda: arm.state is State.RAMPING_IN)
    arm.forget()
    arm.act()
    arm.run(8.0)
    assert roll or arm.device.arm.positions[1] > 1.0  # nobody's weight holds it
    assert 0.1 < fastest_driven(arm) < SAFE_SPEED


LOOSE = [(BARE, 30.0), ({}, 30.0), ({}, 60.0)]


@pytest.mark.parametrize(("given", "roll"), quick(LOOSE[:1], LOOSE), ids=["empty, 30 degrees", "worn, 30", "worn, 60"])
def test_an_imu_that_comes_loose_drives_the_arm_slowly(given, roll):
    arm = guided_arm(**given)
    ACTS["imu_wrong"](arm, 0.0, math.radians(roll), 0.2)
    arm.run(4.2)
    assert 0.1 < fastest_driven(arm) < SAFE_SPEED


def test_a_trunk_that_falls_takes_the_arm_along_and_one_that_bows_is_not_felt():
    arm, damped = guided_arm(), []
    for angle, duration in ((0.5, 1.0), (0.0, 1.0), (1.4, 0.8)):
        arm.forget()
        arm.act({"bow": angle, "over": duration})
        damped.append(arm.run_until(lambda: arm.direct.answer.damped, 4.0))
    assert damped == [False, False, True]
    arm.run(3.0)
    assert arm.state is State.ACTIVE, arm.safety.fault
    assert arm.fastest < 4.0  # where the torque follows at once it is 7.7


BACK = {"mode": "zero_g", "max_effort": PEAK}
WORN = [ONE_G, BACK, ONE_G, CLAMPED, {"support": 0.3}, BACK, SPRING, ONE_G]
LEFT = [{"mode": "zero_g", "support": float(support)} for support in np.linspace(1.0, 0.0, 8)]
ALL = [HALVED, ZERO_G, CLAMPED, {"max_effort": PEAK}, {"robot": DEFAULT_LINKS}, HALVED, ONE_G]
UPON = [(True, [*WORN, *LEFT]), (False, [ZERO_G, ONE_G] * 4), (False, ALL)]


@pytest.mark.parametrize(
    ("has_wearer", "changes"), quick([UPON[0], UPON[2]], UPON), ids=["worn", "mode", "gain, mode and max_effort"]
)
def test_changes_upon_changes_are_as_calm_as_one(has_wearer, changes):
    arm = guided_arm(**({"pose": RAISED} if has_wearer else BARE))
    for change in changes:
        arm.change(**change)
        arm.run(0.3)
    arm.run_until(lambda: arm.direct.answer.remainder == (), 9.0)
    assert (arm.fastest if has_wearer else fastest_driven(arm)) < SAFE_SPEED
    assert arm.state is State.ACTIVE and arm.direct.answer.remainder == ()


def test_one_wrong_velocity_takes_no_load_from_the_hand():
    arm = guided_arm()
    arm.lead(Leading(CARRIED_IN, 0.0))
    arm.device.arm.carry(2.0)
    arm.change(payload=Payload(2.0))
    arm.run(5.0)
    arm.act()
    arm.run(0.5)
    arm.forget()
    honest, calls = arm.compensator.step, iter(range(1000))

    def once_wrong(now, theta, velocity=None):
        wrong = (velocity[0], 3.0, *velocity[2:])
        return honest(now, theta, wrong if next(calls) == 50 else velocity)

    arm.compensator.step = once_wrong
    arm.run(1.5)
    assert next(calls) > 100
    assert arm.compensator.dropped == 0.0 and arm.compensator.settings.payload.mass == 2.0
    assert arm.fastest < 0.1
