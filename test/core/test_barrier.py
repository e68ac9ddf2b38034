# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The last hand on every drive: what it limits, and that no arm is thrown, by the truth of the simulated device."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.safety.barrier import BARRIER, VIBRATION, Barrier, Shaped
from exo_gravity.core.safety.descent import DESCENT
from exo_gravity.core.safety.limits import DAMPING, MAX_EFFORT_RATE

from ..support.safety_run import LIMITS, PERIOD, SafetyRun, reading

NOTHING = (0.0,) * 4
WHOLE = (1.0,) * 4
HEARD = (False,) * 4
FULL = LIMITS.driven_speed + BARRIER.span  # rad/s


def barrier() -> Barrier:
    return Barrier(LIMITS, (DAMPING,) * 4)


def joints(**changes: float) -> list[JointSample]:
    return [reading(time=0.0, **changes)] * 4


def shaped(effort: tuple[float, ...] = NOTHING, **changes: float) -> Shaped:
    """Return what joints get after a second in which they read `changes`."""
    return barrier().shape(1.0, joints(**changes), effort, WHOLE, NOTHING, NOTHING)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_drives_no_joint_beyond_the_barrier_and_below_it_brakes_none(sign):
    effort = (sign * 3.0, sign * 9.0, sign * 0.5, sign * 5.0)  # the last one beyond `max_effort`, as a let-down may be
    for speed in np.arange(-4.0, 4.0, 0.1):
        damping = barrier().damping(1.0, joints(velocity=sign * speed), HEARD, effort, NOTHING, is_late=False)
        power = [speed * (abs(tau) - kd * speed) for tau, kd in zip(effort, damping, strict=True)]
        assert damping == NOTHING or speed > LIMITS.driven_speed
        assert max(power) <= 1e-9 or speed < FULL


def damped(rate: float, lag: float, inertia: float = 0.0036) -> np.ndarray:
    """Return the speeds (n,) in rad/s of a joint whose damping rises, from 0.5 rad/s on, 4,000 a second for 3 s.

    rate: Hz of the loop. lag: s, of its motor's current loop; the velocity is filtered by 0.02 s. inertia: kg m^2.
    """
    arm, dt, friction = barrier(), 2.5e-4, 0.05
    speed = filtered = 0.5
    torque, speeds = 0.0, []
    for cycle in range(round(3.0 * rate)):
        asked = (min(DAMPING, DESCENT.damping_rate * cycle / rate),) * 4
        damping = arm.damping(1.0 / rate, joints(velocity=filtered), HEARD, NOTHING, asked, is_late=False)
        for _ in range(round(1.0 / (rate * dt))):
            filtered += (speed - filtered) * dt / 0.02
            torque += (max(-9.0, min(9.0, -damping[3] * filtered)) - torque) * dt / lag
            speed += (torque - friction * math.tanh(100.0 * speed)) / inertia * dt
            speeds.append(speed)
    return np.abs(speeds)


@pytest.mark.parametrize("rate", [100.0, 250.0])
def test_a_light_joint_behind_a_slow_motor_does_not_go_on_vibrating_under_its_damping(rate):
    speeds = damped(rate, lag=0.008)
    assert speeds.max() < 6.0
    assert speeds[-4000:].max() < 0.1


@pytest.mark.parametrize(("frequency", "least"), [(1.0, DAMPING), (6.0, DAMPING), (10.0, VIBRATION.least)])
def test_only_what_turns_faster_than_people_shake_gets_less_damping(frequency, least):
    arm = barrier()
    for cycle in range(100):
        speed = 0.5 * math.sin(2.0 * math.pi * frequency * 0.01 * cycle)
        damping = arm.damping(0.01, joints(velocity=speed), HEARD, NOTHING, (DAMPING,) * 4, is_late=False)
    assert min(damping) == pytest.approx(least, abs=0.05)
    later = arm.damping(10.0, joints(velocity=0.0), HEARD, NOTHING, (DAMPING,) * 4, is_late=False)
    assert later == (DAMPING,) * 4


