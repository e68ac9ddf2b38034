# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A request for more support: which one counts, how the support follows it, and how it expires. In virtual time."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest

from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.support import NAME, REQUEST

from ..support.compensator_run import ROBOT, CompensatorRun, settings_with

LOAD = Wearer(75.0).on_links(ROBOT.length)
GIVEN: dict[str, Any] = {
    "side": "right", "mode": "zero_g", "support": 0.4, "support_adapts": True, "max_effort": (18.0,) * 4,
    "wearer_mass": LOAD.mass.tolist(), "wearer_cog": LOAD.cog.tolist(),
}  # fmt: skip
SETTINGS = settings_with(**GIVEN)
POSE, PERIOD = (0.0, 0.9, 0.7, 0.6), 0.01


class Arm(CompensatorRun):
    """A compensator that is asked for support 5 times a second. asked: 0..1, None for silence. lag: s, of stamps."""

    asked: float | None = None
    names: tuple[str, ...] = (NAME,)
    lag, from_another = 0.0, False

    def __init__(self, **changes: Any) -> None:
        super().__init__(**{**GIVEN, **changes})
        self.run(3.0)

    def run(self, duration: float) -> float:
        """Run for `duration` s; return the support that is carried in the end."""
        for _ in range(round(duration / PERIOD)):
            if self.asked is not None and len(self.efforts) % 20 == 0:
                request, stamp = self.compensator.support_request, self.now - self.lag
                request.receive(self.now, self.names, (self.asked,), stamp, self.from_another)
            self.answer = self.cycle(PERIOD, POSE, PERIOD)
        return self.compensator.settings.support_now

    @property
    def report(self) -> str:
        return self.compensator.support_request.report(self.now)


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
    assert arm.run(0.4) == 0.4 and arm.answer.remainder and arm.report == "none"
    arm.run(4.0)
    assert not arm.answer.remainder and arm.largest_step < 0.5


def test_the_support_changes_once_in_a_guided_changes_time_however_often_the_request_does() -> None:
    arm, changes = Arm(), []
    for number in range(200):
        arm.asked, before = 0.4 + 0.6 * (number % 2), arm.compensator.settings.support_now
        changes += [arm.now] if arm.run(PERIOD * 7) != before else []
    assert len(changes) > 3
    assert all(later - first > REQUEST.pause - 0.1 for first, later in itertools.pairwise(changes))


OUTSIDE, MISNAMED = "must be a number from 0 to 1", "must have the one name support with one position"
LATE = "is late by its stamp, or its clock differs"
ASKED: dict[str, tuple[dict[str, Any], float, str]] = {  # what is asked for, what is carried, and what is refused
    "nothing": ({"asked": 0.0}, 0.4, ""),
    "less than is set": ({"asked": 0.39}, 0.4, ""),
    "all": ({"asked": 1.0}, 1.0, ""),
    "nan": ({"asked": math.nan}, 0.4, OUTSIDE),
    "more than the arm": ({"asked": 1.01}, 0.4, OUTSIDE),
    "negative": ({"asked": -0.01}, 0.4, OUTSIDE),
    "misnamed": ({"asked": 0.9, "names": ("elbow",)}, 0.4, MISNAMED),
    "twice": ({"asked": 0.9, "names": (NAME, NAME)}, 0.4, MISNAMED),
    "old": ({"asked": 0.9, "lag": REQUEST.max_age + 0.1}, 0.4, LATE),
    "from the future": ({"asked": 0.9, "lag": -REQUEST.max_lead - 0.1}, 0.4, LATE),
}


@pytest.mark.parametrize(("given", "carried", "refused"), ASKED.values(), ids=ASKED)
def test_a_request_counts_within_the_set_support_and_one_and_a_wrong_one_moves_nothing_and_is_noted(
    given: dict[str, Any], carried: float, refused: str
) -> None:
    arm = Arm()
    vars(arm).update(given)
    assert arm.run(4.0) == carried
    assert not refused or arm.report == f"refused: support_request {refused}"


def test_a_wrong_request_lets_the_last_good_one_expire() -> None:
    arm = raised()
    arm.asked = math.nan
    assert arm.run(1.5) == 0.7 and arm.run(1.0) == 0.4


def test_a_second_sender_ends_the_support_at_once_until_it_has_been_gone_for_a_while() -> None:
    arm = raised()
    arm.from_another = True
    assert arm.run(0.3) == 0.4 and "more than one publisher" in arm.report
    arm.from_another = False
    assert arm.run(REQUEST.distrust - 0.3) == 0.4
    assert arm.run(0.6) == 0.7


@pytest.mark.parametrize(
    ("change", "support"),
    [
        ({"support_adapts": False}, 0.4),
        ({"mode": "one_g"}, 0.4),
        ({"payload_mass": 0.5}, 0.7),
        ({"support": 0.8}, 0.8),
    ],
)
def test_a_raised_support_outlives_other_changes_of_the_settings_and_nothing_is_raised_without_adaptation_or_in_one_g(
    change: dict[str, Any], support: float
) -> None:
    arm = raised()
    arm.compensator.apply(replace(SETTINGS, **change))
    assert arm.run(0.1) == support
    arm = Arm(**change)
    arm.asked = 0.7
    assert arm.run(4.0) == support
    assert arm.compensator.settings.payload_mass == change.get("payload_mass", 0.0)


def test_a_change_that_is_not_yet_in_use_is_not_lost_when_the_support_rises() -> None:
    arm = Arm()
    arm.compensator.support_request.receive(arm.now, (NAME,), (0.6,), arm.now)
    arm.compensator.apply(replace(SETTINGS, payload_mass=0.5))
    assert arm.run(PERIOD) == 0.6
    assert arm.compensator.settings.payload_mass == 0.5
