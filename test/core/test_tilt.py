# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tilt of the trunk: its angles, its messages, how sure it is, and the motion that the arm feels."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exo_gravity.core.arm.paper import ArmModel, mobile_torque, static_torque
from exo_gravity.core.arm.tilt import Tilt, angle_between, gravity_in_trunk, pitch_roll, rotation_matrix
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trunk.inputs import FELT, TILT, FeltMotion, TiltInput
from exo_gravity.hardware.trunk_estimator import MODEL, TUNING, TiltUncertainty, VqfFusion

from ..support import ROBOT
from ..support.compensator_run import THETA, CompensatorRun


def rotation(pitch, roll, heading=0.0):
    return Rotation.from_euler("xyz", (roll, pitch, heading))  # fixed axes: roll about x first, then pitch about y


def test_gravity_in_the_trunk_agrees_with_a_roll_then_a_pitch_about_fixed_axes():
    tilts = np.random.default_rng(3).uniform((-math.pi / 2, -math.pi), (math.pi / 2, math.pi), (500, 2))
    for pitch, roll in tilts:
        turn, gravity = rotation(pitch, roll), gravity_in_trunk(pitch, roll)
        assert gravity == pytest.approx(turn.inv().apply((0, 0, -1)), abs=1e-12)
        assert pitch_roll(gravity) == pytest.approx((pitch, roll), abs=1e-6)
        vertical = math.acos(np.clip(turn.as_matrix()[2, 2], -1, 1))  # of the trunk, from gravity
        assert Tilt.of("left", pitch, roll).axis_angle == pytest.approx(vertical, abs=1e-7)
    assert pitch_roll((1.0, 0.0, 0.0))[0] == pytest.approx(math.pi / 2)


def test_bowing_forward_is_positive_pitch_and_leaning_to_the_right_positive_roll():
    assert gravity_in_trunk(0.3, 0.0)[0] > 0 > gravity_in_trunk(0.0, 0.3)[1]
    for side, phi in (("left", 0.2), ("right", -0.2)):  # beta is minus the pitch, and phi the outward roll
        tilt = Tilt.of(side, 0.1, 0.2)
        assert (tilt.beta, tilt.phi) == (-0.1, phi)


def test_the_rotation_matrix_agrees_with_scipy_also_for_a_rounded_quaternion():
    for turn in Rotation.random(200, random_state=4):
        assert rotation_matrix(turn.as_quat()) == pytest.approx(turn.as_matrix(), abs=1e-12)
        assert rotation_matrix(1.005 * turn.as_quat()) == pytest.approx(turn.as_matrix(), abs=1e-12)


@pytest.mark.parametrize("law", [ArmModel.torque, static_torque, mobile_torque])
def test_the_laws_multiply_their_torque_by_the_magnitude_of_gravity(law):
    tilt = Tilt.of("left", 0.2, -0.1)
    np.testing.assert_allclose(law(ROBOT, THETA, tilt._replace(magnitude=1.5)), 1.5 * np.array(law(ROBOT, THETA, tilt)))


UPRIGHT = (0.0, 0.0, -1.0)
BASE_FROM_TRUNK = {
    "left": np.array(((0, 1, 0), (1, 0, 0), (0, 0, -1))),
    "right": np.array(((0, -1, 0), (1, 0, 0), (0, 0, -1))),
}
TIMEOUT = 0.08


@pytest.mark.parametrize(("side", "by_angles"), [("left", False), ("right", False), ("left", True)])
@pytest.mark.parametrize("heading", [0.0, 1.0, 2.0])
def test_lying_and_bowed_beyond_90_degrees_gravity_is_that_of_the_arms_base(side, by_angles, heading):
    tilt, axis = TiltInput(side, TIMEOUT), np.array((math.cos(heading), math.sin(heading), 0.0))
    for n, angle in enumerate(np.radians(np.arange(0.0, 118.0, 0.5))):  # the trunk turns as people turn
        gravity = Rotation.from_rotvec(angle * axis).apply(UPRIGHT)
        if by_angles:
            tilt.set_tilt(10.0 + 0.01 * n, *pitch_roll(gravity))
        else:
            tilt.set_gravity(10.0 + 0.01 * n, gravity)
        assert tilt.at(10.0 + 0.01 * n).direction == pytest.approx(BASE_FROM_TRUNK[side] @ gravity, abs=1e-9)


