# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour on the simulated device, rigid or elastic: what it measures, within which limits, and what stops it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.springs import link_angles
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.command import FaultCode, State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.calibration.identification import fit_friction
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tour import (
    DEVIATIONS,
    MAX_LEFT_OUT,
    TOUR,
    Itinerary,
    TorqueGuess,
    Tour,
    candidates,
    measurable,
)
from exo_gravity.lab.calibration.tracking import MOTION, Line, Observation, Station, Sweep
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.calibration_device import MOTORS_AS_MOUNTED, NAMES, Disturb, TourRun, fixed
from ...support.thorough import quick

LIMITS = Limits(NAMES, sign_check_torque=0.0)

POSE = Station((0.1, 0.5, 0.6, 0.7))

TWO = POSE, Station((0.0, 0.3, 0.5, 0.4))

RATE = 50.0  # Hz

SCALES = (0.8, 1.2, 0.9, 1.0)

WEIGHT = (1.0, 0.28)  # kg, m from the elbow

MOMENTS, UPRIGHT, STILL = DEFAULT_LINKS.moments, Tilt.of("right"), (0.0,) * 4

LEANT = Tilt.of("right", 0.05, 0.2)

MODEL = MomentModel(DEFAULT_LINKS, True)
WEIGHED = MOMENTS + MODEL.load(*WEIGHT)


def seen_at(theta, effort, tilt, load=(0.0, 0.0)) -> list[Observation]:
    """Return what poses `theta` (m, 4) rad show that need `effort` (m, 4) Nm."""
    return [
        Observation(one, tilt.direction, own, np.full(4, 0.2), np.full(4, 0.003), *load)
        for one, own in zip(theta, effort, strict=True)
    ]


@pytest.fixture(scope="module")
def wrong_file():
    """A tour of two poses of an arm whose masses, centres of gravity and torque scales differ from the file's."""
    links = DEFAULT_LINKS
    truth = ArmModel(links.length, links.cog * 0.9, links.mass * (1.2, 0.8, 1.15, 0.8))
    motors = [replace(motor, torque_scale=scale) for motor, scale in zip(MOTORS_AS_MOUNTED, SCALES, strict=True)]
    run = TourRun(truth=ArmConfig(truth), motors=motors, rate=RATE)
    return run, run.run(Itinerary(LIMITS, 2)), truth


def test_a_tour_of_two_poses_is_slow_ends_hanging_in_time_and_does_not_watch_the_bridge_let_the_arm_down(wrong_file):
    run, tour, _ = wrong_file
    assert tour.trouble == "" and tour.done and len(tour.measured) == 2
    assert run.log[-1][0] - run.log[0][0] < 55.0
    assert run.safety.fault is None and run.safety.state is State.DISABLED and not run.safety.acted
    positions = np.array(run.log)[:, 1:5]
    np.testing.assert_allclose(positions[-1], LIMITS.home, atol=0.1)
    assert run.fastest < 0.9  # for moments, where a light joint leaves its friction
    assert np.abs(np.diff(positions[:: round(0.5 * run.rate)], axis=0)).max() / 0.5 < 1.35 * MOTION.speed
    later = [tour.step(1000.0 + n / 100.0, (0.0, 0.5, 0.4, 0.8), STILL, UPRIGHT) for n in range(300)]
    assert None not in later and not tour.trouble


def test_the_mean_of_both_directions_is_gravity_within_its_stated_error_and_half_the_difference_is_friction(wrong_file):
    _, tour, truth = wrong_file
    effort, spread, friction = (
        np.array([getattr(one, field) for one in tour.measured]) for field in ("effort", "spread", "friction")
    )
    error = effort - [gravity_torque(truth, one.theta, one.direction) / SCALES for one in tour.measured]
    assert np.abs(error).max() < 0.02  # of up to 5 Nm
    ratio = np.abs(error) / spread
    assert np.mean(ratio < 2.0) > 0.9 and ratio.max() < 6.0
    np.testing.assert_allclose(np.median(friction, axis=0) * SCALES, (0.2, 0.4, 0.2, 0.2), atol=0.02)


