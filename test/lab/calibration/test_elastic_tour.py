# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour of an arm with elastic joints: its motors do not vibrate on, and what it measures is true of the links."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.joint_stiffness import link_angles
from exo_gravity.core.compensation.tracking import Station, Vibration
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS

from ...support.tour_run import TourRun, fixed

TWO = Station((0.1, 0.5, 0.6, 0.7)), Station((0.0, 0.9, 0.9, 0.4))
PLAY = 0.0175  # rad, 1 degree


@pytest.mark.parametrize(
    ("stiffness", "play", "rate"), [(150.0, PLAY, 100.0), (150.0, 0.0, 500.0), (1000.0, 0.0, 250.0)]
)
def test_a_tour_of_an_elastic_arm_ends_with_the_true_torques_of_its_links(
    stiffness: float, play: float, rate: float
) -> None:
    truth, speeds = ArmConfig(joint_stiffness=(stiffness,) * 4, backlash=(play,) * 4), list[list[float]]()
    run = TourRun(truth=truth, rate=rate, disturb=lambda time, device: speeds.append(device.arm.motor_velocities))
    tour = run.run(fixed(TWO))
    assert tour.trouble == ""
    assert tour.done
    assert run.safety.fault is None
    assert run.fastest < 1.0  # rad/s, of the links
    assert np.quantile(np.abs(speeds), 0.999) < 1.0  # of the motors, most of the time
    for one in tour.measured:
        links = link_angles(one.theta, one.effort, (stiffness,) * 4)
        needed = gravity_torque(DEFAULT_LINKS, links, one.direction)
        np.testing.assert_allclose(one.effort, needed, atol=0.03 + 3.0 * play)


def seen(speeds: list[float], rate: float) -> bool:
    """Return whether these speeds of a motor in rad/s, at `rate` Hz, are seen as a vibration."""
    vibration = Vibration(1)
    return any(vibration.step(1.0 / rate, (speed,)).any() for speed in speeds)


@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
@pytest.mark.parametrize("frequency", [28.0, 66.0, 170.0])  # Hz, of an AK80-9 on 150 Nm/rad, an AK60-6 on it, on 1,000
def test_a_rotor_that_rings_vibrates_at_any_rate(frequency: float, rate: float) -> None:
    ringing = 0.3 + 0.3 * np.sin(2.0 * np.pi * frequency / rate * np.arange(rate))
    assert seen(ringing.tolist(), rate)


def test_a_joint_that_leaves_its_friction_again_and_again_does_not_vibrate() -> None:
    stick_and_slip = [*[0.0] * 40, 0.2, 0.4, 0.5, 0.3, 0.1, -0.15, -0.1, 0.0]
    assert not seen(stick_and_slip * 20, 250.0)
