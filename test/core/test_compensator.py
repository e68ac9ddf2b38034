# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The compensator gives no torque without fresh and finite input, and no change of settings steps the torque."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.guidance import GuidedChange
from exo_gravity.core.compensation.terms.catalogue import Spring
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.trunk.inputs import TILT

from ..support.compensator_run import PERIOD, ROBOT, THETA, CompensatorRun, settings_with


def test_every_answer_is_the_torque_of_the_law_from_the_first_one_on():
    run = CompensatorRun()
    run.cycle(0.1)
    np.testing.assert_allclose(run.efforts, [gravity_torque(ROBOT, THETA)] * len(run.efforts), rtol=1e-12)


def test_without_a_fresh_tilt_there_is_a_reason_instead_of_a_torque():
    run = CompensatorRun(use_imu=True)
    assert run.cycle()[:2] == (None, "no trunk tilt yet")
    run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
    assert run.cycle().effort is not None
    assert "older than 80 ms" in run.cycle(0.1).reason


def test_a_tilt_is_as_old_as_its_stamp():
    run = CompensatorRun(use_imu=True)
    for _ in range(100):
        run.compensator.tilt.set_tilt(run.now, 0.1, 0.0, age=0.07)
        assert run.cycle().effort is not None
    for _ in range(20):
        run.compensator.tilt.set_tilt(run.now, 0.1, 0.0, age=0.09)
        answer = run.cycle()
    assert answer.reason == "trunk tilt older than 80 ms by its stamp: the IMU driver lags, or its clock differs"


def test_a_stamp_ahead_of_the_clock_makes_a_tilt_no_younger_than_its_arrival():
    run = CompensatorRun(use_imu=True)
    run.compensator.tilt.set_tilt(run.now, 0.0, 0.0, age=-TILT.lead)
    assert run.cycle(0.078).held == ""
    assert run.cycle(0.004).held.startswith("trunk tilt older than 80 ms: held on")
    assert run.cycle(0.02).reason == "trunk tilt older than 80 ms"


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
    assert answer.reason == "trunk tilt older than 80 ms"
    before = [effort for effort in run.efforts if effort is not None][-1]
    run.compensator.tilt.set_gravity(run.now, (math.sin(0.1), 0.0, -math.cos(0.1)), (0.0, 0.3, 0.0))
    after = run.cycle()
    assert after.held == "" and np.abs(np.subtract(after.effort, before)).max() < 50.0 * 2 * PERIOD + 1e-9


def test_a_tilt_whose_successor_was_refused_is_not_held_on():
    run = CompensatorRun(use_imu=True)
    run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
    with pytest.raises(ParameterError):
        run.compensator.tilt.set_tilt(run.now + 0.01, math.nan, 0.0)
    assert run.cycle(0.082).effort is None


@pytest.mark.parametrize("age", [-3600.0, -0.06, 1.01, 3600.0, math.nan, math.inf])
def test_a_stamp_of_another_clock_is_refused_and_the_reason_names_it(age):
    run = CompensatorRun(use_imu=True)
    with pytest.raises(ParameterError, match="synchronise the clocks"):
        run.compensator.tilt.set_tilt(run.now, 0.0, 0.0, age)
    reason = run.cycle().reason
    assert "no trunk tilt yet (the newest was refused: age of the trunk tilt by its stamp must be from" in reason
    run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
    assert run.cycle().effort is not None


@pytest.mark.parametrize(
    "theta",
    [(0.0, 0.0, 0.0), (0.0, 0.0, math.nan, 0.0), (math.inf, 0.0, 0.0, 0.0), (0.0, 0.0, 1e308, 1e308), (0, -27, 0, 0)],
)
def test_impossible_joint_angles_get_no_torque(theta):
    run = CompensatorRun()
    run.cycle(2.0)
    answer = run.cycle(theta=theta)
    assert answer.effort is None
    assert "not 4 numbers within 26 rad" in answer.reason


def test_after_a_break_nothing_is_left_of_a_change():
    run = CompensatorRun(mode="zero_g")
    run.cycle(2.0)
    run.compensator.apply(settings_with())
    assert run.cycle(0.5).remainder
    run.now += 0.2
    answer = run.cycle()
    assert answer.effort == pytest.approx(gravity_torque(ROBOT, THETA)) and answer.remainder == ()


def test_zero_g_carries_the_wearers_arm_in_proportion_to_the_support():
    run = CompensatorRun(mode="zero_g", support=0.5)
    run.cycle(1.2)
    arm = ROBOT.with_wearer((0.0, 0.0, 2.0, 1.6), (0.0, 0.0, 0.16, 0.17), 0.5)
    np.testing.assert_allclose(run.efforts[-1], gravity_torque(arm, THETA), rtol=1e-12)


def test_a_change_of_mode_reaches_the_arm_without_a_step():
    run = CompensatorRun()
    run.cycle(1.5)
    run.efforts.clear()
    run.compensator.apply(settings_with(mode="zero_g"))
    one, two = (gravity_torque(settings_with(mode=mode).arm, THETA) for mode in ("one_g", "zero_g"))
    duration = np.maximum(GUIDANCE.time, np.abs(two - one) / GUIDANCE.rate)
    run.cycle(0.5)
    np.testing.assert_allclose(run.efforts[-1], one + 0.5 / duration * (two - one), rtol=0.01)
    run.cycle(duration.max() - 0.5 + PERIOD)
    np.testing.assert_allclose(run.efforts[-1], two, rtol=1e-12)
    assert run.largest_step <= GUIDANCE.rate * PERIOD * 1.001