UPSIDE_DOWN = {  # what an IMU shows of a person who stands
    "a mounting written w, x, y, z: half a turn about x": Rotation.from_quat((1.0, 0.0, 0.0, 0.0)),
    "an accelerometer whose sign is reversed": Rotation.from_euler("y", 180.0, degrees=True),
    "a driver's own axes, z down": Rotation.from_euler("xyz", (180.0, 0.0, 30.0), degrees=True),
}


@pytest.mark.parametrize("shown", UPSIDE_DOWN.values(), ids=UPSIDE_DOWN)
@pytest.mark.parametrize("bow", [0.0, 0.5, -0.9])
def test_a_trunk_that_is_upside_down_is_refused_with_the_likely_causes(shown, bow):
    run = CompensatorRun(use_imu=True)
    gravity = shown.apply(Rotation.from_euler("y", -bow).apply(UPRIGHT))
    with pytest.raises(ParameterError, match=r"within 120 degrees of upright.*order x, y, z, w.*\+9.8 upward.*z up"):
        run.compensator.tilt.set_gravity(run.now, gravity)
    assert run.cycle().effort is None


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


def test_between_two_messages_it_is_extrapolated_for_as_long_as_it_may_be_held_and_no_faster_than_a_trunk_tilts():
    tilt, before, _ = turning((0, 1, 0), speed=1.0, age=0.0)
    angles = [angle_between(before, tilt.at(10.0 + later).direction) for later in (0.02, 0.04, TILT.hold, 1.0)]
    assert angles[1] == pytest.approx(2 * angles[0], rel=0.01)
    assert angles[3] == pytest.approx(angles[2], abs=1e-9)
    tilt, before, _ = turning((0, 1, 0), speed=30.0, age=0.0)
    assert angle_between(before, tilt.at(10.01).direction) <= 1.001 * TILT.speed * 0.01


def test_pitch_and_roll_are_used_only_while_no_vector_arrives_not_even_a_refused_one():
    tilt = TiltInput("left", TIMEOUT)
    tilt.set_tilt(10.0, 0.1, 0.0)
    assert tilt.at(10.0).pitch == pytest.approx(0.1)
    tilt.set_gravity(10.01, UPRIGHT)
    tilt.set_tilt(10.02, 0.1, 0.0)
    assert tilt.at(10.02).pitch == 0.0
    tilt.set_tilt(10.02 + TIMEOUT, 0.1, 0.0)
    assert tilt.at(10.02 + TIMEOUT).pitch == pytest.approx(0.1)
    tilt = TiltInput("left", TIMEOUT)
    with pytest.raises(ParameterError):
        tilt.set_gravity(10.0, (0.0, 0.0, 0.0))
    tilt.set_tilt(10.0, 0.1, 0.0)
    assert tilt.problem(10.0).text.startswith("no trunk tilt yet (the newest was refused: gravity_in_trunk must be")


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
    assert tilt.at(10.01) == before and not tilt.problem(10.01)


def test_a_clock_that_gains_half_a_second_in_a_quarter_of_an_hour_is_followed_and_a_lag_is_still_seen():
    tilt, gain = TiltInput("right", TIMEOUT), 0.0006
    for now in np.arange(0.0, 900.0, 0.05):
        tilt.set_gravity(now, UPRIGHT, age=-gain * now)
        assert tilt.age(now) == pytest.approx(0.0, abs=1e-3)
    for now in np.arange(900.0, 901.0, 0.01):
        tilt.set_gravity(now, UPRIGHT, age=0.2 - gain * now)
        assert tilt.age(now) == pytest.approx(0.2, abs=5e-3)
        assert "by its stamp" in tilt.problem(now).text
    with pytest.raises(ParameterError, match="synchronise the clocks"):
        tilt.set_gravity(901.0, UPRIGHT, age=-gain * 901.0 - 0.06)


