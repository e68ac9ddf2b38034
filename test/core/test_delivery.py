# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Does a motor deliver the torque that it gets, how loaded is it, and is it on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.delivery import THERMAL_TIME, DeliveryMonitor, MotorLoad
from exo_gravity.core.safety.drive import Send
from exo_gravity.core.safety.gate import SwitchOnCheck
from exo_gravity.core.safety.power import MotorPower, Power, PowerChange

from ..support.safety_run import LIMITS, PERIOD

PEAK = (9.0, 18.0, 9.0, 9.0)
EFFORT = (0.5, -3.8, 2.0, 1.0)  # Nm


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
def test_ordinary_motors_raise_no_false_alarm(rate):
    """Four motors reply one command old, behind a current loop, with noise; frames are lost both ways.

    The commands wander between -1 and 1 Nm as fast as the bridge lets them, and rest in between, mostly at zero torque:
    there the tolerance is least.
    """
    monitor, period, random = DeliveryMonitor(LIMITS, PEAK), 1.0 / rate, np.random.default_rng(4)
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
        assert monitor.step(period, joints, sent.tolist(), (0.0,) * 4) is None


def faults(torques, count=50, silence=0.0, rate=250.0, monitor=None, start=10.0):
    """Return the monitor and the faults that it finds in `count` replies to EFFORT, `silence` s late."""
    monitor = monitor or DeliveryMonitor(LIMITS, PEAK)
    times = [start + silence + n / rate for n in range(count)]
    replies = [[JointSample(0.5, 0.0, torque, 30, 0, time) for torque in torques] for time in times]
    return monitor, [monitor.step(1.0 / rate, joints, EFFORT, (0.0,) * 4) for joints in replies]


@pytest.mark.parametrize(("rate", "silence"), [(250.0, 0.0), (250.0, 0.02), (250.0, 0.04), (100.0, 0.0), (500.0, 0.0)])
@pytest.mark.parametrize(("joint", "latest"), [(1, 0.03), (2, 0.04), (3, 0.06)])
def test_missing_torque_is_noticed_the_sooner_the_more_it_is_and_after_a_restart_by_its_second_reply(
    rate, silence, joint, latest
):
    monitor, before = faults(EFFORT, rate=rate)
    assert not any(before)
    torques = [0.0 if i == joint else asked for i, asked in enumerate(EFFORT)]
    _, found = faults(torques, 100, silence, rate, monitor, 10.0 + 50 / rate)
    first = 1 + [fault is not None for fault in found].index(True)
    assert first / rate <= latest
    assert monitor.missing == tuple(i == joint for i in range(4))
    assert not silence or joint != 1 or first <= 2


def test_a_motor_that_comes_back_with_its_torque_is_no_fault():
    monitor = DeliveryMonitor(LIMITS, PEAK)
    assert not any(fault for n in range(50) for fault in faults(EFFORT, 1, 0.034 * n, monitor=monitor)[1])


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


def load_after(seconds: float, step: float, torque: float) -> list[tuple[float, float, float]]:
    """Return power, RMS torque and share of two motors; the second never replies."""
    load = MotorLoad((3.0, 9.0))
    return [
        load.update(number * step, (JointSample(0.0, 0.0, torque, 30, 0, 0.0), UNKNOWN))
        for number in range(round(seconds / step) + 1)
    ][-1]


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_constant_torque_warms_a_cold_motor_exponentially_whatever_the_period(step):
    (_, rms, share), (_, other, _) = load_after(THERMAL_TIME, step, 6.0)
    assert rms == pytest.approx(6.0 * math.sqrt(1.0 - math.exp(-1.0)), rel=1e-9)
    assert share == pytest.approx(rms / 3.0) and other == 0.0


def test_power_is_torque_times_speed_and_negative_where_the_motor_brakes():
    loads = MotorLoad((3.0, 9.0, 3.0)).update(
        1.0, [JointSample(0.0, 3.0, effort, 30, 0, 0.0) for effort in (2.0, -2.0)] + [UNKNOWN]
    )
    assert [power for power, *_ in loads] == [6.0, -6.0, 0.0]


IS_ON = (PowerChange.SWITCH_ON, PowerChange.SHOWN_ON)
TOLD = {  # changes; then whether each reply says that the motor is on, None for silence, and what must hold then
    **{
        f"left on, {change}": ([change], [(True, lambda power: power.state is Power.ON)])
        for change in (PowerChange.PROBED, PowerChange.TAKEN_OVER)
    },
    **{
        f"left off, {change}": (
            [change],
            [
                (False, lambda power: not power.is_quiet),
                (False, lambda power: power.is_quiet and power.state is not Power.ON),
            ],
        )
        for change in (PowerChange.PROBED, PowerChange.TAKEN_OVER)
    },
    "one wrong reply does not make a motor count as off": (
        IS_ON,
        [
            *((on, lambda power: not power.is_told_off) for on in (True, False, True, False, True, False)),
            (False, lambda power: power.is_told_off),
        ],
    ),
    "silence takes back what was told": (
        IS_ON, [(on, lambda power: not power.is_told_off) for on in (False, None, False)],
    ),
}  # fmt: skip


def tell(power: MotorPower, time: float, on: bool | None) -> None:
    sample = JointSample(0.0, 0.0, 0.0 if on else 0.5, 30, 0, time, bool(on))  # what a motor that is off may report
    power.step(PERIOD, sample, on is None)


@pytest.mark.parametrize("name", TOLD)
def test_replies_that_say_whether_a_motor_is_on_are_believed_as_the_row_says(name):
    power = MotorPower(replies=True)
    changes, replies = TOLD[name]
    for change in changes:
        power.change(change)
    for n, (on, holds) in enumerate(replies, 1):
        tell(power, n * PERIOD, on)
        assert holds(power), (n, power.state)


def test_a_motor_has_left_once_it_says_so_and_not_before() -> None:
    power = MotorPower(replies=True)
    for change in (*IS_ON, PowerChange.SWITCH_OFF):
        power.change(change)
    for n in range(20):  # it did not hear EXIT
        assert power.send(n * PERIOD) is Send.EXIT
        tell(power, (n + 1) * PERIOD, True)
    assert power.state is Power.LEAVING
    power.send(20 * PERIOD)
    tell(power, 21 * PERIOD, False)
    assert power.state is Power.OFF
