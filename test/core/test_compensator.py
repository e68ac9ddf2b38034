# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator through time: late tilts, changes of load, the trunk's motion, a command that fades, more support."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.interface import NO_LOAD, Payload
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import TISSUE_REACH, Wearer
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.load_change import TOUCH, CommandFade, GuidedChange, TouchWatch
from exo_gravity.core.compensation.support import NAME, REQUEST
from exo_gravity.core.compensation.terms.catalogue import Spring
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.trunk.inputs import TILT
from exo_gravity.core.vocabulary import Withdrawal

from ..support import ROBOT
from ..support.compensator_run import PERIOD, THETA, CompensatorRun, settings_with


def test_without_a_fresh_tilt_there_is_a_reason_instead_of_a_torque():
    run = CompensatorRun(use_imu=True)
    assert run.cycle()[:2] == (None, (Withdrawal.NO_TILT, "no trunk tilt yet"))
    run.compensator.tilt.set_tilt(run.now, 0.0, 0.0, age=-TILT.lead)
    assert run.cycle(0.078).held == ""
    assert run.cycle(0.004).held.startswith("trunk tilt older than 80 ms: held on")
    assert run.cycle(0.02).reason.text == "trunk tilt older than 80 ms"
    run = CompensatorRun(use_imu=True)
    run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
    with pytest.raises(ParameterError):
        run.compensator.tilt.set_tilt(run.now, math.nan, 0.0)
    assert run.cycle().effort and run.cycle(0.082).effort is None  # one before a refused one is not held on


@pytest.mark.parametrize("acceleration", [-4.0, 0.0, 4.0])
def test_a_late_tilt_is_extrapolated_within_the_bound_that_it_states_and_then_withdrawn(acceleration):
    run = CompensatorRun(use_imu=True)
    for _ in range(600):  # past the ramp
        run.compensator.tilt.set_gravity(run.now, (0.0, 0.0, -1.0), (0.0, 0.3, 0.0))
        run.cycle()
    start, held = run.now, 0
    while (answer := run.cycle()).effort is not None:
        late = run.now - start
        tilt = Tilt.of("left", 0.3 * late + acceleration * late**2 / 2, 0.0)
        error = np.abs(np.subtract(answer.effort, gravity_torque(ROBOT, THETA, tilt.direction))).max()
        if answer.held:
            held += 1
            assert error <= float(answer.held.split()[-2])
    assert held * PERIOD == pytest.approx(TILT.hold - 0.08, abs=2 * PERIOD)
    assert answer.reason.text == "trunk tilt older than 80 ms"


@pytest.mark.parametrize(
    "theta",
    [(0.0, 0.0, 0.0), (0.0, 0.0, math.nan, 0.0), (math.inf, 0.0, 0.0, 0.0), (0.0, 0.0, 1e308, 1e308), (0, -27, 0, 0)],
)
def test_impossible_joint_angles_get_no_torque(theta):
    answer = CompensatorRun().cycle(theta=theta)
    assert answer.effort is None
    assert "not 4 numbers within 26 rad" in answer.reason.text


def test_after_a_break_nothing_is_left_of_a_change():
    run = CompensatorRun(mode="zero_g")
    run.cycle(2.0)
    run.compensator.apply(settings_with())
    assert run.cycle(0.5).remainder
    run.now += 0.2
    answer = run.cycle()
    assert answer.effort == pytest.approx(gravity_torque(ROBOT, THETA)) and answer.remainder == ()


MEASURED_WEARER = {
    "mode": "zero_g",
    "wearer_moments": ((0.18, 0.468, 0.8, 0.272), (0.0, -0.044, 0.04, 0.048)),
    "tissue": Springs((1.5, 1.0, 0.5, 0.8), (0.1, 0.4, 0.3, 0.9), TISSUE_REACH),
}
SPRING = TermSettings(spring=Spring((2.0, 4.0, 2.0, 1.0), pose=(0.5, 0.3, 0.3, 0.4), max_effort=(1.0,) * 4))


@pytest.mark.parametrize(
    "change",
    [{"mode": "zero_g"}, {"max_effort": (0.5,) * 4}, {"terms": SPRING}, MEASURED_WEARER],
    ids=["mode", "limits", "a spring", "another wearer"],
)
def test_a_change_reaches_the_arm_without_a_step_and_is_taken_back_as_gently(change):
    run = CompensatorRun()
    one, two = (np.array(each.cycle(1.5).effort) for each in (run, CompensatorRun(**change)))
    for settings, before, after in ((settings_with(**change), one, two), (settings_with(), two, one)):
        run.compensator.apply(settings)
        duration = np.maximum(GUIDANCE.time, np.abs(after - before) / GUIDANCE.rate)
        run.cycle(0.5)
        np.testing.assert_allclose(run.efforts[-1], before + 0.5 / duration * (after - before), atol=0.02)
        run.cycle(duration.max() - 0.5 + PERIOD)
        np.testing.assert_allclose(run.efforts[-1], after, rtol=1e-12)
    assert run.largest_step <= GUIDANCE.rate * PERIOD * 1.001


