# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The bounds of every command: the last hand on it, the monitor of unexplained torque, and a joint that is let down."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.arm.paper import ArmModel, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointSample
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.descent import DESCENT, JointDescent
from exo_gravity.core.safety.explain import MOTION, MotionMonitor
from exo_gravity.core.safety.limits import DAMPING, DAMPING_RATE, MAX_EFFORT_RATE, Limits
from exo_gravity.core.safety.shape import BARRIER, VIBRATION, Shaper

from ..support import ROBOT
from ..support.safety_run import LIMITS, reading

PERIOD = 0.004  # s
WHOLE = (1.0,) * 4
HEARD = (False,) * 4
FULL = LIMITS.driven_speed + BARRIER.span  # rad/s


def barrier() -> Shaper:
    return Shaper(LIMITS, (DAMPING,) * 4)


def joints(**changes: float) -> list[JointSample]:
    return [reading(time=0.0, **changes)] * 4


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_drives_no_joint_beyond_the_barrier_and_below_it_brakes_none(sign):
    effort = (sign * 3.0, sign * 9.0, sign * 0.5, sign * 5.0)  # the last one beyond `max_effort`, as a let-down may be
    for speed in np.arange(-4.0, 4.0, 0.1):
        damping = barrier().damping(1.0, joints(velocity=sign * speed), HEARD, effort, NO_TORQUE, is_late=False)
        power = [speed * (abs(tau) - kd * speed) for tau, kd in zip(effort, damping, strict=True)]
        assert damping == NO_TORQUE or speed > LIMITS.driven_speed
        assert max(power) <= 1e-9 or speed < FULL


def damped(rate: float, lag: float, inertia: float = 0.0036) -> np.ndarray:
    """Return the speeds (n,) in rad/s of a joint whose damping rises, from 0.5 rad/s on, 4,000 a second for 3 s.

    rate: Hz of the loop. lag: s, of its motor's current loop; the velocity is filtered by 0.02 s. inertia: kg m^2.
    """
    arm, dt, friction = barrier(), 2.5e-4, 0.05
    speed = filtered = 0.5
    torque, speeds = 0.0, []
    for cycle in range(round(3.0 * rate)):
        asked = (min(DAMPING, DAMPING_RATE * cycle / rate),) * 4
        damping = arm.damping(1.0 / rate, joints(velocity=filtered), HEARD, NO_TORQUE, asked, is_late=False)
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
        damping = arm.damping(0.01, joints(velocity=speed), HEARD, NO_TORQUE, (DAMPING,) * 4, is_late=False)
    assert min(damping) == pytest.approx(least, abs=0.05)
    full = (DAMPING,) * 4
    assert arm.damping(10.0, joints(velocity=0.0), HEARD, NO_TORQUE, full, is_late=False) == full


