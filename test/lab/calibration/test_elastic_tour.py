# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour of an arm with elastic joints: its motors do not vibrate on, and what it measures is true of the links."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.joint_stiffness import link_angles
from exo_gravity.core.compensation.tracking import Station
from exo_gravity.sim import ArmConfig, SimulatedDevice
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.thorough import quick
from ...support.tour_run import TourRun, fixed

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
