# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Gravity's vector as the tilt: over the whole sphere against Pinocchio, extrapolated, and before pitch and roll."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.tilt import angle_between, pitch_roll
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import TILT, TiltInput
from exo_gravity.lab.inputs.references import pinocchio

from ..support.compensator_run import ROBOT, THETA, CompensatorRun

UPRIGHT = (0.0, 0.0, -1.0)
BASE_FROM_TRUNK = {
    "left": np.array(((0, 1, 0), (1, 0, 0), (0, 0, -1))),
    "right": np.array(((0, -1, 0), (1, 0, 0), (0, 0, -1))),
}
TIMEOUT = 0.08


def great_circles(count=4):
    """Gravity in the trunk's axes, (n, 3), on turns by 360 degrees about `count` axes, in steps of 0.5 degrees."""
    angles = np.radians(np.arange(0.0, 360.0, 0.5))
    for heading in np.arange(count) * math.pi / count:
        axis = np.array((math.cos(heading), math.sin(heading), 0.0))
        yield Rotation.from_rotvec(angles[:, None] * axis).apply(UPRIGHT)


@pytest.mark.parametrize(("side", "by_angles"), [("left", False), ("right", False), ("left", True)])
def test_bowed_beyond_90_degrees_lying_and_upside_down_the_torque_is_pinocchios_and_never_steps(side, by_angles):
    reference = pinocchio(ROBOT)
    for circle in great_circles():
        run = CompensatorRun(side=side, use_imu=True)
        efforts = []
        for gravity in (*[circle[0]] * 600, *circle):  # past the ramp
            run.now += 0.01  # the trunk turns as people turn
            if by_angles:
                run.compensator.tilt.set_tilt(run.now, *pitch_roll(gravity))
            else:
                run.compensator.tilt.set_gravity(run.now, gravity)
            efforts.append(run.cycle().effort)
        efforts = efforts[600:]
        directions = circle @ BASE_FROM_TRUNK[side].T
        expected = reference(np.tile(THETA, (len(circle), 1)), directions)
        np.testing.assert_allclose(efforts, expected, atol=1e-9)
        assert np.abs(np.diff(efforts, axis=0)).max() < 0.1  # Nm; 0.5 degrees of at most 5 Nm are 0.04


def turning(axis, speed, age):
    """A tilt measured `age` s ago on a trunk that turns about `axis`, and gravity's true direction now."""
    rate = speed * np.array(axis) / np.linalg.norm(axis)
    then = Rotation.from_euler("xyz", (0.2, -0.5, 0.9))
    now = then * Rotation.from_rotvec(rate * age)
    before, after = (turn.inv().apply(UPRIGHT) for turn in (then, now))
    tilt = TiltInput("left", TIMEOUT)
    tilt.set_gravity(9.0, before)  # a first one: it bounds how far the next may be
    tilt.set_gravity(10.0, before, rate, age)
    return tilt, BASE_FROM_TRUNK["left"] @ before, BASE_FROM_TRUNK["left"] @ after


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (1, 1, 1)])
def test_a_tilt_is_extrapolated_by_the_gyroscope_over_its_age(axis):
    tilt, before, after = turning(axis, speed=1.5, age=0.03)
    assert math.degrees(angle_between(before, after)) > 1.0
    assert math.degrees(angle_between(tilt.at(10.0).direction, after)) < 0.1


def test_between_two_messages_it_is_extrapolated_for_as_long_as_it_may_be_held():
    tilt, before, _ = turning((0, 1, 0), speed=1.0, age=0.0)
    angles = [angle_between(before, tilt.at(10.0 + later).direction) for later in (0.02, 0.04, TILT.hold, 1.0)]
    assert angles[1] == pytest.approx(2 * angles[0], rel=0.01)
    assert angles[3] == pytest.approx(angles[2], abs=1e-9)


def test_it_is_extrapolated_no_faster_than_a_trunk_tilts():
    tilt, before, _ = turning((0, 1, 0), speed=30.0, age=0.0)
    assert angle_between(before, tilt.at(10.01).direction) <= 1.001 * TILT.speed * 0.01


def test_pitch_and_roll_are_used_only_while_no_vector_arrives():
    tilt = TiltInput("left", TIMEOUT)
    tilt.set_tilt(10.0, 0.1, 0.0)
    assert tilt.at(10.0).pitch == pytest.approx(0.1)
    tilt.set_gravity(10.01, UPRIGHT)
    tilt.set_tilt(10.02, 0.1, 0.0)
    assert tilt.at(10.02).pitch == 0.0
    tilt.set_tilt(10.02 + TIMEOUT, 0.1, 0.0)
    assert tilt.at(10.02 + TIMEOUT).pitch == pytest.approx(0.1)


