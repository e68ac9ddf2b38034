# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.effort.holds: whether the arm creeps or swings in 13 holds with the terms `friction` and `inertia`.

The packaged simulator and five perturbed ones, as they are after a calibration. The wearer has 45 kg: a heavier arm
needs more than the peak torque of the flexion motor in some of these poses. The true motion is judged, not what 12-bit
encoders read. Exit code 1 if a joint drifts faster than 0.2 degrees a minute or swings by more than 0.05 degrees.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from .exertion import POSES, RATE, SETTLING, LettingGo, perform
from .study import BOTH, WEARER_EXCESS, settings_by_name

PACKAGED = 0  # the seed of the packaged simulator
SEEDS = range(6)
BODY_MASS = 45.0  # kg
SECONDS = 6.0
RELEASE = 1.0  # s after letting go, not judged: the hand's last push decays
MAX_DRIFT, MAX_SWING = 0.2, 0.05  # deg/min, deg
CALIBRATED = 0.009  # largest error of a moment after `calibrate gravity`, docs/calibration.md
COULOMB, VISCOUS = np.array((0.2, 0.4, 0.2, 0.2)), np.array((0.02, 0.05, 0.02, 0.02))  # Nm, Nm s/rad


@dataclass(frozen=True)
class PerturbedArm:
    """A simulated arm and what a calibration finds of it, with a wearer of `body_mass` kg."""

    #: The true arm with its wearer.
    config: ArmConfig
    #: The compensator's settings, with the terms `friction` and `inertia`.
    settings: Settings


def perturbed_arm(seed: int, body_mass: float = BODY_MASS, wearer_error: float = 1.0) -> PerturbedArm:
    """Return the packaged simulator for seed 0, else a random arm: masses, friction and wearer differ.

    wearer_error: the wearer's mass as known, as a share of what a calibration finds.
    """
    rng = np.random.default_rng(seed)
    wearer = Wearer(body_mass).on_links(DEFAULT_LINKS.length)
    links, excess, coulomb, viscous, identified = DEFAULT_LINKS, WEARER_EXCESS, COULOMB, VISCOUS, 1.0
    if seed != PACKAGED:
        mass, cog = links.mass * rng.uniform(0.95, 1.05, 4), links.cog * rng.uniform(0.95, 1.0, 4)
        links = ArmModel(links.length, cog, mass)
        coulomb, viscous = COULOMB * rng.uniform(0.7, 1.3, 4), VISCOUS * rng.uniform(0.7, 1.3, 4)
        identified, excess = rng.uniform(0.8, 1.0), rng.uniform(0.95, 1.05)
    config = ArmConfig(
        links,
        wearer_mass=(excess * wearer.mass).tolist(),
        wearer_cog=wearer.cog.tolist(),
        coulomb_friction=coulomb.tolist(),
        viscous_friction=viscous.tolist(),
    )
    rng = np.random.default_rng(seed)
    robot, worn = (1.0 + rng.uniform(-CALIBRATED, CALIBRATED, 4) for _ in range(2))
    base = Settings(
        "right",
        ArmModel(links.length, links.cog, robot * links.mass),
        wearer_mass=(wearer_error * worn * config.wearer_mass).tolist(),
        wearer_cog=wearer.cog.tolist(),
        use_imu=False,
        max_effort=(9.0, 18.0, 9.0, 9.0),
    )
    settings = settings_by_name(base, (identified * coulomb).tolist(), (identified * viscous).tolist())[BOTH]
    assert settings is not None
    return PerturbedArm(config, settings)


def hold(arm: PerturbedArm, pose: tuple[float, ...], seconds: float) -> tuple[float, float]:
    """Let the wearer hold `pose` (4,) rad and let go; return how the arm moves in the following `seconds`.

    The largest drift of a joint in degrees a minute, the slope of a line, and its largest swing about that line in
    degrees.
    """
    motors = configured_arm(packaged_config("sim.yaml")).motors
    device = SimulatedDevice(SimulatedArm(arm.config), [SimulatedMotor(motor) for motor in motors])
    angles, _ = perform(device, motors, arm.settings, LettingGo(pose, RELEASE + seconds))
    free = angles[round((SETTLING + RELEASE) * RATE) :]
    time = np.arange(len(free)) / RATE
    slope, offset = np.polyfit(time, free, 1)
    swing = np.ptp(free - np.outer(time, slope) - offset, axis=0)
    return math.degrees(60.0) * np.abs(slope).max(), math.degrees(swing.max())


def main() -> int:
    """Print one line for each simulator."""
    print(f"largest of any joint in {len(POSES.poses)} holds, {SECONDS:g} s each")
    held = True
    for seed in SEEDS:
        arm = perturbed_arm(seed)
        drift, swing = np.max([hold(arm, pose, SECONDS) for pose in POSES.poses], axis=0)
        name = f"perturbed {seed}" if seed != PACKAGED else "packaged"
        print(f"{name:<12} drift {drift:8.4f} deg/min, swing {swing:9.6f} deg", flush=True)
        held = held and drift <= MAX_DRIFT and swing <= MAX_SWING
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
