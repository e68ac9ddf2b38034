"""Support that adapts: what makes it rise, what does not, and how it is forgotten. One joint, in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.guidance import GUIDANCE
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.observer.adaptation import MEMORY, RISE, SupportAdaptation
from exo_gravity.lab.observer.momentum import WearerEstimate

ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(ROBOT.length)
SETTINGS = Settings(
    "right", ROBOT, mode="zero_g", support=0.4, support_adapts=True, use_imu=False, max_effort=(18.0,) * 4,
    wearer_mass=LOAD.mass.tolist(), wearer_cog=LOAD.cog.tolist(),
)  # fmt: skip
PERIOD, WEIGHT, CODE = 0.01, 8.0, 25.0 / 4095.0  # s, Nm, rad


class Arm:
    """One joint that moves at a given speed, with the adaptation. share: the wearer's. changes: of the support, s."""

    def __init__(self, settings: Settings = SETTINGS) -> None:
        self.settings = settings
        self.adaptation = SupportAdaptation()
        self.share, self.deviation = 0.4, 0.3  # and Nm
        self.now, self.angle = 0.0, 1.0
        self.changes: list[float] = []

    def move(self, speed: float, duration: float, is_known: bool = True) -> float:
        """Move at `speed` rad/s for `duration` s; return the support at the end."""
        for _ in range(round(duration / PERIOD)):
            self.now += PERIOD
            self.angle += speed * PERIOD
            seen = round(self.angle / CODE) * CODE
            torque, deviation = (0.0, self.share * WEIGHT, 0.0, 0.0), (0.0, self.deviation, 0.0, 0.0)
            estimate = WearerEstimate(torque, deviation, (0.0, WEIGHT, 0.0, 0.0)) if is_known else None
            joints = (0.0, seen, 0.0, 0.0), (0.0, speed, 0.0, 0.0)
            if self.adaptation.update(self.now, joints, estimate, self.settings):
                self.changes.append(self.now)
                self.settings = replace(self.settings, raised_support=self.adaptation.support)
        return self.adaptation.support


def raised() -> Arm:
    """Return an arm whose support has risen."""
    arm = Arm()
    arm.move(-0.05, 8.0)
    assert arm.adaptation.support > 0.6
    arm.share = 0.2
    return arm


def test_the_support_rises_while_the_arm_sinks_and_no_faster_than_one_guided_change_after_the_other():
    arm = Arm()
    assert arm.move(0.0, 5.0) == pytest.approx(0.4, abs=0.02)
    assert arm.move(-0.05, 5.0) == pytest.approx(0.4 + 5.0 * RISE, abs=0.04)
    assert all(
        later - earlier >= GUIDANCE.fade_time - 1e-9
        for earlier, later in zip(arm.changes, arm.changes[1:], strict=False)
    )
    assert 2 <= len(arm.changes) <= 4
    arm.share = 0.05
    assert arm.move(-0.05, 20.0) == 1.0


def test_a_raised_support_is_forgotten_while_the_arm_is_held():
    arm = raised()
    arm.move(0.0, 10.0)
    before = arm.adaptation.support
    assert arm.move(0.0, MEMORY) - 0.4 == pytest.approx((before - 0.4) / math.e, abs=0.02)
    assert arm.settings.support_now == pytest.approx(arm.adaptation.support, abs=0.02)


def test_lifting_takes_back_half_as_fast_and_never_below_the_set_support():
    arm = raised()
    before = arm.adaptation.support
    assert arm.move(0.05, 5.0) == pytest.approx(before - 0.5 * 4.0 * RISE, abs=0.05)
    assert arm.move(0.05, 30.0) == 0.4


@pytest.mark.parametrize(
    ("what", "speed"),
    [({}, -0.3), ({"share": -0.3}, -0.05), ({"share": 1.3}, -0.05), ({"deviation": 1.5}, -0.05)],
    ids=["a movement", "pressed down", "motors off", "too wide a band"],
)
def test_what_is_no_sign_of_tiring_raises_nothing(what, speed):
    arm = Arm()
    vars(arm).update(what)
    assert arm.move(speed, 5.0) == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize("is_known", [True, False])
def test_without_a_usable_estimate_the_support_falls_back(is_known):
    arm = raised()
    before, arm.deviation = arm.adaptation.support, 3.0
    arm.move(0.0, 2.0)  # until the mean of the band is wide
    assert arm.move(0.0, 2.0, is_known) < before - 2.0 * RISE
    assert ("not known" in arm.adaptation.problem) != is_known
    assert arm.move(0.0, 15.0, is_known) == 0.4
    assert arm.settings.support_now == pytest.approx(0.4, abs=0.006)


