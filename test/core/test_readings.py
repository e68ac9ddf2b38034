# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the motors' replies show: wrong readings, silence, contradictions; whether they are on, and deliver."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.start import SwitchOnCheck
from exo_gravity.core.safety.watch import ArmWatch, JointWatch, Power, PowerChange

from ..support.safety_run import LIMITS, reading
from ..support.thorough import quick

SPEC = MOTORS["AK80-9"]
CODE = 2.0 * SPEC.velocity_range / 4095.0  # rad/s of the velocity on the wire
STEP, PERIOD = 0.001, 0.004  # s


def resting(now: float) -> float:
    return 0.0


class Replies:
    """Those of four motors at rest, but for the second one, whose joint is at `angle(time)` rad, at `rate` Hz.

    is_busy: whether they are lost and late as those of ordinary equipment are. lag: s by which its velocity follows.
    scale: of the velocity that it replies. creep: rad/s by which its encoder slips. frozen: its angle. faults: the
    codes found so far.
    """

    def __init__(
        self,
        angle: Callable[[float], float] = resting,
        rate: float = 100.0,
        is_busy: bool = False,
        lag: float = 0.0,
        scale: float = 1.0,
        creep: float = 0.0,
        frozen: bool = False,
    ) -> None:
        self.watch = ArmWatch(LIMITS)
        self.now = self._velocity = 0.0
        self._angle, self._period, self._is_busy = angle, 1.0 / rate, is_busy
        self._lag, self._scale, self._creep, self._frozen = lag, scale, creep, frozen
        self._random, self._seen, self._joints = random.Random(7), angle(0.0), [UNKNOWN] * 4
        self.faults: list[str] = []
        self.run(2).watch.trusted = True
        self.faults.clear()  # silent before the first replies
        self.run(5)

    def run(
        self, count: int = 1, late: float = 0.0, lost: bool = False, held_back: bool = False, **changes: Any
    ) -> Replies:
        """Run `count` cycles, in which the loop stands still for `late` s before it takes the replies.

        lost: the second motor's reply does not come. held_back: that motor is sent nothing. changes: of its reading.
        """
        for _ in range(count):
            self._pass(self._period)
            if self._is_busy:
                late = 0.02 if self._random.random() < 0.1 else 0.0
                lost = self._random.random() > 0.97**2
            position = (0.0 if self._frozen else self._angle(self.now)) + self._creep * self.now
            velocity = (math.floor(self._scale * self._velocity / CODE) + 0.5) * CODE
            self._pass(late)
            read = reading(**{"time": self.now, "position": position, "velocity": velocity, **changes})
            second = self._joints[1] if lost or held_back else read
            self._joints = [second if n == 1 else reading(time=self.now) for n in range(4)]
            self.watch.read(self.now, self._joints, (False, held_back, False, False))
            self.faults += [str(self.watch.fault.code)] if self.watch.fault else []
        return self

    def _pass(self, seconds: float) -> None:
        """Let time pass for the motor, which measures its velocity by its encoder."""
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            angle = self._angle(self.now)
            share = 1.0 - math.exp(-STEP / max(1e-6, self._lag))
            self._velocity += ((angle - self._seen) / STEP - self._velocity) * share
            self._velocity = max(-SPEC.velocity_range, min(SPEC.velocity_range, self._velocity))
            self._seen = angle


WRONG = {
    "over_temperature": {"temperature": 120},
    "over_speed": {"velocity": 40.0},
    "motor_error": {"error": 4},
    "position_jump": {"position": 0.7},
    "outside_limits": {"position": 3.3},
}


@pytest.mark.parametrize("code", WRONG)
def test_one_wrong_reading_is_no_fault_and_is_not_passed_on_and_two_are_a_fault(code):
    run = Replies()
    before = run.watch.samples[1]
    assert run.run(**WRONG[code]).watch.samples[1]._replace(time=0.0) == before._replace(time=0.0)
    assert not run.run(5).faults
    assert run.run(4, **WRONG[code]).faults[0] == ("position_jump" if "position" in WRONG[code] else code)


