# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's torque: the estimate against MuJoCo and known torques, its share of the weight, and contacts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.tilt import turning_in_base
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import ModelError, Settings
from exo_gravity.core.compensation.terms.catalogue import Friction
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.numbers import COVER
from exo_gravity.lab.observer import (
    OBSERVER,
    PERIOD,
    ContactWatch,
    MomentumObserver,
    SupportAdaptation,
    WearerCurve,
    WearerEstimate,
    WearerWatch,
    observed,
    shares_of,
    while_between,
)
from exo_gravity.sim import STEP, ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.trunk_motion import TrunkState

LOAD = Wearer(75.0).on_links(DEFAULT_LINKS.length)

STILL = (0.0,) * 4

EXACT = ModelError(STILL, STILL, 0.0, 0.0)

COULOMB, VISCOUS = (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)

SETTINGS = Settings(
    "right", DEFAULT_LINKS, wearer_mass=tuple(LOAD.mass), wearer_cog=tuple(LOAD.cog), model_error=EXACT,
    terms=TermSettings(friction=Friction(0.0, COULOMB, VISCOUS)),
)  # fmt: skip

WHOLE = DEFAULT_LINKS.with_wearer(LOAD.mass, LOAD.cog)

TILT = Tilt.of("right", 0.1, -0.05)

POSE = (0.2, 0.8, 0.5, 0.7)

SOFT = 100.0  # Nm/rad, of elastic joints

CODE = 0.024  # rad/s of a motor's 12 bits


def still(effort, tilt=TILT, settings=SETTINGS, pose=POSE, velocity=STILL):
    """Return the estimate after a second in which the joints report `pose`, `velocity` and `effort`."""
    observer = MomentumObserver(settings)
    for n in range(100):
        estimate = observer.update(n * PERIOD, (pose, velocity, effort), tilt)
    return estimate


@pytest.mark.parametrize("side", ["left", "right"])
def test_what_the_motors_do_not_carry_of_a_still_arm_is_the_wearers(side):
    tilt = Tilt.of(side, 0.2, -0.1)
    needed = gravity_torque(WHOLE, POSE, tilt.direction)
    given = (0.3, -1.0, 2.0, 0.5)
    estimate = still(needed - given, tilt, replace(SETTINGS, side=side))
    assert estimate.torque == pytest.approx(given, abs=1e-9)
    own = ArmModel(DEFAULT_LINKS.length, LOAD.cog, LOAD.mass)
    assert estimate.weight == pytest.approx(gravity_torque(own, POSE, tilt.direction))


def worn_arm(**joints):
    """Return a MuJoCo arm with friction and the wearer's arm in it. joints: more of its ArmConfig."""
    friction = {"coulomb_friction": COULOMB, "viscous_friction": VISCOUS}
    return SimulatedArm(ArmConfig(DEFAULT_LINKS, wearer_mass=LOAD.mass, wearer_cog=LOAD.cog, **friction, **joints))


def simulated(seconds, torque_of, base=None):
    """Yield time, joints, wearer's torque and tilt of a MuJoCo arm of slender rods with the wearer's arm in it.

    torque_of: time -> torque (4,) of the wearer in Nm, on top of motors that lead the arm along a path. base: time ->
    TrunkState.
    """
    arm = worn_arm()
    arm.reset(POSE)
    for n in range(round(seconds / PERIOD)):
        now = n * PERIOD
        state = base(now) if base else TrunkState(TILT.pitch, TILT.roll)
        gravity, turning, spin_up = arm.config.felt("right", state)
        arm.move_base(gravity, turning, spin_up)
        tilt = TILT._replace(direction=tuple(np.divide(gravity, np.linalg.norm(gravity))))
        tilt = tilt._replace(magnitude=float(np.linalg.norm(gravity)) / DEFAULT_LINKS.gravity)
        theta, velocity, given = np.array(arm.positions), np.array(arm.velocities), np.array(torque_of(now))
        wanted = POSE + np.array((0.2, 0.3, 0.4, 0.4)) * math.sin(2.5 * now)
        needed = gravity_torque(WHOLE, theta, tilt.direction) - given
        effort = needed + (20.0, 30.0, 20.0, 8.0) * (wanted - theta) - (1.0, 2.0, 1.0, 0.4) * velocity
        yield now, (theta.tolist(), velocity.tolist(), effort.tolist()), given, tilt, turning
        arm.step(effort + given, round(PERIOD / 0.001))


def wearer(now):
    """Return a torque of the wearer that changes as in a reach."""
    return 0.4 * math.sin(3.0 * now), 2.0 + math.sin(4.0 * now), math.cos(3.0 * now), 0.3


