# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated devices with a wrong parameter file: a tour, the identification and the new values, from start to end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.lab.calibration import recorded
from exo_gravity.lab.calibration.poses import Itinerary, friction_stations
from exo_gravity.lab.calibration.tours import friction_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.trial.recording import Recording
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.tools import calibrate

from ..support.calibration_device import MOTORS_AS_MOUNTED, TourRun, fixed
from ..support.synthetic_bags import messages, tilt, write_bag

ARM = configured_arm(packaged_config("sim.yaml"))
MASS = DEFAULT_LINKS.mass * (1.2, 0.8, 1.15, 0.85)
TRUTH = ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog * 0.9, MASS)
SCALES = (0.85, 1.15, 0.9, 1.0)
FRICTION = np.array((0.2, 0.4, 0.2, 0.2))


def device(**changes):
    """A device of the true arm and scales, whose controller assumes the file's."""
    motors = [replace(motor, torque_scale=scale) for motor, scale in zip(MOTORS_AS_MOUNTED, SCALES, strict=True)]
    return TourRun(truth=changes.pop("truth", ArmConfig(TRUTH)), motors=motors, **changes)


@pytest.fixture(scope="module")
def tours():
    """A tour of eight poses without a weight, and one with 0.5 kg at 0.25 m."""
    weight = (0.5, 0.25)
    loaded = ArmConfig(TRUTH, wearer_mass=(0.0, 0.0, 0.0, weight[0]), wearer_cog=(0.0, 0.0, 0.0, weight[1]))
    runs = device(), device(truth=loaded, load=weight)
    return [(run, run.run(Itinerary(run.limits, 8, 160.0))) for run in runs]


def recorded_by(run, folder, torque_scale=1.0):
    """Write what the nodes would have published during `run` as a bag; return its folder.

    torque_scale: that of the bridge, which divides the efforts by it.
    """
    table = np.array(run.log)
    unknown = np.full((len(table), 4), np.nan)
    efforts = table[:, 9:13] * torque_scale
    states = Recording("right", ARM.joint_names, table[:, 0], table[:, 1:5], unknown, unknown, efforts)
    return write_bag(folder, [*messages(states), *(tilt(now, *run.tilt) for now in table[::10, 0])])


@pytest.mark.thorough
def test_the_recording_of_a_tour_gives_the_same_torques(tours, tmp_path):
    run, tour = tours[0]
    found = recorded.observations_of(recorded_by(run, tmp_path / "bag"), ARM, with_held=False)
    assert len(found) >= 10  # up to two for each pose; none where a joint sticks for a moment
    for one in found:
        same = min(tour.measured, key=lambda o: np.abs(np.subtract(o.theta, one.theta)).max())
        np.testing.assert_allclose(one.theta, same.theta, atol=0.02)
        np.testing.assert_allclose(one.direction, same.direction, atol=1e-6)
        np.testing.assert_allclose(one.effort, same.effort, atol=0.06)
        np.testing.assert_allclose(one.friction, same.friction, atol=0.06)
        assert np.all((one.speed > 0.03) & (one.speed < 0.3))


def test_held_poses_are_as_uncertain_as_friction(tmp_path):
    poses = np.random.default_rng(5).uniform((-1.0, 0.2, -0.3, 0.2), (1.0, 1.6, 1.5, 1.8), (6, 4))
    position, time = np.repeat(poses, 300, axis=0), 0.01 * np.arange(1800) + np.repeat(5.0 * np.arange(6), 300)
    unknown = np.full_like(position, np.nan)
    holds = Recording("right", ARM.joint_names, time, position, unknown, gravity_torque(TRUTH, position), unknown)
    upright = replace(ARM, compensator={**ARM.compensator, "use_imu": False})
    found = recorded.observations_of(write_bag(tmp_path / "bag", messages(holds)), upright)
    np.testing.assert_allclose([o.theta for o in found], poses, atol=1e-3)
    assert np.min([o.spread for o in found]) > 0.2


@pytest.mark.thorough
def test_recordings_without_and_with_the_weight_give_kilograms_and_true_scales(tours, tmp_path):
    files = [str(packaged_config("sim.yaml")), str(tmp_path / "1.yaml"), str(tmp_path / "2.yaml")]
    bare = str(recorded_by(tours[0][0], tmp_path / "bare"))
    assert calibrate.main(["gravity", "--params", files[0], "--output", files[1], "--bag", bare]) == 0
    scale = configured_arm(Path(files[1])).can_bridge["torque_scale"]
    loaded = str(recorded_by(tours[1][0], tmp_path / "loaded", scale))
    weight = ["--mass", "0.5", "--lever", "0.25"]
    assert calibrate.main(["scale", "--params", files[1], "--output", files[2], "--bag", loaded, *weight]) == 0
    found = configured_arm(Path(files[2]))
    np.testing.assert_allclose(found.can_bridge["torque_scale"][1:], SCALES[1:], rtol=0.04)
    np.testing.assert_allclose(found.robot.first_moment[1:], TRUTH.first_moment[1:], rtol=0.04)


@pytest.mark.thorough
def test_sweeps_at_five_speeds_give_the_friction_of_each_joint_live_and_recorded(tmp_path):
    truth = ArmConfig(TRUTH, coulomb_friction=(0.25, 0.35, 0.18, 0.22), viscous_friction=(0.1, 0.2, 0.1, 0.1))
    run = TourRun(truth=truth)
    tour = run.run(fixed(friction_stations(run.limits)))
    assert tour.trouble == ""
    for measured in (tour.measured, recorded.observations_of(recorded_by(run, tmp_path / "bag"), ARM, with_held=False)):
        result = friction_from(ARM, measured)
        assert result.refusals == ()
        for joint, curve in enumerate(result.curves):
            steady = curve.speed >= 0.05
            true = truth.coulomb_friction[joint] + truth.viscous_friction[joint] * curve.speed[steady]
            np.testing.assert_allclose(curve.fitted[steady], true, atol=0.02)