@pytest.mark.parametrize(("readings", "faults"), [(7, []), (9, ["over_speed"])])
def test_a_slap_on_the_table_is_no_over_speed_and_a_joint_that_stays_fast_is(readings, faults):
    assert Replies(rate=250.0).run(3).run(readings, velocity=7.0).faults == faults  # rad/s, the usual limit is 5


def test_a_joint_outside_its_limits_is_a_fault():
    run = Replies(lambda now: -now)
    assert not run.run(12).faults  # to -0.19 rad; the lower limit of joint 2 is -0.2
    assert run.run(40).faults[0] == "outside_limits"


def test_a_loop_that_stood_still_has_not_asked_and_a_motor_that_is_held_back_owes_no_reply():
    assert not Replies().run(late=1.0, lost=True).run(3).faults
    run = Replies().run(6, held_back=True).run(3, lost=True)
    assert not run.faults and not run.watch.is_late
    assert run.run(5, lost=True).faults[0] == "motor_silent" and run.watch.is_late


@pytest.mark.parametrize(("misses", "is_silent"), [(6, False), (8, True)])
def test_a_motor_is_silent_after_seven_commands_without_a_reply(misses, is_silent):
    run = Replies().run(misses, lost=True)
    assert run.watch.silent == [False, is_silent, False, False]
    assert run.faults[:1] == ["motor_silent"] * is_silent


def knocked(now: float) -> float:
    """Twice a second a knock of 5 rad/s, there and back, within 30 ms."""
    return 0.02 * 4.9 * max(0.0, 1.0 - abs(now % 0.5 - 0.05) / 0.02)


def reaching(now: float) -> float:
    """Reaches to and fro, at up to 4.4 rad/s: with the largest wrong `velocity_range`, 4.9 by the velocity."""
    return 1.0 - 0.8 * math.cos(5.5 * now)


SCALES, ANGLES, RATES = (1.0, 0.9, 50.0 / 45.0), (knocked, reaching, resting), (100.0, 250.0, 500.0)
QUICK = [(0.9, knocked, 100.0), (1.0, reaching, 250.0), (50.0 / 45.0, knocked, 500.0), (1.0, resting, 100.0)]


@pytest.mark.parametrize(("scale", "angle", "rate"), quick(QUICK, itertools.product(SCALES, ANGLES, RATES)))
def test_ordinary_equipment_keeps_trust_while_a_wearer_reaches_and_the_arm_is_knocked(rate, angle, scale):
    run = Replies(angle, rate, True, 0.02, scale).run(round(20.0 * rate))
    assert run.watch.trusted and not run.faults


UNTRUE = {  # a motor, what its joint does, for how many s at which rate, and the fault
    "a velocity_range 2.2 times too large": ({"scale": 2.2}, "one reach"),
    "2.2 times too small": ({"scale": 1 / 2.2}, "one reach"),
    "a velocity of the wrong sign": ({"scale": -1.0}, "one reach"),
    "an angle that is frozen": ({"frozen": True}, "one reach"),
    "a slow slip": ({"creep": 0.2}, "rest"),
}


@pytest.mark.parametrize(("motor", "motion"), UNTRUE.values(), ids=UNTRUE)
def test_an_angle_and_a_velocity_that_contradict_each_other_are_found_within_one_reach(motor, motion):
    is_reach = motion == "one reach"
    angle = (lambda now: 1.0 - math.cos(min(math.pi, 2.0 * now))) if is_reach else resting
    run = Replies(angle, is_busy=is_reach, lag=0.02, **motor).run(150 if is_reach else 300)
    assert not run.watch.trusted
    assert not is_reach or set(run.faults) == {"readings_contradict"}