def errors(samples, settings=SETTINGS, after=1.0, with_turning=True):
    """Return estimate minus truth, and its deviation, (n, 4) Nm each."""
    observer, found = MomentumObserver(settings), []
    for now, joints, given, tilt, turning in samples:
        estimate = observer.update(now, joints, tilt, turning if with_turning else (0.0, 0.0, 0.0))
        if now > after:
            found.append((np.subtract(estimate.torque, given), estimate.deviation))
    return np.moveaxis(np.array(found), 1, 0)


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def test_the_estimate_follows_a_known_torque_on_a_moving_arm_in_mujoco_and_the_band_holds_it():
    samples = list(simulated(6.0, wearer))
    error, deviation = errors(samples)
    assert np.all(rms(error) < (0.1, 0.2, 0.1, 0.06))
    unknown_friction = errors(samples, replace(SETTINGS, terms=TermSettings()))
    for off, band in ((error, deviation), unknown_friction):
        assert np.mean(np.abs(off) < COVER * band) > 0.9


def test_the_turning_of_the_base_is_accounted_for():
    def bowing(now):
        return TrunkState(pitch=0.3 * math.sin(3.0 * now), pitch_rate=0.9 * math.cos(3.0 * now),
                          pitch_acceleration=-2.7 * math.sin(3.0 * now))  # fmt: skip

    whole, without = (rms(errors(simulated(5.0, wearer, bowing), with_turning=w)[0]) for w in (True, False))
    assert np.linalg.norm(whole) < 0.3 < 0.6 * np.linalg.norm(without)


def test_a_torque_that_rises_steadily_is_followed_without_lag_and_a_gap_starts_anew_from_a_still_arm():
    observer, needed = MomentumObserver(SETTINGS), gravity_torque(WHOLE, POSE, TILT.direction)
    for n in range(200):
        given = np.array((0.0, 2.0 * n * PERIOD, 0.0, 0.0))
        estimate = observer.update(n * PERIOD, (POSE, STILL, (needed - given).tolist()), TILT)
    # The effort acts from its sample on: the estimate is of the sample before.
    assert estimate.torque[1] == pytest.approx(given[1], abs=2.5 * PERIOD)
    later = observer.update(200 * PERIOD + OBSERVER.max_gap, (POSE, STILL, needed.tolist()), TILT)
    assert later.torque == pytest.approx(STILL, abs=1e-9)


def test_each_error_of_the_model_widens_the_band():
    needed = gravity_torque(WHOLE, POSE, TILT.direction).tolist()
    narrow = np.array(still(needed).deviation)
    errors = {
        "torque": (0.3,) * 4,
        "scale": (0.1,) * 4,
        "wearer": 0.1,
        "tilt": 0.05,
        "wearer_torque": (0.3,) * 4,
        "deflection": (0.03,) * 4,
    }
    for name, value in errors.items():
        wider = still(needed, settings=replace(SETTINGS, model_error=replace(EXACT, **{name: value})))
        assert np.all(np.array(wider.deviation) >= narrow) and wider.deviation[1] > 1.05 * narrow[1], name


def elastic(seconds):
    """Yield time, joints as motors of 12 bits report them, and the wearer's torque, of a MuJoCo arm with soft joints.

    The motors carry both arms. The wearer moves the links.
    """
    arm = worn_arm(joint_stiffness=(SOFT,) * 4, backlash=(math.radians(1.0),) * 4)
    arm.move_base(np.multiply(DEFAULT_LINKS.gravity, TILT.direction).tolist())
    arm.reset(POSE)
    carries = replace(SETTINGS, mode="zero_g", support=1.0, joint_stiffness=(SOFT,) * 4, max_effort=(18.0,) * 4)
    for n in range(round(seconds / PERIOD)):
        now = n * PERIOD
        theta, velocity = arm.motor_positions, (CODE * np.round(np.divide(arm.motor_velocities, CODE))).tolist()
        effort = carries.torque(theta, TILT)[0]
        for part in range(round(PERIOD / STEP)):
            wanted = POSE + np.array((0.2, 0.3, 0.4, 0.4)) * math.sin(2.5 * (now + part * STEP))
            given = (20.0, 30.0, 20.0, 8.0) * (wanted - arm.positions) - (1.0, 2.0, 1.0, 0.4) * np.array(arm.velocities)
            if part == 0:
                yield now, (theta, velocity, effort), given, TILT, (0.0, 0.0, 0.0)
            arm.step(effort + given, of_motors=effort)