class Grip:
    """A hand that holds joint 3 where it was at `start` s, with a spring of 60 Nm/rad and the damping of an arm."""

    def __init__(self, start):
        self.start, self.held = start, None

    def __call__(self, time, device):
        if time < self.start:
            return None
        self.held = device.arm.positions[2] if self.held is None else self.held
        return 0.0, 0.0, 60.0 * (self.held - device.arm.positions[2]) - 3.0 * device.arm.velocities[2], 0.0


def unplug(time, device):
    device.motors[1].unplugged = time > 18.0


def slip(time, device):
    """A slip shows as a torque that differs between two passes of the same angle."""
    return 0.0, 0.0, min(0.5, 0.2 * max(0.0, time - 10.0)), 0.0


@dataclass(frozen=True)
class Stopped:
    """How a tour ends early. kept: whether what was measured before is kept."""

    disturb: Disturb | None
    stations: tuple[Station, ...]
    trouble: tuple[str, ...] = ()
    fault: FaultCode = FaultCode.COMMAND_WITHDRAWN
    named: str = ""
    kept: bool = False
    max_effort: tuple[float, ...] = LIMITS.max_effort
    rate: float = RATE


STOPPED = {
    "a hand": Stopped(Grip(18.0), TWO, ("flexion: ", "a hand", "the limit is"), kept=True),
    "saturated": Stopped(
        None,
        (Station((0.0, 0.3, 1.2, 0.2)),),
        ("flexion: saturated", "max_effort = 1 Nm"),
        max_effort=(3.0, 9.0, 1.0, 3.0),
    ),
    "a silent motor": Stopped(unplug, TWO, fault=FaultCode.MOTOR_SILENT, named="abduction", kept=True),
    "a slip": Stopped(
        slip, (Station((0.0, 0.3, 0.5, 0.4), cycles=4),), ("flexion: ", "between two passes"), rate=100.0
    ),
}


@pytest.mark.parametrize("name", quick(["a hand", "saturated"], list(STOPPED)))
def test_what_goes_wrong_on_a_tour_ends_it_and_is_named(name):
    case = STOPPED[name]
    limits = replace(LIMITS, max_effort=case.max_effort)
    run = TourRun(limits=limits, disturb=case.disturb, rate=case.rate)
    tour = run.run(fixed(case.stations))
    assert all(word in tour.trouble for word in case.trouble) and not tour.done
    assert run.safety.fault.code is case.fault and case.named in run.safety.fault.reason
    assert bool(tour.measured) is case.kept and not run.device.powered
    assert name != "saturated" or run.log[-1][0] - run.log[0][0] < 15.0


@pytest.mark.parametrize(
    ("now", "tilt", "words"),
    [(1.5, (0.0, 0.0), "no joint states for 500 ms"), (1.01, (0.2, 0.0), "tilted by 0.20 rad")],
)
def test_joint_states_that_stop_and_a_stand_that_moves_end_the_tour(now, tilt, words):
    tour = Tour(LIMITS, MODEL, fixed([POSE]), 100.0)
    assert tour.step(1.0, STILL, STILL, UPRIGHT) is not None
    assert tour.step(now, STILL, STILL, Tilt.of("right", *tilt)) is None
    assert words in tour.trouble


class Broken(Itinerary):
    """Pose choice with a defect."""

    def stations(self, tour):
        yield from ()
        raise np.linalg.LinAlgError("Singular matrix")


