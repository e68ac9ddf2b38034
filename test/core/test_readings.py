# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Readings of ordinary motors: one wrong reading, lost frames and a late computer are no fault; two readings are."""

from __future__ import annotations

from typing import Any

import pytest

from exo_gravity.core.motors.joint_motor import UNKNOWN
from exo_gravity.core.safety.trust import Readings

from ..support.safety_run import LIMITS, reading

PERIOD = 0.01  # s


class Run:
    """Four motors that turn at `speed` rad/s; faults: the codes found so far."""

    def __init__(self, speed: float = 0.0) -> None:
        self.readings = Readings(LIMITS)
        self.speed = speed
        self.now = 10.0
        self.faults: list[str] = []
        self._joints = [UNKNOWN] * 4
        self._held_back = (False,) * 4
        self.run(2)
        self.faults.clear()  # silent before the first replies

    def cycle(self, late: float = 0.0, lost: bool = False, held_back: bool = False, **changes: Any) -> None:
        """One cycle, in which the loop stands still for `late` s before it takes the replies.

        lost: the second motor's reply does not come. held_back: that motor is sent nothing. changes: of its reading.
        """
        self.readings.step(self.now, tuple(self._joints), self._held_back)
        self._held_back = (False, held_back, False, False)
        if self.readings.fault:
            self.faults.append(str(self.readings.fault.code))
        angle = self.speed * (self.now - 10.0)  # when the motors reply
        self.now += PERIOD + late
        for i in range(4):
            if not ((lost or held_back) and i == 1):
                given = changes if i == 1 else {}
                self._joints[i] = reading(
                    **{"position": angle, "velocity": self.speed, "time": self.now - 0.009, **given}
                )

    def run(self, count: int, **options: Any) -> None:
        for _ in range(count):
            self.cycle(**options)


WRONG = {
    "over_temperature": {"temperature": 120},
    "over_speed": {"velocity": 40.0},
    "motor_error": {"error": 4},
    "position_jump": {"position": 0.7},
    "outside_limits": {"position": 3.3},
}


@pytest.mark.parametrize("code", WRONG)
def test_one_wrong_reading_is_no_fault_and_is_not_passed_on_and_two_are_a_fault(code):
    run = Run()
    run.run(5)
    run.cycle(**WRONG[code])
    run.cycle()
    assert run.readings.joints[1] == reading(time=run.readings.joints[1].time)
    run.run(5)
    assert not run.faults
    run.run(4, **WRONG[code])
    assert run.faults[0] == ("position_jump" if "position" in WRONG[code] else code)


def test_a_joint_outside_its_limits_is_a_fault():
    run = Run(speed=2.0)
    run.run(80)  # to 1.6 rad; the upper limit of joint 1 is 1.6
    assert not run.faults
    run.run(10)
    assert run.faults[0] == "outside_limits"


def test_a_loop_that_stood_still_has_not_asked():
    run = Run()
    run.run(5)
    run.cycle(late=1.0, lost=True)
    run.run(3)
    assert not run.faults


def test_a_motor_that_is_held_back_owes_no_reply():
    run = Run()
    run.run(5)
    run.run(6, held_back=True)
    run.run(3, lost=True)
    assert not run.faults and not run.readings.is_late
    run.run(5, lost=True)
    assert run.faults[0] == "motor_silent" and run.readings.is_late


@pytest.mark.parametrize(("misses", "is_silent"), [(6, False), (8, True)])
def test_a_motor_is_silent_after_seven_commands_without_a_reply(misses, is_silent):
    run = Run()
    run.run(5)
    run.run(misses, lost=True)
    assert run.readings.silent == [False, is_silent, False, False]
    assert run.faults[:1] == ["motor_silent"] * is_silent