def test_off_by_default_in_one_g_and_after_a_gap_nothing_changes():
    assert not Settings("right", ROBOT).support_adapts
    for other in ({"support_adapts": False}, {"mode": "one_g"}):
        arm = Arm(replace(SETTINGS, **other))
        assert arm.move(-0.05, 5.0) == 0.4 and not arm.changes
    arm = raised()
    held = arm.settings.support_now
    arm.now += 1.0
    arm.angle -= 0.5
    assert arm.move(0.0, 0.5) == pytest.approx(held, abs=0.01)


def lasting(now: float) -> float:
    """Return the share of his arm's weight that a wearer can carry, who tires within a minute."""
    return 0.6 - 0.4 * min(1.0, now / 60.0)


@pytest.mark.parametrize("adapts", [True, False])
def test_a_wearer_who_tires_is_carried_further_and_without_haste(adapts):
    step, damping, inertia, friction = 0.002, 2.0, 0.8, 0.3
    arm = Arm(replace(SETTINGS, support_adapts=adapts))
    angle, speed, fastest, effort, supports = 1.0, 0.0, 0.0, 0.5 * WEIGHT, []
    support = arm.settings.support
    for number in range(round(85.0 / step)):
        now = step * number
        weight = WEIGHT * math.sin(angle)
        most = lasting(now) * weight + 0.3
        effort = max(-most, min(most, effort + 25.0 * (1.0 - angle) * step))
        muscles = max(-most, min(most, 25.0 * (1.0 - angle) + effort)) - damping * speed
        wanted = arm.settings.support_now
        support += max(-0.04 * step, min(0.04 * step, wanted - support))
        free = speed + (muscles + (support - 1.0) * weight) / inertia * step
        speed = math.copysign(max(0.0, abs(free) - friction / inertia * step), free)
        angle += speed * step
        fastest = max(fastest, abs(speed))
        if number % 5 == 0:
            estimate = WearerEstimate((0.0, muscles, 0.0, 0.0), (0.0, 0.3, 0.0, 0.0), (0.0, weight, 0.0, 0.0))
            joints = (0.0, round(angle / CODE) * CODE, 0.0, 0.0), (0.0, round(speed / 0.024) * 0.024, 0.0, 0.0)
            if arm.adaptation.update(now, joints, estimate, arm.settings):
                arm.settings = replace(arm.settings, raised_support=arm.adaptation.support)
            supports.append(support)
    assert fastest < 0.3
    tired = supports[-1500:]
    if adapts:
        assert 0.65 < sum(tired) / len(tired) < 0.9
        assert angle > 0.6
    else:
        assert set(supports) == {0.4}
        assert angle < 0.4


def changed(compensator: Compensator, apply: Callable[[], None]) -> float:
    """Return the support that the compensator carries after `apply` and one step."""
    apply()
    compensator.step(0.0, (0.0, 0.9, 0.7, 0.6), (0.0,) * 4)
    assert isinstance(compensator.settings, Settings)
    return compensator.settings.support_now


def test_a_raised_support_outlives_other_changes_and_ends_with_the_adaptation():
    compensator = Compensator(SETTINGS)
    assert changed(compensator, lambda: compensator.raise_support(0.7)) == 0.7
    assert compensator.settings.arm.total_mass == pytest.approx(
        ROBOT.total_mass + 0.7 * sum(SETTINGS.wearer_mass), rel=1e-9
    )
    heavier = replace(SETTINGS, payload_mass=0.5)
    assert changed(compensator, lambda: compensator.apply(heavier)) == 0.7
    assert changed(compensator, lambda: compensator.apply(replace(SETTINGS, support=0.8))) == 0.8
    fixed = replace(SETTINGS, support_adapts=False)
    assert changed(compensator, lambda: compensator.apply(fixed)) == 0.4
    assert changed(compensator, lambda: compensator.raise_support(0.7)) == 0.4


def test_a_change_that_is_not_yet_in_use_is_not_lost_when_the_support_rises():
    compensator = Compensator(SETTINGS)
    compensator.apply(replace(SETTINGS, payload_mass=0.5))
    compensator.raise_support(0.6)
    assert changed(compensator, lambda: None) == 0.6
    assert compensator.settings.payload_mass == 0.5


def test_a_wearer_who_is_too_heavy_at_full_support_is_refused_before_it_rises():
    heavy = [8.0 * mass / sum(SETTINGS.wearer_mass) for mass in SETTINGS.wearer_mass]
    assert replace(SETTINGS, support_adapts=False, wearer_mass=heavy).support == 0.4
    with pytest.raises(ParameterError, match="total mass"):
        replace(SETTINGS, wearer_mass=[1.2 * mass for mass in heavy])