def test_the_arm_is_held_until_the_next_pose_is_chosen_but_not_for_ever_and_not_if_the_choice_fails():
    tour = Tour(LIMITS, MODEL, fixed([POSE]), 100.0)
    for cycle in range(200):
        assert tour.step(0.01 * cycle, STILL, STILL, UPRIGHT) == pytest.approx(STILL, abs=0.01)
    tour.plan()
    efforts = [tour.step(2.0 + 0.01 * i, STILL, STILL, UPRIGHT) for i in range(30)]
    assert efforts[-1][3] > 0.05 and "pose 1 of 1" in tour.progress
    tour = Tour(LIMITS, MODEL, fixed([POSE]), 100.0)
    efforts = [tour.step(0.05 * cycle, STILL, STILL, UPRIGHT) for cycle in range(610)]
    assert efforts[590] is not None and efforts[-1] is None
    assert tour.trouble.startswith("the next pose was not chosen within 30 s")
    tour = Tour(LIMITS, MODEL, Broken(LIMITS, 1), 100.0)
    assert tour.step(0.0, STILL, STILL, UPRIGHT) is not None
    tour.plan()
    assert None in [tour.step(0.01 * cycle, STILL, STILL, UPRIGHT) for cycle in range(1, 40)]  # let down by the bridge
    assert tour.trouble == "the next pose could not be chosen: LinAlgError: Singular matrix"


def test_poses_in_which_a_joint_sticks_are_left_out_and_the_tour_ends_with_what_it_has(monkeypatch):
    tour, said, way = Tour(LIMITS, MODEL, Itinerary(LIMITS, 20), 100.0), list[str](), np.linspace(-0.03, 0.03, 20)
    position, down = np.tile(way[:, None], 4) * (1.0, 1.0, 0.2, 1.0), np.tile((0.0, 0.0, 1.0), (20, 1))

    def sweep(station):
        yield from ()
        return [Sweep(position, np.full((20, 4), 0.2), down), Sweep(position[::-1], np.full((20, 4), -0.2), down)]

    monkeypatch.setattr(tour._tracker, "sweep", sweep)
    for _ in tour._lines():
        tour.plan()
        said.append(tour.progress)
    assert tour.done and tour.trouble == "" and tour.measured == []
    assert len(set(said)) == MAX_LEFT_OUT + 4 and f"a pose in which {NAMES[2]} sticks: it follows 18%" in said[-3]


def test_a_line_keeps_speed_and_acceleration_and_arrives():
    line = Line(np.zeros(4), np.array((1.0, -0.5, 0.0, 0.2)))
    times = np.arange(0.0, line.duration, 0.001)
    positions, speeds = (np.array(column) for column in zip(*map(line.at, times), strict=True))
    assert np.abs(speeds).max() <= MOTION.speed + 1e-9
    assert np.abs(np.diff(speeds, axis=0)).max() <= MOTION.acceleration * 0.001 + 1e-9
    np.testing.assert_allclose(np.diff(positions, axis=0)[500:-500], 0.001 * speeds[500:-501], atol=1e-5)
    np.testing.assert_allclose(line.at(math.inf)[0], (1.0, -0.5, 0.0, 0.2))


@pytest.mark.parametrize("sign", [1.0, -1.0])  # moments below 0 counted as 0 in the loop only: a cable made an error
def test_the_expected_torque_learns_scale_and_moments_of_each_joint_the_same_in_the_loop_as_in_the_result(sign):
    links, tilt = DEFAULT_LINKS, Tilt.of("right", 0.1, 0.2)
    truth = ArmModel(links.length, links.cog * 0.9, links.mass * 1.2)
    poses = candidates(LIMITS, MODEL)[:60]
    torque = sign * gravity_torque(truth, poses, tilt.direction) / SCALES
    before, after = TorqueGuess(MODEL), TorqueGuess(MODEL, seen=seen_at(poses[:10], torque[:10], tilt))
    (first, unsure), (mean, deviation) = (guess.torques(poses, tilt.direction) for guess in (before, after))
    assert np.abs(first - torque).max() > 0.4 and (np.abs(mean - torque).max() < 0.1 or sign < 0.0)
    assert np.all(deviation <= unsure + 1e-9)
    np.testing.assert_allclose([after.torque(pose, tilt) for pose in poses.tolist()], mean, atol=1e-6)