def test_a_motor_that_replies_again_where_its_velocity_says_has_lost_no_turn():
    run = Replies(reaching, rate=250.0).run(60)  # at 4 rad/s
    assert not set(run.run(18, lost=True).run(3).faults) - {"motor_silent"} and run.watch.trusted


EFFORT = (0.5, -3.8, 2.0, 1.0)  # Nm


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
def test_ordinary_motors_raise_no_false_alarm(rate):
    """Four motors reply one command old, behind a current loop, with noise; frames are lost both ways.

    The commands wander between -1 and 1 Nm as fast as the bridge lets them, and rest in between, mostly at zero torque:
    there the tolerance is least.
    """
    watch, period, random = ArmWatch(LIMITS), 1.0 / rate, np.random.default_rng(4)
    aim, sent, received, applied = np.zeros((4, 4))
    joints = [JointSample(0.5, 0.0, 0.0, 30, 0, 0.0)] * 4
    for cycle in range(round(8.0 * rate)):
        if random.random() < 2.0 * period:  # twice a second
            aim = random.uniform(-1.0, 1.0, 4) * (random.random() < 0.3)
        sent = sent + np.clip(aim - sent, -50.0 * period, 50.0 * period)
        replied = applied + random.normal(0.0, 0.15, 4)
        arrive, return_ = random.random((2, 4)) >= 0.03
        for i in np.flatnonzero(arrive & return_):
            joints[i] = JointSample(0.5, 0.0, float(replied[i]), 30, 0, (cycle + 1) * period)
        received = np.where(arrive, sent, received)
        applied = applied + (1.0 - math.exp(-period / 0.008)) * (received - applied)
        assert judged(watch, joints, period, sent.tolist()) is None


def judged(watch, samples, period, effort):
    """Return the fault that these replies to `effort` are."""
    for joint, sample in zip(watch.joints, samples, strict=True):
        joint.sample = sample
    return watch.judge_torques(period, effort, (0.0,) * 4)


def faults(torques, count=50, silence=0.0, rate=250.0, watch=None, start=10.0):
    """Return the watch and the faults that it finds in `count` replies to EFFORT, `silence` s late."""
    watch = watch or ArmWatch(LIMITS)
    times = [start + silence + n / rate for n in range(count)]
    replies = [[JointSample(0.5, 0.0, torque, 30, 0, time) for torque in torques] for time in times]
    return watch, [judged(watch, joints, 1.0 / rate, EFFORT) for joints in replies]


@pytest.mark.parametrize(("rate", "silence"), [(250.0, 0.0), (250.0, 0.02), (250.0, 0.04), (100.0, 0.0), (500.0, 0.0)])
@pytest.mark.parametrize(("joint", "latest"), [(1, 0.03), (2, 0.04), (3, 0.06)])
def test_missing_torque_is_noticed_the_sooner_the_more_it_is_and_after_a_restart_by_its_second_reply(
    rate, silence, joint, latest
):
    watch, before = faults(EFFORT, rate=rate)
    assert not any(before)
    torques = [0.0 if i == joint else asked for i, asked in enumerate(EFFORT)]
    _, found = faults(torques, 100, silence, rate, watch, 10.0 + 50 / rate)
    first = 1 + [fault is not None for fault in found].index(True)
    assert first / rate <= latest
    assert [own.is_missing for own in watch.joints] == [i == joint for i in range(4)]
    assert not silence or joint != 1 or first <= 2


