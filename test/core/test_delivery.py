# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque in the replies: a motor that does not deliver is noticed, a noisy sensor is not, and a load adds up."""

import math

import numpy as np
import pytest

from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.delivery import THERMAL_TIME, DeliveryMonitor, MotorLoad
from exo_gravity.core.safety.gate import SwitchOnCheck

from ..support.safety_run import LIMITS, PERIOD

PEAK = (9.0, 18.0, 9.0, 9.0)
EFFORT = (0.5, -3.8, 2.0, 1.0)  # Nm


class Replies:
    """Replies of four motors to `EFFORT`, in Nm. now: s."""

    def __init__(self):
        self.monitor = DeliveryMonitor(LIMITS, PEAK)
        self.now = 10.0

    def take(self, torques):
        """One cycle with these replied torques; return the fault."""
        self.now += PERIOD
        joints = [JointSample(0.5, 0.0, torque, 30, 0, self.now) for torque in torques]
        return self.monitor.step(PERIOD, joints, EFFORT, (0.0,) * 4)

    def cycles_until_fault(self, torques):
        """Count the cycles with these torques until a fault."""
        return next(count for count in range(1, 100) if self.take(torques))


class OrdinaryMotors:
    """Four motors that reply one command old, behind a current loop, with noise; frames are lost both ways.

    The commands wander between -1 and 1 Nm as fast as the bridge lets them, and rest in between, mostly at zero torque:
    there the tolerance is least. Seeds make runs repeat.
    """

    def __init__(self, rate, lag=0.008, noise=0.15, loss=0.03):
        self.monitor = DeliveryMonitor(LIMITS, PEAK)
        self._period, self._loss, self._noise = 1.0 / rate, loss, noise
        self._share = 1.0 - math.exp(-self._period / lag)
        self._random = np.random.default_rng(4)
        self._aim, self._sent = np.zeros(4), np.zeros(4)
        self._received, self._applied = np.zeros(4), np.zeros(4)
        self._joints = [JointSample(0.5, 0.0, 0.0, 30, 0, 0.0)] * 4
        self._time = 0.0

    def faults(self, seconds):
        """Count the cycles in `seconds` s in which the monitor found a fault."""
        return sum(self._cycle() is not None for _ in range(round(seconds / self._period)))

    def _cycle(self):
        random, period = self._random, self._period
        self._time += period
        if random.random() < 2.0 * period:  # twice a second
            self._aim = random.uniform(-1.0, 1.0, 4) * (random.random() < 0.3)
        self._sent = self._sent + np.clip(self._aim - self._sent, -50.0 * period, 50.0 * period)
        replied = self._applied + random.normal(0.0, self._noise, 4)
        arrive, return_ = random.random((2, 4)) >= self._loss
        for i in np.flatnonzero(arrive & return_):
            self._joints[i] = JointSample(0.5, 0.0, float(replied[i]), 30, 0, self._time)
        self._received = np.where(arrive, self._sent, self._received)
        self._applied = self._applied + self._share * (self._received - self._applied)
        return self.monitor.step(period, self._joints, self._sent.tolist(), (0.0,) * 4)


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
def test_ordinary_motors_raise_no_false_alarm(rate):
    assert OrdinaryMotors(rate).faults(8.0) == 0


@pytest.mark.parametrize("rate", [100.0, 500.0])
@pytest.mark.parametrize("torque", [1.0, 3.0])
def test_torque_that_is_missing_is_noticed_within_30_ms_at_any_rate(rate, torque):
    monitor, period = DeliveryMonitor(LIMITS, PEAK), 1.0 / rate
    taken = [None] * 4
    for step in range(1, 200):
        replied = torque if step * period < 0.2 else 0.0
        joints = [JointSample(0.5, 0.0, replied, 30, 0, step * period)] * 4
        taken.append(monitor.step(period, joints, (torque,) * 4, (0.0,) * 4))
    assert next(step for step, fault in enumerate(taken[4:], 1) if fault) * period <= 0.23


@pytest.mark.parametrize("silence", [0.0, 0.02, 0.04])
def test_a_motor_that_applies_nothing_is_noticed_within_60_ms_and_after_a_restart_by_its_second_reply(silence):
    for joint in (1, 2, 3):
        replies = Replies()
        assert not any(replies.take(EFFORT) for _ in range(100))
        replies.now += silence
        count = replies.cycles_until_fault([0.0 if i == joint else asked for i, asked in enumerate(EFFORT)])
        assert count * PERIOD <= 0.06
        assert replies.monitor.missing == tuple(i == joint for i in range(4))
        assert not silence or joint != 1 or count <= 2


def test_a_motor_that_comes_back_with_its_torque_is_no_fault():
    replies = Replies()
    for _ in range(50):
        assert not replies.take(EFFORT)
        replies.now += 0.03


def test_a_current_sensor_with_5_percent_noise_raises_no_false_alarm():
    replies, random = Replies(), np.random.default_rng(1)
    noise = 0.05 * np.maximum(2.0, np.abs(EFFORT))
    assert not any(replies.take(EFFORT + noise * random.standard_normal(4)) for _ in range(10_000))


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


def sample(effort: float, velocity: float = 0.0) -> JointSample:
    return JointSample(0.0, velocity, effort, 30, 0, 0.0)


def load_after(seconds: float, step: float, torque: float) -> list[tuple[float, float, float]]:
    """Return power, RMS torque and share of two motors; the second never replies."""
    load = MotorLoad((3.0, 9.0))
    return [load.update(number * step, (sample(torque), UNKNOWN)) for number in range(round(seconds / step) + 1)][-1]


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_constant_torque_warms_a_cold_motor_exponentially_whatever_the_period(step):
    (_, rms, _), (_, other, _) = load_after(THERMAL_TIME, step, 6.0)
    assert rms == pytest.approx(6.0 * math.sqrt(1.0 - math.exp(-1.0)), rel=1e-9)
    assert other == 0.0


def test_a_torque_above_rated_is_overload_only_when_it_lasts():
    assert load_after(5.0, 0.1, 6.0)[0][2] < 1.0
    assert load_after(60.0, 0.1, 6.0)[0][2] > 1.0
    assert load_after(600.0, 0.1, 2.9)[0][2] < 1.0


def test_power_is_torque_times_speed_and_negative_where_the_motor_brakes():
    loads = MotorLoad((3.0, 9.0, 3.0)).update(1.0, (sample(2.0, 3.0), sample(-2.0, 3.0), UNKNOWN))
    assert [power for power, *_ in loads] == [6.0, -6.0, 0.0]