def test_a_joint_that_the_change_drives_gets_its_old_torque_back_until_it_is_calm():
    run = CompensatorRun(mode="zero_g")
    run.cycle(1.5)
    before = run.efforts[-1]
    run.compensator.apply(settings_with())
    run.cycle(GUIDANCE.time / 2)
    answer = run.cycle(1.0, velocity=(0.0, -1.0, 0.0, 0.0))
    assert answer.effort[1] == pytest.approx(before[1])  # and no more, however long it falls
    assert answer.remainder[1] == pytest.approx(before[1] - gravity_torque(ROBOT, THETA)[1])
    assert abs(answer.effort[3]) < abs(before[3])
    assert run.cycle(3.0).remainder == ()
    assert run.efforts[-1] == pytest.approx(gravity_torque(ROBOT, THETA))


def test_a_change_during_another_begins_for_each_joint_where_that_joint_is():
    """A joint that is at the new load and one that is still at the old one: a constant would outlive their pose."""
    loads = {"light": 1.0, "heavy": 3.0, "middle": 2.0}
    change: GuidedChange[str] = GuidedChange(2)

    def needs(load, pose=1.0):
        return (pose * loads[load],) * 2

    change.set_out(["heavy"], needs("heavy"), needs, needs("light"))
    while change.remainder[0] != 0.0 or not change.remainder[1]:
        torque = change.follow(0.01, (0.0, -1.0), needs, needs("light"))
    assert torque == (1.0, 3.0)  # joint 2 sinks: it keeps the heavy load
    change.set_out(["light"], torque, needs, needs("middle"))
    for pose in (1.0, 0.1, -1.0):  # of what every load needs, after the joints have turned
        torque = change.follow(0.0, (1.0, 1.0), lambda load, pose=pose: needs(load, pose), needs("middle", pose))
        assert torque == pytest.approx((pose * 1.0, pose * 3.0))


def test_while_the_trunk_turns_and_the_joints_move_the_torque_is_one_that_a_tilt_on_the_way_needs():
    """A constant that made up for the rest was wrong in the next pose: relaxed wearers who bowed were let down."""
    compensator = Compensator(settings_with(mode="zero_g", use_imu=True))
    tilts = [Tilt.of("left", 0.0, angle) for angle in np.linspace(-0.6, 0.6, 5)]
    for time in np.arange(0.0, 4.0, PERIOD):  # more than a turn of the trunk to and fro
        turn = 0.6 * math.sin(2.0 * time)
        compensator.tilt.set_gravity(time, (0.0, -math.sin(turn), -math.cos(turn)))
        theta = np.array(THETA) + 0.7 * math.sin(1.7 * time)
        velocity = (0.7 * 1.7 * math.cos(1.7 * time),) * 4
        effort = compensator.step(time, theta.tolist(), velocity).effort
        needed = np.array([compensator.settings.exact.torque(theta.tolist(), tilt) for tilt in tilts])
        assert np.all(effort > needed.min(axis=0) - 0.3)
        assert np.all(effort < needed.max(axis=0) + 0.3)


def is_untouched(carried, pressed=(0.0, 0.0, 0.0), lacking=(0.0, 0.0, 0.0), every=1, speed=0.5, cycles=(0.004,)):
    """Return what is seen of a robot whose motors carry more than itself, while something presses on its joints, Nm.

    every: it presses in one of so many cycles. speed: rad/s, of a joint that nothing presses on. cycles: s, by turns.
    """
    watch, momentum, found = TouchWatch(), np.zeros(3), []
    for n, dt in enumerate(cycles * round(4.0 * TOUCH.time / sum(cycles))):
        found.append(
            watch.step(watch.time + dt if n else 0.0, speed, momentum, *map(np.array, (carried, carried, lacking)))
        )
        momentum = momentum + cycles[(n + 1) % len(cycles)] * np.add(carried, np.multiply(pressed, n % every == 0))
    return any(found)