def test_a_motor_that_vibrates_behind_a_soft_joint_is_not_taken_for_the_wearer():
    samples = list(elastic(5.0))
    told = replace(SETTINGS, joint_stiffness=(SOFT,) * 4)
    error, deviation = errors(samples, told)
    untold, _ = errors(samples)
    assert np.all(rms(error) < 0.6 * rms(untold))
    assert np.mean(np.abs(error) < COVER * deviation) > 0.92


def curve(share, count=500, deviation=0.1):
    """Return the curve of a wearer who gives `share`, a number or (n,), of a weight that changes."""
    time = PERIOD * np.arange(count)
    weight = np.column_stack((np.zeros(count), 8.0 + np.sin(time), 4.0 * np.cos(time), np.ones(count)))
    band = np.full((count, 4), deviation)
    return WearerCurve(time, np.reshape(share, (-1, 1)) * weight, band, weight, band)


def test_the_share_is_that_of_the_weight_that_the_wearer_gives_and_a_longer_time_does_not_narrow_its_band():
    assert shares_of(curve(0.35)).whole.value == pytest.approx(0.35)
    sliding = shares_of(curve(np.repeat((0.2, 0.8), 250)), 1.0).whole.value  # which forgets
    assert sliding[249] == pytest.approx(0.2) and 0.2 < sliding[300] < 0.8
    assert sliding[-1] == pytest.approx(0.8)
    short, long = (shares_of(curve(0.5, count)).whole.deviation for count in (100, 2000))
    assert long == pytest.approx(short, rel=0.3)
    assert shares_of(curve(0.5, deviation=0.2)).whole.deviation == pytest.approx(
        2.0 * shares_of(curve(0.5)).whole.deviation
    )
    for hanging in (curve(0.5)._replace(weight=np.full((500, 4), 0.1)), while_between(curve(0.5), ())):
        assert np.isnan(shares_of(hanging).whole.value)


def test_the_whole_share_hides_a_joint_that_carries_little_and_its_own_share_shows_it():
    needed = gravity_torque(WHOLE, POSE, TILT.direction)
    own = gravity_torque(ArmModel(DEFAULT_LINKS.length, LOAD.cog, LOAD.mass), POSE, TILT.direction)
    values, _, _ = watched(effort=(needed - (0.0, 0.0, 0.0, own[3])).tolist())  # the wearer carries all of the elbow
    assert float(values["share of the wearer (%)"]) < 5.0
    assert values["elbow share (%)"] == "100" and values["b share (%)"] == "0"
    held = curve((0.2,))
    held = held._replace(torque=held.weight * (0.0, 0.1, 0.9, 0.5))
    assert shares_of(held).joints.value[1:] == pytest.approx((0.1, 0.9, 0.5))
    assert np.isnan(shares_of(held).joints.value[0])


def test_an_error_of_the_weight_is_the_same_share_in_every_joint_and_does_not_average_out():
    light = curve(0.1, deviation=0.0)
    light = light._replace(deviation=0.12 * np.abs(light.weight))
    assert shares_of(light).whole.deviation == pytest.approx(0.12)
    assert shares_of(light).joints.deviation[1:] == pytest.approx(0.12)
    running, estimate = SupportAdaptation(), WearerEstimate(*(column[-1] for column in light[1:]))
    for n in range(500):
        running.update(n * PERIOD, (POSE, STILL), estimate, SETTINGS)
    assert running.shares.whole == pytest.approx((0.1, 0.12)) and np.array(running.shares.joints)[
        :, 1
    ] == pytest.approx((0.1, 0.12))


def test_the_share_of_a_wearer_who_walks_is_not_biased_by_what_shakes_their_arm():
    """They carry 60 % of gravity, and all of what the trunk's acceleration adds."""
    estimates, observer = [], MomentumObserver(SETTINGS)
    own = ArmModel(DEFAULT_LINKS.length, LOAD.cog, LOAD.mass)
    for n in range(600):
        shaken = TILT._replace(magnitude=1.0 + 0.2 * math.sin(4.0 * math.pi * n * PERIOD))
        carried = np.array(WHOLE.torque(POSE, TILT)) - 0.6 * np.array(own.torque(POSE, TILT))
        estimates.append(observer.update(n * PERIOD, (POSE, STILL, carried.tolist()), shaken, (0.0, 0.0, 0.0), TILT))
    columns = (np.array(column) for column in zip(*estimates[100:], strict=True))
    walked = WearerCurve(PERIOD * np.arange(500.0), *columns)
    assert shares_of(walked).whole.value == pytest.approx(0.6, abs=0.01)
    assert walked.weight == pytest.approx(np.tile(own.torque(POSE, TILT), (500, 1)))