def test_poses_in_which_link_3_or_4_points_far_upwards_are_no_candidates():
    poses = np.radians(((0, 0, 0, 0), (0, 90, 0, 0), (0, 170, 90, 0), (0, 0, 0, 135), (30, 150, 0, 30)))
    expected = np.sin(np.radians((-90, 0, 0, 45, 60)))
    np.testing.assert_allclose(MODEL.upwards(poses), expected, atol=1e-12)
    assert np.max(MODEL.upwards(candidates(LIMITS, MODEL))) <= TOUR.most_upwards


def test_what_is_expected_under_a_weight_follows_from_earlier_poses_and_is_as_sure_as_zeros_and_cables_allow():
    """With errors fitted to few poses, 1.1 Nm of the weight seemed to be a hand on the arm."""
    tilt, poses, rng = Tilt.of("right", -0.07, 0.2), candidates(LIMITS, MODEL)[:40], np.random.default_rng(1)
    off = []
    for _ in range(10):
        scales, zeros = rng.uniform(0.7, 1.3, 4), rng.uniform(-0.026, 0.026, 4)
        bare, heavy = (
            MODEL.rows(poses + zeros, np.array(tilt.direction)) @ (MOMENTS + MODEL.load(*load)) / scales + 0.1 * poses
            for load in ((0.0, 0.0), WEIGHT)
        )
        seen = seen_at(poses[:8], bare[:8], tilt) + seen_at(poses[8:10], heavy[8:10], tilt, WEIGHT)
        found = [TorqueGuess(MODEL, WEIGHT, seen[:count]).torques(poses, tilt.direction) for count in (0, 8, 10)]
        off.append([(np.abs(mean - heavy), deviation) for mean, deviation in found])
    size, deviation = np.swapaxes(off, 0, 2)
    assert np.all(np.diff(size.mean(axis=(1, 2, 3))) < 0.0)
    assert np.all(np.mean(size < DEVIATIONS * deviation, axis=(1, 2, 3)) > 0.97)


def test_the_mass_matrix_of_an_arm_under_a_weight_is_in_the_torque_that_each_motor_is_commanded():
    """A joint whose inertia was taken for a tenth of the true one went 0.12 rad off its path."""
    scales, tilt = (0.7, 1.1, 1.3, 0.8), Tilt.of("right", 0.07, 0.2)
    poses = candidates(LIMITS, MODEL)
    effort = MODEL.rows(poses[:6], np.array(tilt.direction)) @ WEIGHED / scales
    guess = TorqueGuess(MODEL, WEIGHT, seen_at(poses[:6], effort, tilt, WEIGHT))
    for theta in poses[100:120]:
        true = MODEL.matrix(theta, WEIGHT)
        np.testing.assert_allclose(guess.matrix(theta), true / np.reshape(scales, (4, 1)), rtol=0.12, atol=1e-9)


def test_an_arm_hangs_on_until_it_is_carried_though_its_motors_are_stronger_than_the_file_says():
    """With all of the expected torque it swung out, and the tour said that the pose needed too much."""
    links, worn = ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass * 0.75), (0.0, 0.0, 0.0)
    truth = ArmConfig(
        links, wearer_mass=(*worn, WEIGHT[0]), wearer_cog=(*worn, WEIGHT[1]), wearer_cog_y=(*worn, 0.015),
        cog_y=(0.0, 0.0, 0.015, 0.015), coulomb_friction=(0.6, 0.1, 0.1, 0.1),
    )  # fmt: skip
    motors = [replace(motor, torque_scale=1.25) for motor in MOTORS_AS_MOUNTED]

    def unplug(time, device):
        device.motors[1].unplugged = True  # the tour has begun, and may end

    run = TourRun(truth, motors=motors, tilt=(0.19, 0.1), load=WEIGHT, disturb=unplug)
    run.run(fixed([POSE]))
    np.testing.assert_allclose(run.log[0][1:5], (0.0, 0.1, 0.19, 0.0), atol=0.1)