def test_a_robot_is_untouched_if_all_joints_are_free_two_carry_more_and_motors_apply_what_is_asked_or_it_is_fast():
    loaded, worn, noisy = (3.0, 2.0, 0.3), (-3.0, -2.0, -0.3), (0.0, 0.0, 1.0)
    answers = [is_untouched(loaded), is_untouched(loaded, worn), is_untouched(loaded, (0.0, 0.0, -0.5))]
    answers += [
        is_untouched((3.0, 0.3, 0.3)),
        is_untouched(loaded, lacking=loaded),
        is_untouched(loaded, noisy, every=4),
        is_untouched(loaded, lacking=loaded, speed=2.0),
        is_untouched(loaded, worn, lacking=loaded, speed=2.0),
        is_untouched(loaded, cycles=(0.05,)),
        is_untouched(loaded, worn, cycles=(0.008, 0.1)),
    ]
    assert answers == [True, False, False, False, False, True, True, False, True, False]


def test_where_the_velocity_is_not_known_a_change_takes_longer_and_settings_that_change_no_torque_begin_none():
    run = CompensatorRun(mode="zero_g")
    run.cycle(1.5)
    run.compensator.apply(settings_with(mode="zero_g", tilt_timeout=0.1))
    assert run.cycle().remainder == ()
    run.compensator.apply(settings_with())
    assert run.cycle(GUIDANCE.longest - 0.1, velocity=None).remainder
    assert not run.cycle(GUIDANCE.watch + 0.2, velocity=None).remainder


def test_a_low_limit_of_the_torques_rate_makes_no_torque_of_a_moving_arm_false_and_a_change_begins_from_a_limited_one():
    run = CompensatorRun(max_effort_rate=1.0)
    for n in range(250):
        theta = np.add(THETA, n * PERIOD)
        run.cycle(theta=theta, velocity=(1.0,) * 4)
    assert run.efforts[-1] == pytest.approx(gravity_torque(ROBOT, theta), abs=1e-9)
    run.cycle()  # elsewhere at once
    run.compensator.apply(settings_with(max_effort_rate=1000.0))
    run.cycle(0.1)
    assert run.largest_step < 0.03


def test_too_large_a_torque_is_clamped_and_the_joint_named():
    answer = CompensatorRun(max_effort=(3.0, 1.0, 3.0, 3.0)).cycle(2.0)
    assert answer.effort[1] == 1.0
    assert answer.clamped == (1,)


FORCE = (1.0, -2.0, 11.0)  # m/s^2 upward; an upright trunk that accelerates forward, to the right and upward
DOWN = np.array((2.0, -1.0, 11.0))  # the same as gravity in the left arm's base frame: x0 left, y0 forward, z0 down
STILL = (0.0, 0.0, 0.0)


MEASURED, SPIN_UP = {"use_imu": True, "inertial": True}, (1.0, 2.0, -0.5)  # and rad/s^2
FELT = np.linalg.norm(DOWN) / 9.80665 * np.array(gravity_torque(ROBOT, THETA, DOWN / np.linalg.norm(DOWN)))
TURNED = np.add(gravity_torque(ROBOT, THETA), ROBOT.turning_torque("left", THETA, SPIN_UP))


@pytest.mark.parametrize(
    ("force", "spin_up", "changes", "expected"),
    [
        (FORCE, STILL, MEASURED, FELT),
        ((0.0, 0.0, 9.80665), SPIN_UP, MEASURED, TURNED),
        (FORCE, SPIN_UP, {"use_imu": True}, gravity_torque(ROBOT, THETA)),
        (FORCE, SPIN_UP, {"inertial": True}, gravity_torque(ROBOT, THETA)),
        (None, SPIN_UP, MEASURED, gravity_torque(ROBOT, THETA)),
    ],
    ids=["a force", "a trunk that turns faster and faster", "not inertial", "without an IMU", "no motion measured"],
)
def test_the_specific_force_replaces_gravity_and_the_arm_turns_with_the_trunk(force, spin_up, changes, expected):
    """On an upright trunk that feels `force` and turns faster by `spin_up`, in samples at 100 Hz."""
    run = CompensatorRun(**changes)
    for cycle in range(650):
        if cycle % 5 == 0:
            run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
            if force is not None:
                run.compensator.motion.add(run.now, force, [run.now * component for component in spin_up])
        run.cycle()
    np.testing.assert_allclose(run.efforts[-1], expected, rtol=1e-5)
    run.cycle(0.1)
    if changes.get("use_imu"):  # whatever the motion, a tilt is too old
        run.compensator.motion.add(run.now, FORCE, STILL)
        assert "older than 80 ms" in run.cycle().reason.text


EFFORT = (2.0, -4.0)
NOTHING = (0.0, 0.0)


def active(now: float = 10.0) -> CommandFade:
    fade = CommandFade(0.05)
    fade.withdraw(now, "no trunk tilt yet")
    assert fade.tick(now) is None and fade.state == "waiting" and not fade.problem
    assert fade.take(now, EFFORT, EFFORT, NOTHING) == EFFORT
    assert fade.tick(now + 0.04) is None  # while efforts arrive
    return fade


