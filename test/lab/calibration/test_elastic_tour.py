# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour of an arm with elastic joints: its motors do not vibrate on, and what it measures is true of the links."""

from __future__ import annotations

import numpy as np

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.joint_stiffness import link_angles
from exo_gravity.core.compensation.tracking import TRACKER, Station, Vibration
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.tour_run import TourRun, fixed

TWO = Station((0.1, 0.5, 0.6, 0.7)), Station((0.0, 0.9, 0.9, 0.4))


def test_a_tour_of_an_elastic_arm_ends_with_the_true_torques_of_its_links() -> None:
    stiffness, rate = 1000.0, 250.0  # Nm/rad, Hz
    truth = ArmConfig(joint_stiffness=(stiffness,) * 4)
    run = TourRun(truth=truth, rate=rate)
    tour = run.run(fixed(TWO))
    assert tour.trouble == ""
    assert tour.done
    assert run.safety.fault is None
    for one in tour.measured:
        links = link_angles(one.theta, one.effort, (stiffness,) * 4)
        needed = gravity_torque(DEFAULT_LINKS, links, one.direction)
        np.testing.assert_allclose(one.effort, needed, atol=0.03)


def test_a_ringing_rotor_is_a_vibration_and_a_joint_that_leaves_its_friction_is_none() -> None:
    ringing = 0.15 * np.sin(2.0 * np.pi * 170.0 / 250.0 * np.arange(50))  # rad/s, an AK60-6 on 1,000 Nm/rad
    leaving = [0.0, 0.0, 0.15, 0.3, 0.3, 0.15, *[0.0] * 20, -0.15, -0.25, -0.1, *[0.0] * 20]
    for speeds, vibrates in ((ringing, True), (leaving, False)):
        vibration = Vibration(1)
        seen = max(vibration.step(np.array([speed])) for speed in speeds)
        assert (seen > TRACKER.vibration) == vibrates
