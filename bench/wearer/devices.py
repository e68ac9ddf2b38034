# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Random devices with a wearer in them, and what the package's own calibration finds of each.

`identify` and `wearer_from` work on what slow tours measure: torques of the true arm, a worn one's by MuJoCo, with
friction of both signs, noise and 12-bit codes (random_device.py), gravity's direction as an IMU gives
it that is mounted a degree off, and a relaxed person who breathes. The tours themselves are not simulated; `make study
NAME=calibrate` does that, and leaves errors of the same size. The body-mass table is wrong for the person by MASS_ERROR
and COG_ERROR, and friction is found to WITHIN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings, robot_of, settings_of
from exo_gravity.core.compensation.terms.catalogue import Friction
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.identification import identify
from exo_gravity.lab.calibration.poses import candidates, hanging, next_pose
from exo_gravity.lab.calibration.tours import moments_from
from exo_gravity.lab.calibration.wearer import WEARER, wearer_from
from exo_gravity.lab.calibration.worn_arm import WORN
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from ..calibration import COULOMB, LARGEST_OFFSET, SPREAD, VISCOUS
from .random_device import LEANING, LENGTH, PAPERS, UPRIGHT, Device, off_axis_of

MOTOR_NAMES = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
STRIBECK = 0.05  # Nm
LEANT = Tilt.of("right", -0.15, 0.22).direction  # the stand while the weight hangs
MOUNTING = math.radians(1.2)  # of the IMU, before the weight of the arm corrects it
BODY_MASS = (55.0, 90.0)  # kg
MASS_ERROR, COG_ERROR = 0.15, 0.03  # of the body-mass table: share of a segment's mass; m along the segment
CURRENT_NOISE = 0.02  # of the torque, in replies
BREATHING = 0.1  # Nm
WITHIN = 0.1  # share of friction
MOST = 18.0  # Nm that a joint may be asked for
HANGING = (0.0, 0.05, 0.05, 0.05)  # rad
NOTHING = (0.0,) * 4


@dataclass(frozen=True, eq=False)
class Worn:
    """A device with a wearer in it. settings, motors: as calibrated; the rest is the truth.

    mounting: (3,) rad, the rotation of gravity that calibration leaves.
    """

    seed: int
    side: str
    config: ArmConfig
    scale: np.ndarray
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
        motors = zip(self.motors, self.scale.tolist(), strict=True)
        true = [SimulatedMotor(replace(motor, torque_scale=scale), firmware) for motor, scale in motors]
        return SimulatedDevice(arm, true, self.side)


