"""With friction and inertia the arm neither creeps nor swings in a hold; `python -m bench.holds` is the whole study."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.effort_study import POSES, RATE, effort_settings
from exo_gravity.sim.holds import Held, hold
from exo_gravity.sim.perturbed_arm import perturbed_arm

from ..support.terms_run import MOTORS_OF_ARM

MASS, COG = Wearer(45.0).on_links(DEFAULT_LINKS.length)  # within the motors' peak torque in all poses
PEAK = (9.0, 18.0, 9.0, 9.0)  # Nm


def held(seed: int, pose: tuple[float, ...], wearer_error: float = 1.0) -> Held:
    """Return how the arm moves after the wearer has let go of it, for 3 s."""
    arm = perturbed_arm(seed, MASS.tolist(), COG.tolist())
    robot, worn = arm.calibrated(seed)
    base = Settings(
        "right", robot, wearer_mass=wearer_error * worn, wearer_cog=COG, use_imu=False, max_effort=PEAK, mode="zero_g"
    )
    settings = effort_settings(base, arm.coulomb, arm.viscous)["+ friction and inertia"]
    device = SimulatedDevice(SimulatedArm(arm.config), [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])
    return hold(device, MOTORS_OF_ARM, settings, pose, 3.0, RATE)


@pytest.mark.parametrize(("seed", "pose"), [(0, 3), (0, 9), (1, 6), (2, 11)])
def test_an_arm_with_friction_and_inertia_creeps_less_than_a_fifth_of_a_degree_per_minute(seed, pose):
    drift, swing = held(seed, POSES.poses[pose])
    assert math.degrees(60.0) * np.abs(drift).max() < 0.2
    assert math.degrees(swing.max()) < 0.01


def test_an_arm_whose_wearer_is_a_tenth_heavier_than_known_is_seen_to_fall():
    drift, _ = held(0, POSES.poses[9], wearer_error=0.9)
    assert math.degrees(60.0) * np.abs(drift).max() > 10.0