def test_a_recording_is_sampled_100_times_a_second_and_samples_without_effort_are_left_out():
    time = np.arange(0.0, 2.0, 0.002)
    needed = np.tile(gravity_torque(WHOLE, POSE, TILT.direction), (len(time), 1))
    needed[400:500] = np.nan
    joints = np.tile(POSE, (len(time), 1)), np.zeros_like(needed), needed
    found = observed(SETTINGS, time, joints, lambda now: (TILT, turning_in_base("right", (0.0, 0.0, 0.0)), TILT))
    assert np.diff(found.time[:50]) == pytest.approx(PERIOD)
    assert not np.any((found.time > 0.8) & (found.time < 0.998))
    assert found.torque == pytest.approx(0.0, abs=1e-9)


def watched(settings=SETTINGS, effort=None):
    """Return what a watch says after a second of a still arm whose motors give `effort`, and its last estimate."""
    watch = WearerWatch(("a", "b", "c", "elbow"), SETTINGS)
    watch.apply(settings)
    joints = (POSE, STILL, effort) if effort is not None else None
    estimates = [watch.update(n * PERIOD, joints, (TILT, (0.0, 0.0, 0.0), TILT)) for n in range(200)]
    return watch.values(2.0), estimates[-1], watch


def test_a_watch_tells_torques_beyond_their_band_the_share_and_nothing_that_is_old_or_unknown():
    needed = gravity_torque(WHOLE, POSE, TILT.direction)
    values, estimate, watch = watched(effort=(needed - (0.0, 4.0, 0.0, 0.0)).tolist())
    assert values["b wearer (Nm)"] == "4.0" and 0.0 < float(values["b wearer band (Nm)"]) < 4.0
    share = 4.0 * estimate.weight[1] / sum(w * w for w in estimate.weight)
    assert values["share of the wearer (%)"] == f"{100.0 * share:.0f}" and float(values["share band (%)"]) > 0.0
    assert (values["contacts"], values["contact joint"], values["support adapts"]) == ("0", "none", "off")
    assert watch.values(4.0)["b wearer (Nm)"] == watched()[0]["b wearer (Nm)"] == "unknown"
    carried = watched(effort=needed.tolist())[0]
    assert abs(float(carried["b wearer (Nm)"])) < float(carried["b wearer band (Nm)"])


def test_friction_that_grows_with_the_torque_is_not_taken_for_the_wearers():
    speed, load = (0.3, -0.3, 0.3, 0.3), (0.08,) * 4
    needed = gravity_torque(WHOLE, POSE, TILT.direction)
    rubbing = np.sign(speed) * (COULOMB + VISCOUS * np.abs(speed))
    effort = (needed + rubbing) / (1.0 - np.sign(speed * needed) * load)  # = g + sign(v) (c + viscous |v| + load |e|)
    terms = [TermSettings(friction=Friction(0.0, COULOMB, VISCOUS, share)) for share in (STILL, load)]
    found = [still(effort, settings=replace(SETTINGS, terms=one), velocity=speed).torque for one in terms]
    blind, aware = np.abs(found).max(axis=1)
    assert blind > 0.5 and aware < 0.1


REST, BLOW = [0.0] * 50, [4.0] * 10  # Nm, 100 times a second


def touched(torques: list[float], deviation: float = 0.2, gap: float = 0.0) -> ContactWatch:
    """Return the watch after these torques of the elbow in Nm. gap: s before the last one."""
    watch = ContactWatch()
    for number, torque in enumerate(torques, 1):
        now = PERIOD * number + gap * (number == len(torques))
        band = np.full(4, deviation)
        watch.update(now, WearerEstimate(np.array((0.0, 0.0, 0.0, torque)), band, np.zeros(4), band))
    return watch


@pytest.mark.parametrize(
    ("torques", "deviation", "gap", "count"),
    [
        ([*REST, *[-4.0] * 100], 0.2, 0.0, 1),
        ([*REST, *BLOW, *[0.0] * 250, *REST, *BLOW], 0.2, 0.0, 2),
        ([4.0 * math.sin(0.5 * math.pi * min(1.0, n / 150)) for n in range(300)], 0.2, 0.0, 0),
        ([*REST, *BLOW], 3.0, 0.0, 0),
        ([*REST, 9.0], 0.1, 10.0, 0),
    ],
    ids=["a blow", "two blows more than a second apart", "as a person's", "within the band", "after a gap"],
)
def test_only_a_blow_is_a_contact_with_its_time_joint_and_sign(torques, deviation, gap, count) -> None:
    assert touched(torques, deviation, gap).count == count
    assert touched([*REST, *[-4.0] * 100]).last == (pytest.approx(0.5, abs=0.02), 3, pytest.approx(-3.6, abs=0.4))