@pytest.mark.parametrize(("mass", "lever", "tolerance"), [(0.0, 0.0, 0.012), (*WEIGHT, 0.025)])
def test_the_mass_matrix_is_close_to_that_of_the_device(mass, lever, tolerance):
    arm = SimulatedArm(ArmConfig(wearer_mass=(0, 0, 0, mass), wearer_cog=(0, 0, 0, lever)))
    for theta in ((0.0,) * 4, (0.3, 0.8, 0.7, 0.5), (-0.5, 1.5, 1.2, 1.0)):
        arm.reset(theta)
        true = np.zeros((4, 4))
        mujoco.mj_fullM(arm.model, arm.data, true)
        np.testing.assert_allclose(MODEL.matrix(theta, (mass, lever)), true, atol=tolerance)


@pytest.mark.parametrize(
    ("count", "again", "load", "tilt"),
    [(4, 2, (0.0, 0.0), UPRIGHT), pytest.param(8, 0, WEIGHT, LEANT, marks=pytest.mark.thorough)],
)
def test_chosen_poses_their_sweeps_and_the_way_home_are_within_limits_and_the_first_are_visited_again(
    load, tilt, count, again
):
    limits = replace(LIMITS, max_effort=(3.0, 9.0, 1.8 if again else 3.0, 3.0))
    tour = Tour(limits, MODEL, Itinerary(limits, count, again=again), RATE, load)
    tour.step(0.0, STILL, STILL, tilt)
    (low, high), (nothing, spread) = measurable(LIMITS, POSE.amplitude), (np.zeros(4), np.full(4, 0.003))
    for station in tour.itinerary.stations(tour):
        theta = np.array(station.theta)
        assert np.all(theta >= low) and np.all(theta <= high)
        effort = np.array(tour.guess.torque(station.theta, tilt))
        assert np.all(np.abs(effort) < 0.85 * np.array(limits.max_effort))
        ways = [*station.ends, *(share * theta for share in np.linspace(0.0, 1.0, 20))]
        assert np.all(np.abs(tour.guess.torques(np.array(ways), tour.down)[0]) < 0.95 * np.array(limits.max_effort))
        tour.measured.append(Observation(theta, tour.down, effort, nothing, spread, *load))
        tour.friction = np.full(4, 0.2)
    taken = np.array([one.theta for one in tour.measured])
    assert len(taken) == tour.itinerary.count == count + again and np.array_equal(taken[count:], taken[:again])


def test_without_a_pose_that_the_motors_can_hold_the_tour_says_so():
    limits = replace(LIMITS, max_effort=(0.1,) * 4)
    tour = Tour(limits, MODEL, Itinerary(limits, 4), RATE)
    stations = tour.itinerary.stations(tour)
    next(stations)  # the hanging arm
    with pytest.raises(DataError, match="max_effort"):
        next(stations)


def test_friction_over_speed_is_fitted_with_and_without_stribeck_and_at_one_speed_refused():
    speed = np.array((0.02, 0.05, 0.1, 0.18, 0.3))
    error = np.full(len(speed), 0.002)
    plain = fit_friction(speed, 0.2 + 0.05 * speed, error, 0.0 * speed)
    assert (plain.coulomb, plain.viscous) == pytest.approx((0.2, 0.05), rel=1e-7) and plain.stribeck == 0.0
    measured = 0.2 + 0.05 * speed + 0.1 * np.exp(-((speed / 0.05) ** 2))
    fit = fit_friction(speed, measured, error, 0.0 * speed)
    np.testing.assert_allclose(fit.fitted, measured, atol=0.005)
    assert fit.coulomb == pytest.approx(0.2, abs=0.01)
    with pytest.raises(DataError, match="at 1 speeds"):
        fit_friction(speed[:1], speed[:1], error[:1], speed[:1])


