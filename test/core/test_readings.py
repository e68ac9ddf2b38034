# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a motor replies: one wrong reading, silence, and angles and velocities that contradict each other."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import UNKNOWN
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.safety.trust import Readings

from ..support.safety_run import LIMITS, reading
from ..support.thorough import quick

PERIOD = 0.01  # s


class Run:
    """Four motors that turn at `speed` rad/s; faults: the codes found so far."""

    def __init__(self, speed: float = 0.0) -> None:
        self.readings = Readings(LIMITS)
        self.speed, self.now = speed, 10.0
        self.faults: list[str] = []
        self._joints, self._held_back = [UNKNOWN] * 4, (False,) * 4
        self.run(2)
        self.faults.clear()  # silent before the first replies
        self.run(5)

    def run(
        self,
        count: int = 1,
        late: float = 0.0,
        lost: bool = False,
        held_back: bool = False,
        **changes: Any,
    ) -> Run:
        """Run `count` cycles, in which the loop stands still for `late` s before it takes the replies.

        lost: the second motor's reply does not come. held_back: that motor is sent nothing. changes: of its reading.
        """
        for _ in range(count):
            self.readings.step(self.now, tuple(self._joints), self._held_back)
            self._held_back = (False, held_back, False, False)
            self.faults += [str(self.readings.fault.code)] if self.readings.fault else []
            usual = {"position": self.speed * (self.now - 10.0), "velocity": self.speed}  # when the motors reply
            self.now += PERIOD + late
            for i in range(4):
                if not ((lost or held_back) and i == 1):
                    self._joints[i] = reading(**{**usual, "time": self.now - 0.009, **(changes if i == 1 else {})})
        return self


WRONG = {
    "over_temperature": {"temperature": 120},
    "over_speed": {"velocity": 40.0},
    "motor_error": {"error": 4},
    "position_jump": {"position": 0.7},
    "outside_limits": {"position": 3.3},
}


@pytest.mark.parametrize("code", WRONG)
def test_one_wrong_reading_is_no_fault_and_is_not_passed_on_and_two_are_a_fault(code):
    run = Run().run(**WRONG[code]).run()
    assert run.readings.joints[1] == reading(time=run.readings.joints[1].time)
    assert not run.run(5).faults
    assert run.run(4, **WRONG[code]).faults[0] == ("position_jump" if "position" in WRONG[code] else code)


def test_a_joint_outside_its_limits_is_a_fault():
    run = Run(speed=2.0)
    assert not run.run(75).faults  # to 1.6 rad; the upper limit of joint 1 is 1.6
    assert run.run(10).faults[0] == "outside_limits"


def test_a_loop_that_stood_still_has_not_asked_and_a_motor_that_is_held_back_owes_no_reply():
    assert not Run().run(late=1.0, lost=True).run(3).faults
    run = Run().run(6, held_back=True).run(3, lost=True)
    assert not run.faults and not run.readings.is_late
    assert run.run(5, lost=True).faults[0] == "motor_silent" and run.readings.is_late


@pytest.mark.parametrize(("misses", "is_silent"), [(6, False), (8, True)])
def test_a_motor_is_silent_after_seven_commands_without_a_reply(misses, is_silent):
    run = Run().run(misses, lost=True)
    assert run.readings.silent == [False, is_silent, False, False]
    assert run.faults[:1] == ["motor_silent"] * is_silent


SPEC = MOTORS["AK80-9"]
CODE = 2.0 * SPEC.velocity_range / 4095.0  # rad/s of the velocity on the wire
STEP = 0.001  # s


@dataclass(frozen=True)
class Motor:
    """The second motor of an arm. lag: s by which its velocity follows. scale: of the velocity that it replies."""

    lag: float = 0.02
    scale: float = 1.0
    creep: float = 0.0  #: rad/s by which its encoder slips
    frozen: bool = False  #: its angle


