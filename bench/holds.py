"""python -m bench.holds: whether the arm creeps or swings in 13 holds with the terms `friction` and `inertia`.

The packaged simulator and five perturbed ones, as they are after a calibration. The wearer has 45 kg: a heavier arm
needs more than the peak torque of the flexion motor in some of these poses. No ROS is used. Exit code 1 if a joint
drifts faster than 0.2 degrees a minute or swings by more than 0.05 degrees.
"""

from __future__ import annotations

import math
import sys

import numpy as np

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.effort_study import POSES, RATE, effort_settings
from exo_gravity.sim.holds import hold
from exo_gravity.sim.perturbed_arm import PACKAGED, PerturbedArm, perturbed_arm
from exo_gravity.tools.inputs.arms import configured_arm
from exo_gravity.tools.inputs.parameter_file import packaged_config

SEEDS = range(6)
BODY_MASS = 45.0  # kg
SECONDS = 6.0
MAX_DRIFT, MAX_SWING = 0.2, 0.05  # deg/min, deg


def main() -> int:
    """Print one line for each simulator."""
    configured = configured_arm(packaged_config("sim.yaml"))
    wearer = Wearer(BODY_MASS).on_links(configured.robot.length)
    peak = [motor.peak_effort for motor in configured.motors]

    def settings_of(arm: PerturbedArm, seed: int) -> Settings:
        robot, worn = arm.calibrated(seed)
        base = Settings(
            "right", robot, wearer_mass=worn.tolist(), wearer_cog=wearer.cog.tolist(), use_imu=False, max_effort=peak
        )
        settings = effort_settings(base, arm.coulomb, arm.viscous)["+ friction and inertia"]
        assert settings is not None
        return settings

    print(f"largest of any joint in {len(POSES.poses)} holds, {SECONDS:g} s each")
    held = True
    for seed in SEEDS:
        arm = perturbed_arm(seed, wearer.mass.tolist(), wearer.cog.tolist())
        settings = settings_of(arm, seed)
        worst = np.zeros(2)
        for pose in POSES.poses:
            motors = [SimulatedMotor(motor) for motor in configured.motors]
            device = SimulatedDevice(SimulatedArm(arm.config), motors)
            drift, swing = hold(device, configured.motors, settings, pose, SECONDS, RATE)
            found = math.degrees(60.0) * np.abs(drift).max(), math.degrees(swing.max())
            worst = np.maximum(worst, found)
        name = f"perturbed {seed}" if seed != PACKAGED else "packaged"
        print(f"{name:<12} drift {worst[0]:8.4f} deg/min, swing {worst[1]:9.6f} deg", flush=True)
        held = held and worst[0] <= MAX_DRIFT and worst[1] <= MAX_SWING
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
