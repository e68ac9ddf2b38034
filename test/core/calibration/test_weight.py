"""A tour with a weight on link 4: what the controller knows of its inertia, and which poses leave room."""

from __future__ import annotations

import numpy as np

from exo_gravity.core.calibration.guess import TorqueGuess
from exo_gravity.core.calibration.poses import BestPoses, Progress
from exo_gravity.core.calibration.tracking import MassMatrix
from exo_gravity.core.model.moments import load_moments, moments_of
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.safety.limits import Limits
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.tour_run import NAMES, assert_close_to_device

WEIGHT = (1.0, 0.28)  # kg, m from the elbow
MOMENTS = moments_of(DEFAULT_LINKS) + load_moments(DEFAULT_LINKS.length.tolist(), *WEIGHT)


def test_the_mass_matrix_with_a_weight_is_close_to_that_of_the_device():
    arm = SimulatedArm(ArmConfig(wearer_mass=(0, 0, 0, WEIGHT[0]), wearer_cog=(0, 0, 0, WEIGHT[1])))
    matrix = MassMatrix(DEFAULT_LINKS.length, MOMENTS[:4], WEIGHT)
    assert_close_to_device(matrix, arm, 0.025)


def test_the_sweeps_of_a_chosen_pose_and_the_way_home_need_no_more_than_the_motors_may_give():
    limits = Limits(NAMES)
    guess = TorqueGuess(DEFAULT_LINKS.length, MOMENTS, Tilt.of("right", 0.05, 0.2), 9.81)
    itinerary, taken = BestPoses(limits, 8, 160.0), np.empty((0, 4))
    itinerary.next(taken, Progress(np.zeros(4), 0.0), guess, (0.0,) * 4)  # the hanging arm
    while station := itinerary.next(taken, Progress(np.zeros(4), 15.0 * len(taken)), guess, (0.2,) * 4):
        ways = [station.low, station.high, *(share * np.array(station.theta) for share in np.linspace(0.0, 1.0, 20))]
        assert np.all(np.abs(guess.torques(np.array(ways))[0]) < 0.95 * np.array(limits.max_effort))
        taken = np.vstack((taken, station.theta))
    assert len(taken) == 8
