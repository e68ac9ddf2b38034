# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour of an arm with elastic joints: its motors do not vibrate on, and what it measures is true of the links."""

from __future__ import annotations

from dataclasses import replace
from itertools import repeat

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.joint_stiffness import link_angles
from exo_gravity.core.compensation.tracking import TRACKER, Line, Station, Tracker
from exo_gravity.sim import ArmConfig, SimulatedDevice
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.calibration_device import MOTORS_AS_MOUNTED, TourRun, fixed
from ...support.thorough import quick

TWO = Station((0.1, 0.5, 0.6, 0.7)), Station((0.0, 0.9, 0.9, 0.4))
PLAY = 0.0175  # rad, 1 degree
ONSET = 2.0  # s, in which vibration is noticed and fades


ELASTIC = [(150.0, PLAY, 100.0), (1000.0, 0.0, 250.0)]


@pytest.mark.parametrize(("stiffness", "play", "rate"), quick(ELASTIC[:1], ELASTIC))
def test_a_tour_of_an_elastic_arm_ends_with_the_true_torques_of_its_links(
    stiffness: float, play: float, rate: float
) -> None:
    truth, speeds = ArmConfig(joint_stiffness=(stiffness,) * 4, backlash=(play,) * 4), list[list[float]]()

    def watch(time: float, device: SimulatedDevice) -> None:
        speeds.append(device.arm.motor_velocities)

    run = TourRun(truth=truth, rate=rate, disturb=watch)
    tour = run.run(fixed(TWO))
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


def test_gains_that_were_lowered_in_a_heavy_pose_still_move_a_joint_that_carries_little():
    period, heavy, light, behind = 0.004, np.array([[0.6]]), np.array([[0.03]]), 0.05  # s, kg m^2, rad
    tracker = Tracker(1.0 / period, (9.0,))
    tracker.lines = repeat(Line(np.zeros(1), np.zeros(1)))
    for cycle in range(500):
        tracker.step(period, [0.0], [0.3 * (-1.0) ** cycle], (0.0,), (0.0, 0.0, 1.0), heavy)
    assert tracker.is_soft.all()
    before = tracker.correction[0]
    for _ in range(40):
        tracker.step(period, [-behind], [0.0], (0.0,), (0.0, 0.0, 1.0), light)
    assert tracker.correction[0] - before > 0.9 * TRACKER.least_stiffness * behind


def test_a_tour_that_soft_joints_end_says_that_motors_vibrated():
    links, weight = DEFAULT_LINKS, (1.0, 0.28)  # kg, m from the elbow
    truth = ArmConfig(
        ArmModel(links.length, links.cog, links.mass * (1.1, 0.85, 0.7, 0.7)), joint_stiffness=(150.0,) * 4,
        wearer_mass=(0.0, 0.0, 0.0, weight[0]), wearer_cog=(0.0, 0.0, 0.0, weight[1]),
    )  # fmt: skip
    motors = [replace(motor, torque_scale=1.2) for motor in MOTORS_AS_MOUNTED]
    tour = TourRun(truth=truth, motors=motors, tilt=(0.05, 0.2), rate=250.0, load=weight).run(fixed(TWO))
    assert "motors vibrated, as behind elastic joints" in tour.trouble
    assert not tour.done
