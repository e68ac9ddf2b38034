# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Random devices with a wearer in them, and what the package's own calibration finds of each.

The tours of the robot are those of `make study NAME=calibrate`, on a device without further effects. Those of the
wearer are not simulated: MuJoCo gives the torques that hold the worn arm, and a relaxed person breathes. The body-mass
table is wrong for the person by MASS_ERROR and COG_ERROR, and friction is found to WITHIN.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings, robot_of, settings_of
from exo_gravity.core.compensation.terms.catalogue import Friction
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.identification import next_pose
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tour import candidates, hanging
from exo_gravity.lab.calibration.tours import WEARER, wearer_from
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..calibration import ARM, ASSUMED, MODEL, Device, file_of, resting_torque

LENGTH = tuple(DEFAULT_LINKS.length)
STRIBECK = 0.05  # Nm
UPRIGHT = (0.0, 0.0, 1.0)
BODY_MASS = (55.0, 90.0)  # kg
MASS_ERROR, COG_ERROR = 0.15, 0.03  # of the body-mass table: share of a segment's mass; m along the segment
CURRENT_NOISE = 0.02  # of the torque, in replies
BREATHING = 0.1  # Nm
UNSURE = 0.01  # Nm, standard error of a measured torque
WITHIN = 0.1  # share of friction
MOST = 18.0  # Nm that a joint may be asked for
HANGING = (0.0, 0.05, 0.05, 0.05)  # rad


@dataclass(frozen=True, eq=False)
class Worn:
    """A device with a wearer in it. settings, motors: as calibrated; the rest is the truth.

    mounting: (3,) rad, the rotation of gravity that calibration leaves.
    """

    seed: int
    side: str
    config: ArmConfig
    true_motors: list[JointMotor]
    settings: Settings
    motors: tuple[JointMotor, ...]
    mounting: np.ndarray

    @property
    def wearer(self) -> ArmModel:
        """The wearer's true arm."""
        return ArmModel(LENGTH, self.config.wearer_cog, self.config.wearer_mass)

    def device(self) -> SimulatedDevice:
        """Return the simulated device, whose arm hangs."""
        arm = SimulatedArm(self.config)
        arm.reset(HANGING)
        firmware = Firmware(current_noise=CURRENT_NOISE)
        return SimulatedDevice(arm, [SimulatedMotor(motor, firmware) for motor in self.true_motors], self.side)


@cache
def relaxed_poses() -> tuple[tuple[float, ...], ...]:
    """Return the poses of `calibrate wearer`, chosen as it does, the first ones again at the end."""
    low, high = np.maximum(ARM.low, MomentModel.comfortable[0]), np.minimum(ARM.high, MomentModel.comfortable[1])
    limits = replace(ARM.limits, position_min=low.tolist(), position_max=high.tolist())
    poses, taken = candidates(limits, MODEL), [hanging(limits).theta]
    expected = ARM.paper_arm.with_wearer(*Wearer(sum(BODY_MASS) / 2.0).on_links(LENGTH)).moments
    while len(taken) < WEARER.poses:
        best = next_pose(taken, poses, UPRIGHT, expected, MODEL)
        taken.append(tuple(poses[best].tolist()))
        poses = np.delete(poses, best, axis=0)
    return (*taken, *taken[: WEARER.again])


def draw(seed: int) -> Worn:
    """Return the calibrated device `seed`; odd ones are left arms. Raises DataError where a calibration fails."""
    rng, side = np.random.default_rng(3000 + seed), ("right", "left")[seed % 2]
    true = Device(seed, effects=())
    bare = file_of(true, true.observations()[0])
    assert bare.identified is not None
    left = -bare.identified.value.tilt  # the IMU was mounted well, and is corrected by this
    body_mass = float(rng.uniform(*BODY_MASS))
    load = Wearer(body_mass).on_links(LENGTH)
    mechanics: dict[str, Any] = {
        **true.mechanics,
        "wearer_mass": load.mass * rng.uniform(1.0 - MASS_ERROR, 1.0 + MASS_ERROR, 4),
        "wearer_cog": np.clip(load.cog + rng.uniform(-COG_ERROR, COG_ERROR, 4) * (load.mass > 0), 0.0, LENGTH),
        "stribeck_friction": rng.uniform(0.0, STRIBECK, 4),
    }
    config = ArmConfig(**mechanics)
    worn = SimulatedArm(config)
    worn.move_base([STANDARD_GRAVITY * component for component in UPRIGHT])
    values: dict[str, Any] = {change.name: change.value for change in bare.changes}
    motors = tuple(
        replace(motor, torque_scale=scale) for motor, scale in zip(ASSUMED, values.pop("torque_scale"), strict=True)
    )
    strength = np.divide([m.torque_scale for m in true.motors], [m.torque_scale for m in motors])
    friction = np.array([config.coulomb_friction, config.viscous_friction])
    relaxed = tuple(
        Observation(
            theta,
            turned(UPRIGHT, -left),
            (resting_torque(worn, np.array(theta)) + rng.normal(0.0, BREATHING, 4)) / strength,
            friction[0] / strength,
            np.full(4, UNSURE),
        )
        for theta in relaxed_poses()
    )
    found = {**ARM.compensator, "side": side, "wearer.body_mass": body_mass, "mode": "zero_g", "support": 1.0}
    found |= {name: value for name, value in values.items() if name in found}
    result = wearer_from(replace(ARM, robot=robot_of(found), compensator=found), relaxed, 0.0)
    found |= {change.name: change.value for change in result.changes}
    assumed = friction * rng.uniform(1.0 - WITHIN, 1.0 + WITHIN, (2, 4))
    settings = replace(
        settings_of(found),
        max_effort=[min(MOST, motor.peak_effort) for motor in motors],
        terms=TermSettings(friction=Friction(0.0, *assumed)),
    )
    return Worn(seed, side, config, true.motors, settings, motors, left)


def turned(vector: Vector, turn: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,) turned by the small rotation `turn`, (3,) rad."""
    moved = np.asarray(vector) + np.cross(turn, vector)
    return np.asarray(moved / np.linalg.norm(moved))
