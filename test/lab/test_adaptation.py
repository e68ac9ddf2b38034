# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Support that adapts: what makes it rise, what does not, and how it is forgotten. One joint, in virtual time."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.compensation.support import REQUEST
from exo_gravity.lab.observer import ADAPTATION, SupportAdaptation, WearerEstimate

from ..core.test_compensator import SETTINGS

PERIOD, WEIGHT, CODE = 0.01, 8.0, 25.0 / 4095.0  # s, Nm, rad
RISE, MEMORY = ADAPTATION.rise, ADAPTATION.memory


class Arm:
    """One joint that moves at a given speed, with the adaptation. share: the wearer's. changes: of the request, s."""

    def __init__(self, **settings: Any) -> None:
        self.settings = replace(SETTINGS, **settings)
        self.adaptation = SupportAdaptation()
        self.share, self.deviation, self.is_carried = 0.4, 0.3, True  # and Nm
        self.now, self.angle = 0.0, 1.0
        self.changes: list[float] = []

    def move(self, speed: float, duration: float, is_known: bool = True) -> float:
        """Move at `speed` rad/s for `duration` s, read as on the device; return the support at the end."""
        deviation, weight = (0.0, self.deviation, 0.0, 0.0), (0.0, WEIGHT, 0.0, 0.0)
        estimate = WearerEstimate(*map(np.array, ((0.0, self.share * WEIGHT, 0.0, 0.0), deviation, weight, deviation)))
        for _ in range(round(duration / PERIOD)):
            self.now += PERIOD
            self.angle += speed * PERIOD
            joints = (0.0, round(self.angle / CODE) * CODE, 0.0, 0.0), (0.0, speed, 0.0, 0.0)
            before = self.adaptation.requested
            self.adaptation.update(self.now, joints, estimate if is_known else None, self.settings, self.is_carried)
            if before is not None and self.adaptation.requested != before:
                self.changes.append(self.now)
        return self.adaptation.support


def raised() -> Arm:
    arm = Arm()
    arm.move(-0.05, 8.0)
    assert arm.adaptation.support > 0.6
    arm.share = 0.2
    return arm


def test_the_support_rises_while_the_arm_sinks_and_is_asked_for_in_steps_that_leave_time_for_a_guided_change() -> None:
    arm = Arm()
    assert arm.move(0.0, 5.0) == pytest.approx(0.4, abs=0.02)
    assert arm.move(-0.05, 5.0) == pytest.approx(0.4 + 5.0 * RISE, abs=0.04)
    pauses = [later - earlier for earlier, later in zip(arm.changes, arm.changes[1:], strict=False)]
    assert 2 <= len(arm.changes) <= 4 and min(pauses) >= REQUEST.pause - 1e-9
    arm.share = 0.05
    assert arm.move(-0.05, 20.0) == 1.0


def test_a_raised_support_is_forgotten_while_held_and_lifting_takes_it_back_half_as_fast_never_below_the_set() -> None:
    arm = raised()
    before = arm.move(0.0, 10.0)
    assert arm.move(0.0, MEMORY) - 0.4 == pytest.approx((before - 0.4) / math.e, abs=0.02)
    arm.settings = replace(arm.settings, support=0.1)  # what it has risen stays on top
    assert arm.move(0.0, 0.1) - 0.1 == pytest.approx((before - 0.4) / math.e, abs=0.02)
    assert arm.adaptation.requested == pytest.approx(arm.adaptation.support, abs=0.02)
    arm = raised()
    before = arm.adaptation.support
    assert arm.move(0.05, 5.0) == pytest.approx(before - 0.5 * 4.0 * RISE, abs=0.05)
    assert arm.move(0.05, 30.0) == 0.4


@pytest.mark.parametrize(
    ("what", "speed"),
    [
        ({}, -0.3),
        *((what, -0.05) for what in ({"share": -0.3}, {"share": 1.3}, {"deviation": 1.5}, {"is_carried": False})),
    ],
    ids=["a movement", "pressed down", "motors off", "too wide a band", "let down"],
)
def test_what_is_no_sign_of_tiring_raises_nothing(what: dict[str, float], speed: float) -> None:
    arm = Arm()
    vars(arm).update(what)
    assert arm.move(speed, 5.0) == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize("is_known", [True, False])
def test_without_a_usable_estimate_the_support_falls_back(is_known: bool) -> None:
    arm = raised()
    before, arm.deviation = arm.adaptation.support, 3.0
    arm.move(0.0, 2.0)  # until the mean of the band is wide
    assert arm.move(0.0, 2.0, is_known) < before - 2.0 * RISE
    assert ("not known" in arm.adaptation.problem) != is_known
    assert arm.move(0.0, 15.0, is_known) == 0.4
    assert arm.adaptation.requested == pytest.approx(0.4, abs=0.006)


@pytest.mark.parametrize(("gap", "is_kept"), [(0.8 * REQUEST.expires, True), (1.2 * REQUEST.expires, False)])
def test_a_gap_changes_nothing_until_the_request_has_expired_and_nothing_is_asked_for_where_nothing_may_adapt(
    gap: float, is_kept: bool
) -> None:
    arm = raised()
    expected = arm.adaptation.requested if is_kept else 0.4
    arm.now += gap
    arm.angle -= 0.5
    assert arm.move(0.0, 0.5) == pytest.approx(expected, abs=0.01)
    assert arm.adaptation.requested == pytest.approx(expected, abs=0.01)
    arm.settings = replace(arm.settings, **({"support_adapts": False} if is_kept else {"mode": "one_g"}))
    assert arm.move(-0.05, 5.0) == 0.4 and arm.adaptation.requested is None