@pytest.mark.parametrize("reason", ["no joint_states younger than 50 ms", "trunk tilt older than 80 ms"])
def test_late_or_withdrawn_efforts_fade_to_zeros_that_go_on_until_an_operator_cleared_the_fault(reason):
    fade = active()
    if reason.startswith("trunk"):
        fade.withdraw(10.06, reason)
        fade.withdraw(10.5, "another")
    assert fade.tick(10.06) == EFFORT
    assert not fade.take(10.1, EFFORT, NOTHING, NOTHING) and not fade.clear()
    assert fade.tick(11.06) == pytest.approx((1.0, -2.0))
    assert fade.tick(12.07) == fade.tick(100.0) == NOTHING
    assert fade.problem == f"{reason}: zero, call clear_fault"
    assert not fade.take(100.0, EFFORT, NOTHING, NOTHING) and fade.state == "zero"
    assert fade.clear() and fade.take(100.1, EFFORT, NOTHING, NOTHING)


def test_the_first_efforts_begin_from_what_a_controller_holds_since_its_last_sender_died():
    fade, held, last = CommandFade(0.05), (3.59, -1.0), (3.59, -1.0)
    early = CommandFade(0.05)
    assert early.take(10.0, NOTHING, held, NOTHING) == held
    early.withdraw(10.01, "no trunk tilt")
    assert early.tick(10.01) == held and early.tick(12.1) == NOTHING
    for cycle in range(151):  # 1.5 s at 100 Hz
        effort = fade.take(10.0 + 0.01 * cycle, EFFORT, held, NOTHING)
        assert max(abs(a - b) for a, b in zip(effort, last, strict=True)) <= 0.01 * GUIDANCE.rate + 1e-9
        last = effort
    assert last == EFFORT


LOAD = Wearer(75.0).on_links(ROBOT.length)
GIVEN: dict[str, Any] = {
    "side": "right", "mode": "zero_g", "support": 0.4, "support_adapts": True, "max_effort": (18.0,) * 4,
    "wearer_mass": LOAD.mass.tolist(), "wearer_cog": LOAD.cog.tolist(),
}  # fmt: skip
SETTINGS = settings_with(**GIVEN)
ASKED_AT, STEP = (0.0, 0.9, 0.7, 0.6), 0.01


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
        for _ in range(round(duration / STEP)):
            if self.asked is not None and len(self.efforts) % 20 == 0:
                request, stamp = self.compensator.support_request, self.now - self.lag
                request.receive(self.now, self.names, (self.asked,), stamp, self.from_another)
            self.answer = self.cycle(STEP, ASKED_AT, STEP)
        return self.compensator.settings.support_now

    @property
    def report(self) -> str:
        return self.compensator.support_request.report(self.now).text


def raised() -> Arm:
    """Return an arm that carries 70 % on request."""
    arm = Arm()
    assert arm.report == "none"
    arm.asked = 0.7
    assert arm.run(4.0) == 0.7 and arm.report == "70 %"
    return arm


def test_what_is_asked_for_is_carried_by_a_guided_change_until_2_s_after_the_last_good_request() -> None:
    arm = raised()
    mass = ROBOT.total_mass + 0.7 * sum(SETTINGS.wearer_mass)
    assert arm.compensator.settings.arm.total_mass == pytest.approx(mass)
    share = ROBOT.with_wearer(SETTINGS.wearer_mass, SETTINGS.wearer_cog, 0.7)
    assert arm.answer.effort == pytest.approx(gravity_torque(share, ASKED_AT))
    arm.asked = math.nan  # which counts as little as silence
    assert arm.run(REQUEST.expires - 0.3) == 0.7
    assert arm.run(0.4) == 0.4 and arm.answer.remainder
    arm.run(4.0)
    assert not arm.answer.remainder and arm.largest_step < 0.5


def test_the_support_changes_once_in_a_guided_changes_time_however_often_the_request_does() -> None:
    arm, changes = Arm(), []
    for number in range(200):
        arm.asked, before = 0.4 + 0.6 * (number % 2), arm.compensator.settings.support_now
        changes += [arm.now] if arm.run(STEP * 7) != before else []
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
        ({"payload": Payload(0.5)}, 0.7),
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
    assert arm.compensator.settings.payload == change.get("payload", NO_LOAD)


def test_a_change_that_is_not_yet_in_use_is_not_lost_when_the_support_rises() -> None:
    arm = Arm()
    arm.compensator.support_request.receive(arm.now, (NAME,), (0.6,), arm.now)
    arm.compensator.apply(replace(SETTINGS, payload=Payload(0.5)))
    assert arm.run(STEP) == 0.6
    assert arm.compensator.settings.payload.mass == 0.5