SPRING = TermSettings(spring=Spring((2.0, 4.0, 2.0, 1.0), pose=(0.5, 0.3, 0.3, 0.4), max_effort=(1.0,) * 4))


def test_springs_and_limits_are_switched_on_and_off_without_a_step_also_during_another_change():
    run = CompensatorRun()
    run.cycle(1.5)
    run.efforts.clear()
    changes = ({"terms": SPRING}, {"max_effort": (0.5,) * 4}, {}, {"mode": "zero_g", "terms": SPRING}, {})
    for seconds in (GUIDANCE.time + 1.0, 0.6):
        for change in changes:
            run.compensator.apply(settings_with(**change))
            run.cycle(seconds)
    assert run.largest_step <= GUIDANCE.rate * PERIOD * 1.001
    assert run.cycle(GUIDANCE.time + 1.0).effort == pytest.approx(gravity_torque(ROBOT, THETA))


def test_a_joint_that_the_change_drives_gets_its_old_torque_back_until_it_is_calm():
    run = CompensatorRun(mode="zero_g")
    run.cycle(1.5)
    before = run.efforts[-1]
    run.compensator.apply(settings_with())
    run.cycle(GUIDANCE.time / 2)
    falling = (0.0, -1.0, 0.0, 0.0)
    answer = run.cycle(1.0, velocity=falling)
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

    change.begin("heavy", needs("heavy"), needs, needs("light"))
    while change.remainder[0] != 0.0 or not change.remainder[1]:
        torque = change.step(0.01, (0.0, -1.0), needs, needs("light"))
    assert torque == (1.0, 3.0)  # joint 2 sinks: it keeps the heavy load
    change.begin("light", torque, needs, needs("middle"))
    for pose in (1.0, 0.1, -1.0):  # of what every load needs, after the joints have turned
        torque = change.step(0.0, (1.0, 1.0), lambda load, pose=pose: needs(load, pose), needs("middle", pose))
        assert torque == pytest.approx((pose * 1.0, pose * 3.0))


def test_where_the_velocity_is_not_known_a_change_takes_longer():
    run = CompensatorRun(mode="zero_g")
    run.cycle(1.5)
    run.compensator.apply(settings_with())
    assert run.cycle(GUIDANCE.longest - 0.1, velocity=None).remainder
    assert not run.cycle(GUIDANCE.watch + 0.2, velocity=None).remainder


def test_settings_that_change_no_torque_begin_no_change():
    run = CompensatorRun()
    run.cycle(1.5)
    run.compensator.apply(settings_with(tilt_timeout=0.1, support=0.3))
    assert run.cycle().remainder == ()


def test_too_large_a_torque_is_clamped_and_the_joint_named():
    run = CompensatorRun(max_effort=(3.0, 1.0, 3.0, 3.0))
    answer = run.cycle(2.0)
    assert answer.effort[1] == 1.0
    assert answer.clamped == (1,)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("side", "both"),
        ("law", "newton"),
        ("mode", "half_g"),
        ("support", 1.1),
        ("wearer_mass", (0.0, 0.0, 900.0, 0.0)),
        ("wearer_cog", (0.0, 0.0, 0.31, 0.0)),
        ("max_effort", (1.0, 2.0, 3.0)),
        ("max_effort_rate", math.nan),
    ],
)
def test_impossible_settings_are_rejected_by_name(field, value):
    with pytest.raises(ParameterError) as caught:
        settings_with(**{field: value})
    assert caught.value.name.replace(".", "_") == field


def test_too_large_a_total_mass_is_rejected_in_every_mode_and_only_the_supported_share_counts():
    heavy = (0.0, 0.0, 5.0, 4.0)  # kg, with 1.854 kg of robot
    for mode in ("one_g", "zero_g"):
        with pytest.raises(ParameterError, match=r"total mass in kg = 10.85: must be at most 10 \(robot 1.85, "):
            settings_with(mode=mode, wearer_mass=heavy)
    assert settings_with(mode="zero_g", support=0.5, wearer_mass=heavy).arm.total_mass == pytest.approx(6.354)


@pytest.mark.parametrize(("gain", "gravity"), [(2.0, 25.0), (2.0, 10.01), (0.9, 25.0), (1.3, 16.0)])
def test_gain_and_gravity_together_may_not_double_the_earths(gain, gravity):
    with pytest.raises(ParameterError, match=r"gain times gravity = .*: must be at most 20 m/s\^2"):
        settings_with(robot=ArmModel(ROBOT.length, ROBOT.cog, ROBOT.mass, (1.0, gain, 1.0, 1.0), gravity))


@pytest.mark.parametrize(("gain", "gravity"), [(2.0, 9.83), (1.3, 9.81), (0.8, 25.0), (1.0, 1.62), (0.0, 25.0)])
def test_calibrated_gains_and_other_planets_are_accepted(gain, gravity):
    scaled = ArmModel(ROBOT.length, ROBOT.cog, ROBOT.mass, [gain] * 4, gravity)
    assert settings_with(robot=scaled).arm.scale == pytest.approx([gain * gravity] * 4)