class WornDevice(Device):
    """A device with a relaxed wearer in it. device: the robot. config: of the simulated arm with the wearer."""

    def __init__(self, device: Device, config: ArmConfig) -> None:
        self.rng, self.scale, self.friction, self.offset = device.rng, device.scale, device.friction, device.offset
        self._arm = SimulatedArm(config)

    def effort(self, theta: Vector, direction: Vector, added: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the commands (1, 4) in Nm that hold the arm without friction."""
        return np.asarray(holding(self._arm, theta, direction) / self.scale + self.offset)[None]


def holding(arm: SimulatedArm, theta: Vector, direction: Vector) -> np.ndarray:
    """Return the torque (4,) in Nm that holds a simulated arm at `theta` (4,) rad, without friction, by MuJoCo.

    direction: gravity's unit vector (3,) in the base frame.
    """
    arm.move_base([STANDARD_GRAVITY * component for component in direction])
    arm.reset(theta)
    return np.asarray(arm.data.qfrc_bias - arm.data.qfrc_passive)


@cache
def relaxed_poses() -> tuple[tuple[float, ...], ...]:
    """Return the poses of `calibrate wearer`, chosen as it does, the first ones again at the end."""
    nominal = configured_arm(packaged_config("sim.yaml"))
    low, high = np.maximum(nominal.low, WORN.comfortable[0]), np.minimum(nominal.high, WORN.comfortable[1])
    limits = replace(nominal.limits, position_min=low.tolist(), position_max=high.tolist())
    poses, taken = candidates(limits, PAPERS), [hanging(limits).theta]
    expected = moments_of(nominal.robot.with_wearer(*Wearer(sum(BODY_MASS) / 2.0).on_links(LENGTH)))
    while len(taken) < WEARER.poses:
        best = next_pose(taken, poses, UPRIGHT, expected, PAPERS)
        taken.append(tuple(poses[best].tolist()))
        poses = np.delete(poses, best, axis=0)
    return (*taken, *taken[: WEARER.again])


def draw(seed: int) -> Worn:
    """Return the calibrated device `seed`; odd ones are left arms. Raises DataError where a calibration fails."""
    rng, side = np.random.default_rng(3000 + seed), ("right", "left")[seed % 2]
    low, high = 1.0 - SPREAD, 1.0 + SPREAD
    mass = DEFAULT_LINKS.mass * rng.uniform(low, high, 4)
    cog = np.minimum(DEFAULT_LINKS.cog * rng.uniform(low, high, 4), LENGTH)
    y, z = rng.uniform(-LARGEST_OFFSET, LARGEST_OFFSET, (2, 4))
    links = ArmModel(LENGTH, cog, mass, off_axis=off_axis_of(mass, y, z))
    body_mass = float(rng.uniform(*BODY_MASS))
    load = Wearer(body_mass).on_links(LENGTH)
    worn_mass = load.mass * rng.uniform(1.0 - MASS_ERROR, 1.0 + MASS_ERROR, 4)
    worn_cog = np.clip(load.cog + rng.uniform(-COG_ERROR, COG_ERROR, 4) * (load.mass > 0), 0.0, LENGTH)
    scale, coulomb, viscous = rng.uniform(low, high, 4), rng.uniform(*COULOMB, 4), rng.uniform(*VISCOUS, 4)
    stribeck = rng.uniform(0.0, STRIBECK, 4)
    columns = {
        "wearer_mass": worn_mass, "wearer_cog": worn_cog, "coulomb_friction": coulomb, "viscous_friction": viscous,
        "stribeck_friction": stribeck, "cog_y": y, "cog_z": z,
    }  # fmt: skip
    config = ArmConfig(ArmModel(LENGTH, cog, mass), **{name: column.tolist() for name, column in columns.items()})
    true = Device(seed)
    true.moments, true.scale, true.friction, true.offset = moments_of(links), scale, coulomb, np.zeros(4)
    turn = rng.normal(0.0, MOUNTING, 3)
    tours = [*true.tour(LEANING, 8, 0), *true.tour(LEANT, 0, 4)]
    seen = [one._replace(direction=turned(one.direction, -turn)) for one in tours]
    nominal = configured_arm(packaged_config("sim.yaml"))
    bare = moments_from(nominal, seen)
    left = turn - identify(seen, PAPERS).tilt
    values: dict[str, Any] = {change.name: change.value for change in bare.changes}
    found = {**nominal.compensator, "side": side, "wearer.body_mass": body_mass, "mode": "zero_g", "support": 1.0}
    found |= {name: value for name, value in values.items() if name != "torque_scale"}
    true.scale = scale / values["torque_scale"]
    worn = WornDevice(true, config)
    relaxed = tuple(
        one._replace(effort=one.effort + rng.normal(0.0, BREATHING, 4), direction=turned(one.direction, -left))
        for one in (worn.observe(theta, UPRIGHT) for theta in relaxed_poses())
    )
    arm = replace(nominal, robot=robot_of(found), compensator=found)
    result = wearer_from(arm, relaxed, 0.0)
    found |= {change.name: change.value for change in result.changes}
    wrong = rng.uniform(1.0 - WITHIN, 1.0 + WITHIN, (2, 4))
    motors = tuple(
        JointMotor(MOTORS[name], n + 1, torque_scale=values["torque_scale"][n]) for n, name in enumerate(MOTOR_NAMES)
    )
    settings = replace(
        settings_of(found), max_effort=[min(MOST, motor.peak_effort) for motor in motors],
        terms=TermSettings(friction=Friction(0.0, coulomb * wrong[0], viscous * wrong[1])),
    )  # fmt: skip
    return Worn(seed, side, config, scale, settings, motors, left)


def turned(vector: Vector, turn: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,) turned by the small rotation `turn`, (3,) rad."""
    moved = np.asarray(vector) + np.cross(turn, vector)
    return np.asarray(moved / np.linalg.norm(moved))