class Motion:
    """Follows a joint at `angle(time)` rad through replies as ordinary equipment delivers them, at `rate` Hz.

    slip: rad, of the encoder. lost_trust: s, when; inf for never. faults: codes found.
    """

    def __init__(self, angle: Callable[[float], float], motor: Motor, rate: float, is_busy: bool) -> None:
        self.readings = Readings(LIMITS)
        self.slip = 0.0
        self.faults: set[FaultCode] = set()
        self._angle, self._motor, self._period, self._is_busy = angle, motor, 1.0 / rate, is_busy
        self._random = random.Random(7)
        self._velocity, self._seen = 0.0, angle(0.0)
        self.now = 0.0
        self._joints = [reading(time=0.0, position=angle(0.0))] * 4
        for _ in range(2):
            self._cycle()
        self.readings.prove()

    def run(self, seconds: float) -> Motion:
        end = self.now + seconds
        while self.now < end:
            self._cycle()
        return self

    def _cycle(self) -> None:
        late = 0.02 if self._is_busy and self._random.random() < 0.1 else 0.0
        self._pass(self._period)
        if not (self._is_busy and self._random.random() > 0.97**2):
            position = 0.0 if self._motor.frozen else self._angle(self.now) + self.slip
            position += self._motor.creep * self.now
            velocity = (math.floor(self._motor.scale * self._velocity / CODE) + 0.5) * CODE
            self._pass(late)  # the loop stands still before it takes the reply
            given = reading(time=self.now, position=position, velocity=velocity)
            self._joints = [given if n == 1 else reading(time=self.now) for n in range(4)]
        self.readings.step(self.now, self._joints, (False,) * 4)
        if self.readings.fault:
            self.faults.add(self.readings.fault.code)

    def _pass(self, seconds: float) -> None:
        """Let time pass for the motor, which measures its velocity by its encoder."""
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            angle = self._angle(self.now) + self.slip
            measured = (angle - self._seen) / STEP
            self._velocity += (measured - self._velocity) * (1.0 - math.exp(-STEP / max(1e-6, self._motor.lag)))
            self._velocity = max(-SPEC.velocity_range, min(SPEC.velocity_range, self._velocity))
            self._seen = angle


def knocked(now: float) -> float:
    """Twice a second a knock of 5 rad/s, there and back, within 30 ms."""
    return 0.02 * 4.9 * max(0.0, 1.0 - abs(now % 0.5 - 0.05) / 0.02)


def reaching(now: float) -> float:
    """Reaches to and fro, at up to 4.4 rad/s: with the largest wrong `velocity_range`, 4.9 by the velocity."""
    return 1.0 - 0.8 * math.cos(5.5 * now)


def resting(now: float) -> float:
    return 0.3


SCALES, ANGLES, RATES = (1.0, 0.9, 50.0 / 45.0), (knocked, reaching, resting), (100.0, 250.0, 500.0)
QUICK = [(0.9, knocked, 100.0), (1.0, reaching, 250.0), (50.0 / 45.0, knocked, 500.0), (1.0, resting, 100.0)]


@pytest.mark.parametrize(("scale", "angle", "rate"), quick(QUICK, itertools.product(SCALES, ANGLES, RATES)))
def test_ordinary_equipment_keeps_trust_while_a_wearer_reaches_and_the_arm_is_knocked(rate, angle, scale):
    motion = Motion(angle, Motor(scale=scale), rate, is_busy=True).run(20.0)
    assert motion.readings.trusted
    assert not motion.faults


UNTRUE = {  # a motor, what its joint does, for how many s at which rate, and the fault
    "a velocity_range 2.2 times too large": (Motor(scale=2.2), "one reach"),
    "2.2 times too small": (Motor(scale=1 / 2.2), "one reach"),
    "a velocity of the wrong sign": (Motor(scale=-1.0), "one reach"),
    "an angle that is frozen": (Motor(frozen=True), "one reach"),
    "a slow slip": (Motor(creep=0.2), "rest"),
}


@pytest.mark.parametrize(("motor", "motion"), UNTRUE.values(), ids=UNTRUE)
def test_an_angle_and_a_velocity_that_contradict_each_other_are_found_within_one_reach(motor, motion):
    is_reach = motion == "one reach"
    angle = (lambda now: 1.0 - math.cos(min(math.pi, 2.0 * now))) if is_reach else resting
    seen = Motion(angle, motor, 100.0, is_busy=is_reach).run(1.5 if is_reach else 3.0)
    assert not seen.readings.trusted
    assert not is_reach or seen.faults == {FaultCode.READINGS_CONTRADICT}


@pytest.mark.parametrize("lag", [0.0, 0.02], ids=["at once", "filtered"])
@pytest.mark.parametrize("rate", [100.0, 500.0])
def test_a_lost_turn_ends_trust_whatever_the_velocity_shows(lag, rate):
    motion = Motion(resting, Motor(lag=lag), rate, is_busy=False).run(0.5)
    motion.slip = math.radians(40.0)  # a turn of its rotor, at the joint
    motion.run(0.2)
    assert not motion.readings.trusted
    assert motion.faults <= {FaultCode.POSITION_JUMP, FaultCode.OVER_SPEED}
