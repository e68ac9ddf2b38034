# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A request for more support: which one counts, how the support follows it, and how it expires. In virtual time."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.support import NAME, REQUEST
from exo_gravity.core.errors import ParameterError

ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(ROBOT.length)
SETTINGS = Settings(
    "right", ROBOT, mode="zero_g", support=0.4, support_adapts=True, use_imu=False, max_effort=(18.0,) * 4,
    wearer_mass=LOAD.mass.tolist(), wearer_cog=LOAD.cog.tolist(),
)  # fmt: skip
POSE, STILL, PERIOD = (0.0, 0.9, 0.7, 0.6), (0.0,) * 4, 0.01


class Arm:
    """A compensator that is asked for support 5 times a second. asked: 0..1, None for silence. lag: s, of stamps."""

    def __init__(self, settings: Settings = SETTINGS) -> None:
        self.compensator = Compensator(settings)
        self.asked: float | None = None
        self.names: tuple[str, ...] = (NAME,)
        self.lag, self.now, self.number = 0.0, 0.0, 0
        self.from_another = False
        self.answers: list[Compensation] = []
        self.run(3.0)

    def run(self, duration: float) -> float:
        """Run for `duration` s; return the support that is carried in the end."""
        for _ in range(round(duration / PERIOD)):
            self.number, self.now = self.number + 1, self.now + PERIOD
            if self.asked is not None and self.number % 20 == 0:
                request = self.compensator.support_request
                request.receive(self.now, self.names, (self.asked,), self.now - self.lag, self.from_another)
            self.answers.append(self.compensator.step(self.now, POSE, STILL))
        return self.support

    @property
    def support(self) -> float:
        return self.compensator.settings.support_now

    @property
    def report(self) -> str:
        return self.compensator.support_request.report(self.now)

    @property
    def largest_step(self) -> float:
        """The largest change of a torque from one answer to the next so far, in Nm."""
        efforts = [answer.effort or STILL for answer in self.answers]
        pairs = itertools.pairwise(efforts)
        return max(abs(b - a) for last, present in pairs for a, b in zip(last, present, strict=True))


def raised() -> Arm:
    """Return an arm that carries 70 % on request."""
    arm = Arm()
    arm.asked = 0.7
    assert arm.run(4.0) == 0.7 and arm.report == "70 %"
    return arm


def test_what_is_asked_for_is_carried_by_a_guided_change_and_given_back_two_seconds_after_the_last_request() -> None:
    arm = raised()
    mass = ROBOT.total_mass + 0.7 * sum(SETTINGS.wearer_mass)
    assert arm.compensator.settings.arm.total_mass == pytest.approx(mass)
    arm.asked = None
    assert arm.run(REQUEST.expires - 0.3) == 0.7
    assert arm.run(0.4) == 0.4 and arm.answers[-1].remainder and arm.report == "none"
    before = arm.answers[-1].effort
    arm.run(4.0)
    assert before != arm.answers[-1].effort and not arm.answers[-1].remainder
    assert arm.largest_step < 0.5


@pytest.mark.parametrize(("asked", "carried"), [(0.0, 0.4), (0.39, 0.4), (1.0, 1.0)])
def test_a_request_is_clamped_to_the_set_support_and_one(asked: float, carried: float) -> None:
    arm = Arm()
    arm.asked = asked
    assert arm.run(4.0) == carried


def test_the_support_changes_once_in_a_guided_changes_time_however_often_the_request_does() -> None:
    arm, changes = Arm(), []
    for number in range(1000):
        arm.asked = 0.4 + 0.6 * (number % 2)
        before = arm.support
        if arm.run(PERIOD * 7) != before:
            changes.append(arm.now)
    assert len(changes) > 3
    assert all(later - first > REQUEST.pause - 0.1 for first, later in itertools.pairwise(changes))


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"asked": math.nan}, "support_request must be a number from 0 to 1"),
        ({"asked": 1.01}, "support_request must be a number from 0 to 1"),
        ({"asked": -0.01}, "support_request must be a number from 0 to 1"),
        ({"names": ("elbow",)}, "support_request must have the one name support with one position"),
        ({"names": (NAME, NAME)}, "support_request must have the one name support with one position"),
        ({"lag": REQUEST.max_age + 0.1}, "support_request is late by its stamp, or its clock differs"),
        ({"lag": -REQUEST.max_lead - 0.1}, "support_request is late by its stamp, or its clock differs"),
    ],
    ids=["nan", "more than the arm", "negative", "misnamed", "twice", "old", "from the future"],
)
def test_a_wrong_request_moves_nothing_is_noted_and_the_last_good_one_expires(
    fault: dict[str, Any], reason: str
) -> None:
    fresh, arm = Arm(), raised()
    for each in (fresh, arm):
        vars(each).update({"asked": 0.9, **fault})
    assert fresh.run(4.0) == 0.4 and fresh.report == f"refused: {reason}"
    assert arm.run(1.5) == 0.7
    assert arm.run(1.0) == 0.4


def test_a_second_sender_ends_the_support_at_once_until_it_has_been_gone_for_a_while() -> None:
    arm = raised()
    arm.from_another = True
    assert arm.run(0.3) == 0.4 and "more than one publisher" in arm.report
    arm.from_another = False
    assert arm.run(REQUEST.distrust - 0.3) == 0.4
    assert arm.run(0.6) == 0.7


@pytest.mark.parametrize("change", [{"support_adapts": False}, {"mode": "one_g"}])
def test_nothing_is_raised_without_the_adaptation_or_in_one_g(change: dict[str, Any]) -> None:
    arm = Arm(replace(SETTINGS, **change))
    arm.asked = 0.9
    assert arm.run(4.0) == 0.4
    arm = raised()
    arm.compensator.apply(replace(SETTINGS, **change))
    assert arm.run(0.1) == 0.4
    assert not Settings("right", ROBOT).support_adapts


@pytest.mark.parametrize(
    ("change", "support", "more"), [({"payload_mass": 0.5}, 0.7, 0.5), ({"support": 0.8}, 0.8, 0.0)]
)
def test_a_raised_support_outlives_another_change_of_the_settings(
    change: dict[str, Any], support: float, more: float
) -> None:
    arm = raised()
    arm.compensator.apply(replace(SETTINGS, **change))
    arm.run(PERIOD)
    assert arm.support == support and arm.compensator.settings.arm.total_mass > ROBOT.total_mass + more


def test_a_change_that_is_not_yet_in_use_is_not_lost_when_the_support_rises() -> None:
    arm = Arm()
    arm.compensator.support_request.receive(arm.now, (NAME,), (0.6,), arm.now)
    arm.compensator.apply(replace(SETTINGS, payload_mass=0.5))
    assert arm.run(PERIOD) == 0.6
    assert arm.compensator.settings.payload_mass == 0.5


def test_a_wearer_who_is_too_heavy_at_full_support_is_refused_before_it_rises() -> None:
    heavy = [8.0 * mass / sum(SETTINGS.wearer_mass) for mass in SETTINGS.wearer_mass]
    assert replace(SETTINGS, support_adapts=False, wearer_mass=heavy).support == 0.4
    with pytest.raises(ParameterError, match="total mass"):
        replace(SETTINGS, wearer_mass=[1.2 * mass for mass in heavy])