def test_a_refused_vector_is_not_replaced_by_pitch_and_roll():
    tilt = TiltInput("left", TIMEOUT)
    for k in range(10):
        with pytest.raises(ParameterError):
            tilt.set_gravity(10.0 + 0.01 * k, (0.0, 0.0, 0.0))
        tilt.set_tilt(10.0 + 0.01 * k, 0.1, 0.0)
    assert tilt.problem(10.1).startswith("no trunk tilt yet (the newest was refused: gravity_in_trunk must be")


REFUSED = {
    "a vector with a NaN": ((math.nan, 0.0, -1.0), (0.0, 0.0, 0.0), 0.0),
    "a NaN rate": (UPRIGHT, (0.0, math.nan, 0.0), 0.0),
    "a jump": ((0.5, 0.0, -1.0), (0.0, 0.0, 0.0), 0.0),
    "another clock": (UPRIGHT, (0.0, 0.0, 0.0), 5.0),
}


@pytest.mark.parametrize("values", REFUSED.values(), ids=REFUSED)
def test_an_impossible_vector_is_refused_and_the_last_tilt_stays(values):
    tilt = TiltInput("left", TIMEOUT)
    tilt.set_gravity(10.0, UPRIGHT)
    before = tilt.at(10.01)
    with pytest.raises(ParameterError):
        tilt.set_gravity(10.01, *values)
    assert tilt.at(10.01) == before and tilt.problem(10.01) == ""


def test_a_clock_that_gains_half_a_second_in_a_quarter_of_an_hour_is_followed_and_a_lag_is_still_seen():
    tilt, gain = TiltInput("right", TIMEOUT), 0.0006
    for now in np.arange(0.0, 900.0, 0.05):
        tilt.set_gravity(now, UPRIGHT, age=-gain * now)
        assert tilt.age(now) == pytest.approx(0.0, abs=1e-3)
    for now in np.arange(900.0, 901.0, 0.01):
        tilt.set_gravity(now, UPRIGHT, age=0.2 - gain * now)
        assert tilt.age(now) == pytest.approx(0.2, abs=5e-3)
        assert "by its stamp" in tilt.problem(now)
    with pytest.raises(ParameterError, match="synchronise the clocks"):
        tilt.set_gravity(901.0, UPRIGHT, age=-gain * 901.0 - 0.06)


def test_a_tilt_that_creeps_in_small_jumps_faster_than_a_trunk_is_refused():
    tilt, period = TiltInput("left", TIMEOUT), 0.004
    turned = Rotation.from_euler("y", np.arange(0.0, 3.1, 15.0 * period)[:, None]).inv().apply(UPRIGHT)
    with pytest.raises(ParameterError, match="of the last ones"):
        for n, gravity in enumerate(turned):
            tilt.set_gravity(10.0 + n * period, gravity)
    assert angle_between(tilt.at(10.0).direction, BASE_FROM_TRUNK["left"] @ UPRIGHT) < 0.2


def test_noise_and_a_quick_bow_are_accepted():
    tilt, random = TiltInput("left", TIMEOUT), np.random.default_rng(1)
    for now in np.arange(0.0, 1.0, 0.002):
        bowed = 0.8 * (1.0 - math.cos(math.pi * now))  # 92 degrees in a second, 2.5 rad/s at most
        noise = random.normal(0.0, 0.02, 2)
        tilt.set_tilt(now, bowed + noise[0], noise[1])
    assert tilt.problem(1.0) == ""


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_tilt_faster_than_people_turn_overtakes_one_that_is_not_for_as_long_as_that_takes(side):
    tilt, overtaken = TiltInput(side, TIMEOUT), []
    for k in range(200):
        angle = min(0.6, 1.5 * TILT.usual * 0.01 * k)
        tilt.set_gravity(10.0 + 0.01 * k, (0.0, -math.sin(angle), -math.cos(angle)))
        overtaken.append(tilt.overtaken.roll if tilt.overtaken else None)
    behind = [k for k, roll in enumerate(overtaken) if roll is not None]
    expected = 2.0 * TILT.sudden / TILT.usual, (0.6 - TILT.sudden) / TILT.usual  # s
    assert 0.01 * np.array((behind[0], behind[-1])) == pytest.approx(expected, abs=0.021)
    assert [overtaken[k] for k in behind] == pytest.approx([TILT.usual * 0.01 * k for k in behind], abs=0.01)