def test_a_tilt_that_creeps_in_small_jumps_faster_than_a_trunk_is_refused():
    tilt, period = TiltInput("left", TIMEOUT), 0.004
    turned = Rotation.from_euler("y", np.arange(0.0, 3.1, 15.0 * period)[:, None]).inv().apply(UPRIGHT)
    with pytest.raises(ParameterError, match="of the last ones"):
        for n, gravity in enumerate(turned):
            tilt.set_gravity(10.0 + n * period, gravity)
    assert angle_between(tilt.at(10.0).direction, BASE_FROM_TRUNK["left"] @ UPRIGHT) < 0.2


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_tilt_that_turns_overtakes_one_that_is_followed_at_once_for_as_long_as_that_takes(side):
    tilt, overtaken = TiltInput(side, TIMEOUT), []
    for k in range(1300):
        angle = min(0.6, 1.5 * TILT.followed * 0.01 * k)
        tilt.set_gravity(10.0 + 0.01 * k, (0.0, -math.sin(angle), -math.cos(angle)))
        overtaken.append(tilt.overtaken.roll if tilt.overtaken else None)
    behind = [k for k, roll in enumerate(overtaken) if roll is not None]
    expected = 2.0 * TILT.ahead / TILT.followed, (0.6 - TILT.ahead) / TILT.followed  # s
    assert 0.01 * np.array((behind[0], behind[-1])) == pytest.approx(expected, abs=0.021)
    assert [overtaken[k] for k in behind] == pytest.approx([TILT.followed * 0.01 * k for k in behind], abs=0.01)


G = 9.80665
RANGE = 34.9  # rad/s
STILL = (0.0, 0.0, 0.0)


class Uncertainty(TiltUncertainty):
    """That of a tilt at 100 Hz, 12 s after its start, while the rate changed by `acceleration` rad/s^2.

    added: the standard deviation in rad beyond that of an estimate that has lost nothing.
    """

    def __init__(self, acceleration: float = 0.0, seconds: float = 12.0, square: float = 0.0) -> None:
        super().__init__(0.01)
        self.go_on(seconds, acceleration, square)

    def go_on(self, seconds: float, acceleration: float = 0.0, square: float = 0.0) -> None:
        for _ in range(round(50 * seconds)):
            self.advance(0.02, 2, acceleration, 0.0, square, 0.0)

    @property
    def added(self) -> float:
        return math.sqrt(self.sigma**2 - MODEL.fused**2)


SATURATED = TUNING.overshoot * RANGE  # rad/s
LOST = {  # the rate's change before in rad/s^2; what was not measured; what it adds in rad, and its tolerance
    "three saturated samples": (0.0, [(0.001, 0.0, SATURATED, 0.0)] * 3, 3 * SATURATED * 0.001, 0.01),
    **{
        f"a gap of {gap} s, at {before:g} rad/s^2": (
            before, [(gap, 0.0, 0.0, 0.0)], assumed * gap**2 * share, 0.05,
        )
        for before, assumed in ((0.0, 20.0), (100.0, 100.0))
        for gap, share in ((0.05, 1 / 6), (0.02, 1 / 15))
    },
    "repeated samples": (100.0, [(0.01, 0.0, 0.0, 0.01 * k) for k in (1, 2, 3)], 0.5 * 100.0 * 0.03**2, 0.1),
}  # fmt: skip


@pytest.mark.parametrize(("before", "lost", "adds", "tolerance"), LOST.values(), ids=LOST)
def test_what_is_not_measured_adds_to_the_uncertainty(before, lost, adds, tolerance):
    uncertainty = Uncertainty(before)
    assert before or uncertainty.sigma == pytest.approx(MODEL.fused)  # an estimate that has lost nothing
    for part in lost:
        uncertainty.add_unmeasured(*part)
    assert uncertainty.added == pytest.approx(adds, rel=tolerance)


def test_what_was_lost_decays_and_too_much_makes_the_estimate_begin_anew():
    uncertainty = Uncertainty()
    assert not uncertainty.add_unmeasured(0.002, 0.0, SATURATED, 0.0)
    before = uncertainty.added
    uncertainty.add_unmeasured(0.01, 0.0, 0.0, 0.0)  # a good sample ends the run
    uncertainty.go_on(MODEL.decay_time)
    assert uncertainty.added == pytest.approx(before / math.e, rel=0.02)
    assert uncertainty.add_unmeasured(0.004, 0.0, SATURATED, 0.0)
    assert uncertainty.added > 0.03 and uncertainty.sigma > MODEL.limit