def test_a_motor_that_comes_back_with_its_torque_is_no_fault():
    watch = ArmWatch(LIMITS)
    assert not any(fault for n in range(50) for fault in faults(EFFORT, 1, 0.034 * n, watch=watch)[1])


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
@pytest.mark.parametrize("is_on", [True, False])
def test_motors_that_are_on_pass_and_one_that_is_off_does_not_whatever_the_noise(rate, is_on):
    """Replies come 15 ms late with 0.15 Nm of noise; 6 % are lost. Each of 20 starts is judged right."""
    random, period = np.random.default_rng(6), 1.0 / rate
    delay = math.ceil(0.015 / period)
    for _ in range(20):
        check, fault, now = SwitchOnCheck(LIMITS), None, 0.0
        joints, commanded = [JointSample(0.5, 0.0, 0.0, 30, 0, 0.0)] * 4, [[0.0] * 4] * delay
        while not (check.done or fault):
            now += period
            fault = check.step(period, joints, (0.0,) * 4)
            commanded.append(list(check.effort))
            applied = np.array(commanded[-1 - delay]) * (1.0, 1.0, 1.0, is_on) + random.normal(0.0, 0.15, 4)
            for i in np.flatnonzero(random.random(4) > 0.06):
                joints[i] = JointSample(0.5, 0.0, float(applied[i]), 30, 0, now)
        assert check.done is is_on
        assert now < 0.6
        assert is_on or fault.reason.startswith("d: the motor did not switch on")


def test_a_light_joint_that_moves_when_pushed_has_shown_that_its_motor_is_on():
    check, velocity, damping, now = SwitchOnCheck(LIMITS), [0.0] * 4, (1.5,) * 4, 0.0
    while not check.done:
        now += PERIOD
        torque = [effort - 1.5 * speed for effort, speed in zip(check.effort, velocity, strict=True)]
        joints = [JointSample(0.5, speed, net, 30, 0, now) for speed, net in zip(velocity, torque, strict=True)]
        assert not check.step(PERIOD, joints, damping)
        velocity = [speed + net / 0.005 * PERIOD for speed, net in zip(velocity, torque, strict=True)]  # 0.005 kg m^2


IS_ON = (PowerChange.SWITCH_ON, PowerChange.SHOWN_ON)
TOLD = {  # changes; then whether each reply says that the motor is on, None for silence, and what must hold then
    **{
        f"left on, {change}": ([change], [(True, lambda motor: motor.power is Power.ON)])
        for change in (PowerChange.PROBED, PowerChange.TAKEN_OVER)
    },
    **{
        f"left off, {change}": (
            [change],
            [
                (False, lambda motor: not motor.is_quiet),
                (False, lambda motor: motor.is_quiet and motor.power is not Power.ON),
            ],
        )
        for change in (PowerChange.PROBED, PowerChange.TAKEN_OVER)
    },
    "one wrong reply does not make a motor count as off": (
        IS_ON,
        [
            *((on, lambda motor: not motor.reports_off) for on in (True, False, True, False, True, False)),
            (False, lambda motor: motor.reports_off),
        ],
    ),
    "a motor has left once it says so, and not before": (  # it did not hear EXIT at first
        (*IS_ON, PowerChange.SWITCH_OFF),
        [
            *[(True, lambda motor: motor.power is Power.LEAVING)] * 20,
            (False, lambda motor: motor.power is Power.OFF),
        ],
    ),
    "silence takes back what was told": (
        IS_ON, [(on, lambda motor: not motor.reports_off) for on in (False, None, False)],
    ),
}  # fmt: skip


def tell(motor: JointWatch, time: float, on: bool | None) -> None:
    sample = JointSample(0.0, 0.0, 0.0 if on else 0.5, 30, 0, time, bool(on))  # what a motor that is off may report
    motor.is_silent = on is None
    motor.note_power(PERIOD, sample, is_new=True)


@pytest.mark.parametrize("name", TOLD)
def test_replies_that_say_whether_a_motor_is_on_are_believed_as_the_row_says(name):
    motor = JointWatch(LIMITS, 0)
    changes, replies = TOLD[name]
    for change in changes:
        motor.change(change)
    for n, (on, holds) in enumerate(replies, 1):
        motor.send((n - 1) * PERIOD)
        tell(motor, n * PERIOD, on)
        assert holds(motor), (n, motor.power)