def test_what_vibrates_without_damping_keeps_its_own_and_the_brake_of_a_driven_joint_stays():
    arm, tau = barrier(), (3.0,) * 4
    for asked, speed, effort, dt in ((NO_TORQUE, 0.0, NO_TORQUE, 0.01), ((DAMPING,) * 4, FULL, tau, 0.1)):
        for cycle in range(100):
            way = (-1.0) ** (cycle // 4)
            arm.damping(0.01, joints(velocity=0.5 * way), HEARD, NO_TORQUE, asked, is_late=False)
        damping = arm.damping(dt, joints(velocity=speed), HEARD, effort, (DAMPING,) * 4, is_late=False)
        assert damping == (DAMPING,) * 4 if not any(asked) else min(damping) >= 3.0 / FULL - 1e-9


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_while_a_motor_is_late_no_other_drives_its_joint_and_the_brake_ends_with_it(sign):
    arm, effort = barrier(), (sign * 2.0,) * 4
    for speed, power in ((BARRIER.calm, 0.5), (BARRIER.still, 0.0), (-1.0, -2.0)):
        damping = arm.damping(1.0, joints(velocity=sign * speed), HEARD, effort, NO_TORQUE, is_late=True)
        assert [speed * (2.0 - kd * speed) for kd in damping] == pytest.approx([power] * 4, abs=1e-9)
    assert arm.damping(1.0, joints(velocity=sign), HEARD, effort, NO_TORQUE, is_late=False) == NO_TORQUE


def test_the_brake_grows_without_a_step_and_falls_slowly():
    arm, effort, brakes = barrier(), (3.0, 9.0, 3.0, 3.0), []
    rising = np.arange(0.0, 3.0, 0.01)
    for speed in (*rising, *rising[::-1]):
        brakes.append(arm.damping(PERIOD, joints(velocity=float(speed)), HEARD, effort, NO_TORQUE, is_late=False)[1])
    assert max(brakes) > 3.0
    assert np.abs(np.diff(brakes)).max() < 0.35
    assert brakes[len(rising) + 155] > 0.01  # 1.44 rad/s on the way down, below `driven_speed`


@pytest.mark.parametrize("rate", [50.0, 100.0, 250.0, 500.0])
def test_the_brake_leads_a_joint_that_speeds_up_by_as_much_at_any_rate(rate):
    arm, acceleration, dt = barrier(), 10.0, 1.0 / rate  # rad/s^2, s
    for speed in np.arange(0.0, 2.0, acceleration * dt):
        brake = arm.damping(dt, joints(velocity=float(speed)), HEARD, (3.0,) * 4, NO_TORQUE, is_late=False)[0]
    led = speed + acceleration * BARRIER.lead - LIMITS.driven_speed
    assert brake == pytest.approx(3.0 / FULL * led / BARRIER.span, rel=1e-3) and arm.joints[0].cause == "brake (a)"


def test_the_speed_of_a_motor_that_does_not_reply_bounds_nothing():
    asked = (DAMPING,) * 4
    mute, bounded = (False, False, True, True), (1.0, 3.0, DAMPING, DAMPING)
    assert barrier().damping(1.0, joints(velocity=3.0), mute, NO_TORQUE, asked, is_late=False) == bounded
    assert barrier().damping(1.0, [UNKNOWN] * 4, (True,) * 4, (1.0,) * 4, asked, is_late=False) == asked


def test_a_clamped_joint_is_damped_while_it_sinks_and_free_while_it_is_lifted():
    arm, asked = barrier(), (3.0, 9.0, 2.0, 3.0)
    sinking = arm.shape(0.2, joints(velocity=-0.3), asked, WHOLE, asked, is_guided=False)
    given = arm.damping(0.2, joints(velocity=-0.3), HEARD, *sinking, is_late=False)
    assert given == sinking[1] == pytest.approx((DAMPING, DAMPING, 0.0, DAMPING))
    assert [joint.cause for joint in arm.joints[1:3]] == ["torque withheld (b)", ""]
    lifted = arm.shape(0.1, joints(velocity=0.3), asked, WHOLE, asked, is_guided=False)
    assert lifted[1] == pytest.approx((0.5 * DAMPING, 0.5 * DAMPING, 0.0, 0.5 * DAMPING))
    hot = barrier().shape(0.2, joints(velocity=-0.3, temperature=80), asked, WHOLE, (1.0,) * 4, is_guided=False)
    assert min(hot[1]) == pytest.approx(DAMPING)


def test_a_wall_pushes_back_before_a_joint_limit():
    low, high = LIMITS.position_min[3], LIMITS.position_max[3]
    for position, sign in ((low + 0.05, 1), (high - 0.05, -1)):
        arm = barrier()
        effort, damping = arm.shape(1.0, joints(position=position), NO_TORQUE, WHOLE, NO_TORQUE, is_guided=False)
        assert effort[3] == pytest.approx(sign * 1.25) and damping[3] == 5.0
        assert arm.joints[3].limiting == ["soft wall (d)"]


def descend(joint: JointDescent, velocity: float, duration: float) -> list[float]:
    """Let `joint` move at `velocity` rad/s; return the torques meanwhile, and before."""
    efforts = [joint.effort]
    for _ in range(round(duration / PERIOD)):
        joint.step(PERIOD, velocity)
        efforts.append(joint.effort)
    return efforts


DESCENTS: dict[str, tuple[tuple[float, float], list[Any]]] = {
    # Nm carried and at most; then rad/s and s of each motion, and what its torques in Nm and damping must be
    **{
        f"a joint under {carried} Nm that the wearer lifts is damped and not braked": (
            (carried, 3.0),
            [(carried / 2.0, 3.0, lambda efforts, damping, carried=carried: (
                efforts[-1] == 0.0 and damping == DAMPING and all(0.0 <= tau / carried <= 1.0 for tau in efforts)
            ))],
        )
        for carried in (2.0, -2.0)
    },
    "the brake returns at once to what the joint carried, and then grows slowly to `max_effort`": (
        (2.0, 9.0),
        [
            (1.0, 1.0, lambda efforts, damping: efforts[-1] == 0.0),
            (-1.0, 0.1, lambda efforts, damping: efforts[-1] == pytest.approx(2.0, abs=0.3)),
            (-1.0, 1.0, lambda efforts, damping: 4.0 < efforts[-1] < 5.5),
            (-1.0, 10.0, lambda efforts, damping: max(efforts) == 9.0),
        ],
    ),
    "the brake stays within `max_effort`": ((2.0, 3.0), [(-2.0, 10.0, lambda efforts, damping: max(efforts) == 3.0)]),
    "or what the joint carried": ((5.0, 3.0), [(-2.0, 10.0, lambda efforts, damping: max(efforts) == 5.0)]),
    "downwards, too": ((-5.0, 0.5), [(2.0, 10.0, lambda efforts, damping: min(efforts) == -5.0)]),
    "a torque that drives its joint goes to zero without a step": (
        (2.0, 9.0),
        [
            (-1.0, 3.0, lambda efforts, damping: True),
            (0.5, 0.5, lambda efforts, damping: (
                efforts[-1] == 0.0 and np.diff(efforts).min() >= -MAX_EFFORT_RATE * PERIOD * 1.0001
            )),
        ],
    ),
    "a joint that nothing moves loses its torque within two seconds, and then its damping": (
        (4.0, 9.0),
        [
            (0.0, 2.05, lambda efforts, damping: efforts[241] == pytest.approx(2.0, abs=0.1)),
            (0.0, 0.0, lambda efforts, damping: efforts[-1] == 0.0 < damping),
            (0.0, 4.0, lambda efforts, damping: damping == 0.0),
        ],
    ),
    "damping returns when a joint without torque moves too fast": (
        (0.0, 3.0),
        [
            (0.0, 6.0, lambda efforts, damping: damping == 0.0),
            (3.0 * DESCENT.speed, 0.25, lambda efforts, damping: damping == DAMPING and not any(efforts)),
        ],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("given", "motions"), DESCENTS.values(), ids=DESCENTS)
def test_a_joint_that_is_let_down_is_braked_as_its_row_says(given, motions):
    carried, most = given
    joint = JointDescent(carried, 0.0, most)
    for velocity, seconds, holds in motions:
        efforts = descend(joint, velocity, seconds)
        assert holds(efforts, joint.damping), (efforts[-1], joint.damping)
    assert joint.is_down is (joint.damping == 0.0)


@pytest.mark.parametrize("speed", [-2.2, 2.2])
def test_what_a_motor_that_replies_again_brakes_with_drives_nothing_and_what_it_holds_at_rest_is_its_torque(speed):
    joint = JointDescent(-0.13, 0.0, 3.0)
    braking = -3.0 * speed  # Nm, of damping on its way to DAMPING
    joint.resume(braking, speed)
    assert joint.effort == pytest.approx(-0.13)
    assert joint.effort - joint.damping * speed == pytest.approx(braking)
    joint.resume(3.7, 0.02)
    assert (joint.effort, joint.damping) == (3.7, 0.0)


WATCHED = Limits(("a", "b", "c", "d"), largest_moment=ROBOT.first_moment)
HANGING, RAISED = (0.0, 0.05, 0.05, 0.05), (0.0, 1.3, 0.2, 0.3)  # rad


def samples(theta: Sequence[float], velocity: float = 0.0) -> tuple[JointSample, ...]:
    return tuple(JointSample(angle, velocity, 0.0, None, None, 0.0) for angle in theta)


def torque_of(theta: Sequence[float], load: float = 1.0) -> tuple[float, ...]:
    return tuple(load * gravity_torque(ROBOT, theta))


@pytest.mark.parametrize("side", ["left", "right"])
def test_any_load_up_to_the_largest_moments_is_explained_in_any_pose_at_any_tilt(side: str) -> None:
    random = np.random.default_rng(0)
    monitor = MotionMonitor(WATCHED)
    for _ in range(100):
        theta, tilt = random.uniform(-1.6, 2.5, 4), Tilt.of(side, *random.uniform(-1.5, 1.5, 2))
        lighter = ArmModel.from_moments(ROBOT.length, random.uniform(0.0, 1.0, 4) * ROBOT.first_moment)
        monitor.follow(0.0, tilt, None)
        low, high = monitor.explained(theta)
        torque = gravity_torque(lighter, theta, tilt.direction)
        assert np.all(np.array(low) - 1e-3 <= torque) and np.all(torque <= np.array(high) + 1e-3)


GRAVITY = torque_of(RAISED)
OLD = torque_of((HANGING[0], HANGING[1] + 0.36, *HANGING[2:]))  # of a pose of 0.18 s ago, at 2 rad/s
JUDGED: dict[str, tuple[Any, float, dict[str, Any]]] = {
    # torque; s until the fault at most; and, where they are other than usual: pose, velocity, age, what may be added
    "the heaviest load": (GRAVITY, math.inf, {}),
    "no load": (NO_TORQUE, math.inf, {}),
    **{  # for the check that names it
        f"an impossible {torque} Nm": ((0.0, torque, 0.0, 0.0), math.inf, {}) for torque in (math.nan, math.inf, 41.0)
    },
    "three times the heaviest": (torque_of(RAISED, 3.0), 0.1, {}),
    "the wrong sign": (torque_of(RAISED, -1.0), 0.1, {}),
    "another pose": (GRAVITY, 0.1, {"theta": HANGING}),
    **{
        f"{push} Nm more, {name}": ((GRAVITY[0], GRAVITY[1] + push, *GRAVITY[2:]), latest, {"addition": addition})
        for push in (3.0, -6.0)
        for name, addition, latest in (
            ("unannounced", NO_TORQUE, 0.2),
            ("permitted", (0.0, 3.0, 0.0, 0.0), math.inf),
            ("permitted at other joints", (3.0, 0.0, 3.0, 3.0), 0.2),
        )
    },
    "as old as is still used while the wearer moves": (OLD, math.inf, {"theta": HANGING, "velocity": 2.0, "age": 0.18}),
    "too old for its age": (OLD, 0.8, {"theta": HANGING, "velocity": 2.0}),
}


@pytest.mark.parametrize(("torque", "latest", "given"), JUDGED.values(), ids=JUDGED)
def test_only_what_gravity_and_permitted_additions_explain_is_no_fault(torque, latest, given):
    """The time until the monitor finds a fault in a constant torque."""
    monitor = MotionMonitor(replace(WATCHED, largest_addition=given.get("addition", NO_TORQUE)))
    read, age = samples(given.get("theta", RAISED), given.get("velocity", 0.0)), given.get("age", 0.0)
    faults = [monitor.step(PERIOD, read, torque, age)[1] is not None for _ in range(500 if not age else 200)]
    found = faults.index(True) * PERIOD if any(faults) else math.inf
    assert found < latest or found == latest == math.inf


def test_a_torque_on_its_way_from_a_tilt_that_was_overtaken_is_no_fault_for_some_seconds_carried_or_not() -> None:
    before, lying = Tilt.of("left"), Tilt.of("left", math.radians(80.0), math.radians(-60.0))
    torque = gravity_torque(ROBOT, RAISED, before.direction)
    for overtaken, start, fault_after in ((None, 0.0, 0.0), (before, 0.0, MOTION.guided), (before, 60.0, 60.0)):
        monitor, now = MotionMonitor(WATCHED), 0.0
        while now < start or (now < 90.0 and not monitor.step(PERIOD, samples(RAISED), torque)[1]):
            monitor.follow(now, lying, None if now else overtaken)
            now += PERIOD
        assert fault_after <= now + PERIOD < fault_after + 0.2


def test_a_torque_that_follows_a_bow_and_its_return_is_no_fault() -> None:
    monitor, bowed = MotionMonitor(WATCHED), gravity_torque(ROBOT, RAISED, Tilt.of("left", 0.8).direction)
    for pitch in (*np.linspace(0.0, 1.4, 50), *np.linspace(1.4, 0.0, 50)):  # the torque is still in the bow
        monitor.follow(0.0, Tilt.of("left", pitch), Tilt.of("left") if pitch > 0.1 else None)
    assert not any(monitor.step(PERIOD, samples(RAISED), bowed)[1] for _ in range(200))


def test_unexplained_torque_is_not_passed_on() -> None:
    passed, _ = MotionMonitor(WATCHED).step(PERIOD, samples(RAISED), torque_of(RAISED, 2.5))
    needed = torque_of(RAISED)
    assert needed[1] < passed[1] < 1.5 * needed[1]