def test_a_start_in_motion_takes_longer_and_an_unknown_bias_and_a_contradiction_widen_it():
    assert Uncertainty(0.0, 1.2, 4e-6).sigma < MODEL.limit < Uncertainty(0.0, 1.2, 0.5).sigma
    for bias, contradiction in ((0.02, 0.0), (0.0, math.radians(3.5))):
        still = Uncertainty(0.0, 1.2, 4e-6)
        still.advance(0.02, 2, 0.0, bias, 0.0, contradiction)
        assert still.sigma > MODEL.limit


def test_a_restart_keeps_the_bias():
    orientation = VqfFusion(0.01)
    random = np.random.default_rng(4)
    for _ in range(1000):
        x, y, z = random.normal(0.0, 1e-3, 3)
        orientation.advance(0.01, (0.02 + x, y, z), (0.02, 0.0, 0.0), (x, y, G))
    orientation.restart()
    for _ in range(30):
        orientation.advance(0.01, (0.02, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.0, G))
    assert orientation.bias[0] == pytest.approx(0.02, abs=2e-3)


def following(force, spin=lambda time: STILL, until=1.0, period=0.01):
    """A follower of the vectors force(t) and spin(t), sampled until `until`."""
    felt = FeltMotion()
    for t in np.arange(0.0, until + period / 2, period):
        felt.add(t, force(t), spin(t))
    return felt


def shaken(t, frequency=1.9):
    return 0.0, 0.0, G + 2.0 * math.cos(2 * math.pi * frequency * t)


@pytest.mark.parametrize("age", [0.0, 0.004, 0.01])
@pytest.mark.parametrize(
    ("frequency", "rate", "most"),  # Hz, of the shake and of its samples, and m/s^2 of error
    [(1.9, 100.0, 0.06), (3.8, 100.0, 0.3), *((1.9, rate, 0.1) for rate in (40.0, 50.0, 250.0, 1000.0))],
)
def test_a_shake_is_felt_as_it_will_be_when_the_motors_answer(age, frequency, rate, most):
    felt = following(lambda t: shaken(t, frequency), period=1.0 / rate).at(1.0 + age)
    assert felt.gravity[2] == pytest.approx(-shaken(1.0 + age + FELT.effect, frequency)[2], abs=most)


def test_too_few_or_too_old_samples_and_a_gap_give_no_motion_and_blows_count_within_a_range():
    assert FeltMotion().at(0.0) is None
    assert following(shaken, until=0.02).at(0.02) is None
    felt = following(shaken)
    felt.add(0.5, (5.0, 5.0, 5.0), STILL)  # a sample that is late is ignored
    assert felt.at(1.004).gravity[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
    assert felt.at(1.1) is None
    felt.add(1.3, shaken(1.3), STILL)
    assert felt.at(1.3) is None
    for force, most in zip((0.1, 8.0 * G), FELT.range, strict=True):
        gravity = following(lambda t, force=force: (0.0, 0.0, force)).at(1.0).gravity
        assert np.linalg.norm(gravity) == pytest.approx(most)


def test_the_shoulder_of_a_trunk_that_sways_accelerates_other_than_the_imu_as_when_the_motors_answer():
    w, sway, lever = 2 * math.pi * 0.95, 0.3, (0.0, -0.2, 0.1)
    felt = following(lambda t: (0.0, 0.0, G), lambda t: (sway * math.sin(w * t), 0.0, 0.0)).at(1.0, lever)
    phase = w * (1.0 + FELT.effect)
    turning, spin_up = np.array((sway * math.sin(phase), 0, 0)), np.array((sway * w * math.cos(phase), 0, 0))
    assert felt.angular_acceleration == pytest.approx(spin_up, abs=0.05)
    expected = (0, 0, -G) - np.cross(spin_up, lever) - np.cross(turning, np.cross(turning, lever))
    np.testing.assert_allclose(felt.gravity, expected, atol=0.02)
    assert np.linalg.norm(expected - (0, 0, -G)) > 0.3