def test_what_vibrates_without_damping_keeps_its_own_and_the_brake_of_a_driven_joint_stays():
    arm, tau = barrier(), (3.0,) * 4
    for cycle in range(100):
        arm.damping(0.01, joints(velocity=0.5 * (-1.0) ** (cycle // 4)), HEARD, NOTHING, NOTHING, is_late=False)
    assert arm.damping(0.01, joints(velocity=0.0), HEARD, NOTHING, (DAMPING,) * 4, is_late=False) == (DAMPING,) * 4
    for cycle in range(100):
        way = (-1.0) ** (cycle // 4)
        arm.damping(0.01, joints(velocity=0.5 * way), HEARD, NOTHING, (DAMPING,) * 4, is_late=False)
    driven = arm.damping(0.1, joints(velocity=FULL), HEARD, tau, (DAMPING,) * 4, is_late=False)
    assert min(driven) >= 3.0 / FULL - 1e-9


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_while_a_motor_is_late_no_other_drives_its_joint_and_the_brake_ends_with_it(sign):
    arm, effort = barrier(), (sign * 2.0,) * 4
    for speed, power in ((BARRIER.calm, 0.5), (BARRIER.still, 0.0), (-1.0, -2.0)):
        damping = arm.damping(1.0, joints(velocity=sign * speed), HEARD, effort, NOTHING, is_late=True)
        assert [speed * (2.0 - kd * speed) for kd in damping] == pytest.approx([power] * 4, abs=1e-9)
    assert arm.damping(1.0, joints(velocity=sign), HEARD, effort, NOTHING, is_late=False) == NOTHING


def test_the_brake_grows_without_a_step_and_falls_slowly():
    arm, effort, brakes = barrier(), (3.0, 9.0, 3.0, 3.0), []
    rising = np.arange(0.0, 3.0, 0.01)
    for speed in (*rising, *rising[::-1]):
        brakes.append(arm.damping(PERIOD, joints(velocity=float(speed)), HEARD, effort, NOTHING, is_late=False)[1])
    assert max(brakes) > 3.0
    assert np.abs(np.diff(brakes)).max() < 0.35
    assert brakes[len(rising) + 155] > 0.01  # 1.44 rad/s on the way down, below `driven_speed`


def test_an_arm_that_speeds_up_fast_is_braked_before_it_is_fast():
    slowly, suddenly = barrier(), barrier()
    effort = (3.0,) * 4
    for speed in (0.0, 0.4, 0.8, 1.2):
        slow = slowly.damping(0.1, joints(velocity=speed), HEARD, effort, NOTHING, is_late=False)
        sudden = suddenly.damping(0.002, joints(velocity=speed), HEARD, effort, NOTHING, is_late=False)
    assert slow == NOTHING and min(sudden) > 0.3


@pytest.mark.parametrize("rate", [50.0, 100.0, 250.0, 500.0])
def test_the_brake_leads_a_joint_that_speeds_up_by_as_much_at_any_rate(rate):
    arm, acceleration, dt = barrier(), 10.0, 1.0 / rate  # rad/s^2, s
    for speed in np.arange(0.0, 2.0, acceleration * dt):
        brake = arm.damping(dt, joints(velocity=float(speed)), HEARD, (3.0,) * 4, NOTHING, is_late=False)[0]
    led = speed + acceleration * BARRIER.lead - LIMITS.driven_speed
    assert brake == pytest.approx(3.0 / FULL * led / BARRIER.span, rel=1e-3)


def test_damping_times_speed_stays_within_max_effort_in_every_drive():
    for state in ("carried", "let down"):
        arm = SafetyRun().until_active()
        if state == "let down":
            arm.machine.disable(arm.now)
            arm.cycle(0.5)
            assert min(arm.drive.damping) == DAMPING
        arm.changes = [{"velocity": 3.6, "position": LIMITS.position_max[n] - 0.02} for n in range(4)]
        arm.cycle(2 * PERIOD)
        torque = [3.6 * damping for damping in arm.drive.damping]
        assert all(kd <= most + 1e-9 for kd, most in zip(torque, LIMITS.max_effort, strict=True))
        assert max(torque) > 0.0


def test_the_speed_of_a_motor_that_does_not_reply_bounds_nothing():
    asked = (DAMPING,) * 4
    mute, bounded = (False, False, True, True), (1.0, 3.0, DAMPING, DAMPING)
    assert barrier().damping(1.0, joints(velocity=3.0), mute, NOTHING, asked, is_late=False) == bounded
    assert barrier().damping(1.0, [UNKNOWN] * 4, (True,) * 4, (1.0,) * 4, asked, is_late=False) == asked


def test_a_clamped_joint_is_damped_while_it_sinks_and_free_while_it_is_lifted():
    asked = (3.0, 9.0, 2.0, 3.0)
    arm = barrier()
    sinking = arm.shape(0.2, joints(velocity=-0.3), asked, WHOLE, asked, NOTHING)
    assert sinking.damping == pytest.approx((DAMPING, DAMPING, 0.0, DAMPING))
    lifted = arm.shape(0.1, joints(velocity=0.3), asked, WHOLE, asked, NOTHING)
    assert lifted.damping == pytest.approx((0.5 * DAMPING, 0.5 * DAMPING, 0.0, 0.5 * DAMPING))
    hot = barrier().shape(0.2, joints(velocity=-0.3, temperature=80), asked, WHOLE, (1.0,) * 4, NOTHING)
    assert min(hot.damping) == pytest.approx(DAMPING)


def test_torque_exceeds_neither_its_limit_nor_its_rate():
    arm = SafetyRun().until_active()
    arm.steps.clear()
    arm.effort = (39.0, -39.0, 39.0, -39.0)
    arm.cycle(1.0)
    assert arm.drive.effort == (3.0, -9.0, 3.0, -3.0)
    assert max(arm.steps) <= MAX_EFFORT_RATE * PERIOD * 1.0001
    assert "max_effort (b)" in arm.machine.acted


def test_a_hot_motor_gets_less_torque():
    arm = SafetyRun().until_active()
    arm.effort = (3.0, 9.0, 3.0, 3.0)
    arm.changes[1].update(temperature=75)
    arm.cycle(1.0)
    assert arm.drive.effort[1] == pytest.approx(6.75)
    assert "derating (b)" in arm.machine.acted


@pytest.mark.parametrize("rate", [20.0, 100.0, 500.0])
@pytest.mark.parametrize("inertia", [0.005, 0.03, 0.3])
@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_the_soft_wall_never_throws_a_joint_back_faster_than_it_came(rate, inertia, speed):
    """One joint without friction or gravity runs into its wall; the motor applies torque and damping at once."""
    period, limit, arm = 1.0 / rate, LIMITS.position_max[0], barrier()
    position, velocity, torque = limit - 0.15, speed, 0.0
    for _ in range(int(4.0 * rate)):
        read = joints(position=position, velocity=round(velocity / 0.022) * 0.022)
        limited = arm.shape(period, read, NOTHING, WHOLE, (torque,) * 4, NOTHING)
        torque, *_ = limited.effort
        damping, *_ = arm.damping(period, read, HEARD, limited.effort, limited.damping, is_late=False)
        end = torque / damping if damping else math.inf  # rad/s, where the damping balances the torque
        if damping:
            decay = math.exp(-damping / inertia * period)
            position += end * period + (velocity - end) * (1.0 - decay) * inertia / damping
            velocity = end + (velocity - end) * decay
        else:
            position += (velocity + 0.5 * torque / inertia * period) * period
            velocity += torque / inertia * period
        assert velocity >= -speed
    assert position < limit + 6.0 * max(0.1, speed * period)


def test_a_wall_pushes_back_before_a_joint_limit():
    low, high = LIMITS.position_min[3], LIMITS.position_max[3]
    for position, sign in ((low + 0.05, 1), (high - 0.05, -1)):
        limited = shaped(position=position)
        assert limited.effort[3] == pytest.approx(sign * 1.25)
        assert limited.damping[3] == 5.0
        assert "soft wall (d)" in limited.acted


def test_an_impossible_effort_is_refused_by_name():
    with pytest.raises(ParameterError, match="effort of b"):
        shaped((0.0, math.nan, 0.0, 0.0))