@pytest.mark.parametrize("noise", quick([0.008], [0.004, 0.008]))
def test_no_stribeck_friction_is_made_of_noise_and_the_errors_cover_the_truth(noise):
    speed = np.array((0.1, 0.02, 0.05, 0.1, 0.18, 0.3, 0.1, 0.1, 0.1, 0.1))
    carried = np.array((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0, 2.0, 4.0))
    rng, error = np.random.default_rng(4), np.full(len(speed), noise)
    drawn = [0.2 + 0.05 * speed + rng.normal(0.0, noise, len(speed)) for _ in range(200)]
    fits = [fit_friction(speed, measured, error, carried) for measured in drawn]
    assert np.mean([fit.stribeck > 0.0 or fit.load > 0.0 for fit in fits]) < 0.01
    assert min(fit.coulomb for fit in fits) > 0.15
    assert np.mean([abs(fit.coulomb - 0.2) < 2.0 * fit.error[0] for fit in fits]) > 0.93
    loaded = fit_friction(speed, drawn[-1] + 0.08 * np.abs(carried), error, carried)
    assert abs(loaded.load - 0.08) < 2.0 * loaded.error[3] < 0.03


TWO_FAR = Station((0.1, 0.5, 0.6, 0.7)), Station((0.0, 0.9, 0.9, 0.4))

PLAY = 0.0175  # rad, 1 degree

ONSET = 2.0  # s, in which vibration is noticed and fades

ELASTIC = [(150.0, PLAY, 100.0), (1000.0, 0.0, 250.0)]


@pytest.mark.thorough
@pytest.mark.parametrize(("stiffness", "play", "rate"), ELASTIC)
def test_a_tour_of_an_elastic_arm_ends_with_the_true_torques_of_its_links(
    stiffness: float, play: float, rate: float
) -> None:
    truth, speeds = ArmConfig(joint_stiffness=(stiffness,) * 4, backlash=(play,) * 4), list[list[float]]()

    def watch(time: float, device: SimulatedDevice) -> None:
        speeds.append(device.arm.motor_velocities)

    run = TourRun(truth=truth, rate=rate, disturb=watch)
    tour = run.run(fixed(TWO_FAR))
    assert tour.trouble == ""
    assert tour.done
    assert run.safety.fault is None
    links = np.abs(np.array(run.log)[:, 5:9])
    assert links[round(ONSET * rate) :].max() < 1.0  # rad/s
    assert np.quantile(np.abs(speeds), 0.99) < 1.0
    for one in tour.measured:
        rest = link_angles(one.theta, one.effort, (stiffness,) * 4)
        needed = gravity_torque(DEFAULT_LINKS, rest, one.direction)
        np.testing.assert_allclose(one.effort, needed, atol=0.03 + 2.0 * play)


def test_a_tour_that_soft_joints_end_says_so():
    links, weight = DEFAULT_LINKS, (1.0, 0.28)  # kg, m from the elbow
    truth = ArmConfig(
        ArmModel(links.length, links.cog, links.mass * (1.1, 0.85, 0.7, 0.7)), joint_stiffness=(150.0,) * 4,
        wearer_mass=(0.0, 0.0, 0.0, weight[0]), wearer_cog=(0.0, 0.0, 0.0, weight[1]),
    )  # fmt: skip
    motors = [replace(motor, torque_scale=1.2) for motor in MOTORS_AS_MOUNTED]
    tour = TourRun(truth=truth, motors=motors, tilt=(0.05, 0.2), rate=250.0, load=weight).run(fixed(TWO_FAR[1:]))
    assert "motors vibrated, as behind elastic joints" in tour.trouble
    assert not tour.done
