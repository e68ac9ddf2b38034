# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`inertial`: the compensator answers what the arm feels of a trunk that accelerates and turns."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.kinematics import turning_torque

from ..support.compensator_run import PERIOD, ROBOT, THETA, CompensatorRun, settings_with

FORCE = (1.0, -2.0, 11.0)  # m/s^2 upward; an upright trunk that accelerates forward, to the right and upward
DOWN = np.array((2.0, -1.0, 11.0))  # the same as gravity in the left arm's base frame: x0 left, y0 forward, z0 down
STILL = (0.0, 0.0, 0.0)


def run_with(force, spin_up=STILL, seconds=1.3, **changes):
    """Run a compensator on an upright trunk that feels `force` and turns faster by `spin_up`; samples at 100 Hz."""
    run = CompensatorRun(**{"use_imu": True, **changes})
    for cycle in range(round(seconds / PERIOD)):
        if cycle % 5 == 0:
            turning = [run.now * component for component in spin_up]
            run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
            if force is not None:
                run.compensator.motion.add(run.now, force, turning)
        run.cycle()
    return run


def test_the_specific_force_replaces_gravity():
    size = np.linalg.norm(DOWN)
    expected = gravity_torque(ROBOT, THETA, DOWN / size) * size / 9.80665
    np.testing.assert_allclose(run_with(FORCE, inertial=True).efforts[-1], expected, rtol=1e-6)


def test_the_arm_turns_with_a_trunk_that_turns_faster_and_faster():
    spin_up = (1.0, 2.0, -0.5)
    expected = gravity_torque(ROBOT, THETA) + turning_torque(ROBOT, "left", THETA, spin_up)
    run = run_with((0.0, 0.0, 9.80665), spin_up, inertial=True)
    np.testing.assert_allclose(run.efforts[-1], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("force", "changes"),
    [(FORCE, {}), (FORCE, {"inertial": True, "use_imu": False}), (None, {"inertial": True})],
    ids=["not inertial", "without an IMU", "no motion measured"],
)
def test_without_inertial_an_imu_or_measured_motion_only_the_tilt_counts(force, changes):
    run = run_with(force, (1.0, 2.0, 3.0), **changes)
    np.testing.assert_allclose(run.efforts[-1], gravity_torque(ROBOT, THETA), rtol=1e-9)


def test_switching_it_on_does_not_step_the_torque():
    run = run_with(FORCE, inertial=False)
    settings = settings_with(use_imu=True, inertial=True)
    run.compensator.apply(settings)
    before = len(run.efforts)
    for _ in range(1200):
        run.compensator.tilt.set_tilt(run.now, 0.0, 0.0)
        run.compensator.motion.add(run.now, FORCE, STILL)
        run.cycle()
    assert np.abs(np.diff(run.efforts[before - 1 :], axis=0)).max() < 0.01
    assert np.abs(np.subtract(run.efforts[-1], run.efforts[before - 1])).max() > 0.1


def test_with_a_tilt_that_is_too_old_there_is_no_torque_whatever_the_motion():
    run = run_with(FORCE, inertial=True)
    run.compensator.motion.add(run.now, FORCE, STILL)
    run.cycle(0.1)
    run.compensator.motion.add(run.now, FORCE, STILL)
    assert "older than 80 ms" in run.cycle().reason
