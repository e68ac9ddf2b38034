# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Random devices with a wearer in them, and what the package's own calibration finds of each.

`identify` and `wearer_from` work on what slow tours measure: torques of the true arm with friction of both signs, noise
and 12-bit codes (test/support/random_device.py), gravity's direction as an IMU gives it that is mounted a degree off,
and a relaxed person who breathes. The tours themselves are not simulated; `make study NAME=calibrate` does that, and
leaves errors of the same size. The body-mass table is wrong for the person by MASS_ERROR and COG_ERROR, and friction is
found to WITHIN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.calibration.device import COULOMB, CURRENT_NOISE, LARGEST_OFFSET, SPREAD, VISCOUS
from bench.calibration.random_device import LEANING, LENGTH, Device, off_axis_of
from bench.motion_monitor import MOTOR_NAMES
from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import gravity_torque, moments_of
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings, robot_of, settings_of
from exo_gravity.core.compensation.terms.catalogue import Friction
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.identification import identify
from exo_gravity.lab.calibration.tours import moments_from, wearer_from
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

STRIBECK = 0.05  # Nm
LEANT = Tilt.of("right", -0.15, 0.22).direction  # the stand while the weight hangs
MOUNTING = math.radians(1.2)  # of the IMU, before the weight of the arm corrects it
BODY_MASS = (55.0, 90.0)  # kg
MASS_ERROR, COG_ERROR = 0.15, 0.03  # of the body-mass table: share of a segment's mass; m along the segment
RELAXED = np.array(((0.0, 0.1, 0.1, 0.2), (0.3, 0.9, 0.2, 0.6), (-0.2, 0.6, 1.0, 0.4), (0.4, 1.1, 0.6, 1.4)))  # rad
EQUILIBRIUM = 1  # of them, for the way of that name
BREATHING = 0.1  # Nm
WITHIN = 0.1  # share of friction
MOST = 18.0  # Nm that a joint may be asked for
HANGING = (0.0, 0.05, 0.05, 0.05)  # rad


@dataclass(frozen=True, eq=False)
class Worn:
    """A device with a wearer in it. settings, motors: as calibrated; the rest is the truth.

    mounting: (3,) rad, the rotation of gravity that calibration leaves. ways: the wearer's arm by each of the three
    ways of `ways.py`.
    """

    seed: int
    side: str
    config: ArmConfig
    scale: np.ndarray
    settings: Settings
    motors: tuple[JointMotor, ...]
    mounting: np.ndarray
    ways: tuple[ArmModel, ArmModel, ArmModel]

    @property
    def wearer(self) -> ArmModel:
        """The wearer's true arm."""
        return ArmModel(LENGTH, self.config.wearer_cog, self.config.wearer_mass)

    def device(self, arm: SimulatedArm | None = None) -> SimulatedDevice:
        """Return the simulated device, whose arm hangs. arm: another one than that of `config`."""
        arm = arm or SimulatedArm(self.config)
        arm.reset(HANGING)
        firmware = Firmware(current_noise=CURRENT_NOISE)
        motors = zip(self.motors, self.scale.tolist(), strict=True)
        true = [SimulatedMotor(replace(motor, torque_scale=scale), firmware) for motor, scale in motors]
        return SimulatedDevice(arm, true, self.side)


def draw(seed: int) -> Worn:
    """Return the calibrated device `seed`; odd ones are left arms."""
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
    left = turn - identify(seen, LENGTH).tilt
    values: dict[str, Any] = {change.name: change.value for change in bare.changes}
    found = {**nominal.compensator, "side": side, "wearer.body_mass": body_mass, "mode": "zero_g", "support": 1.0}
    found |= {name: value for name, value in values.items() if name != "torque_scale"}
    # With the new scales, and the relaxed wearer
    true.scale = scale / values["torque_scale"]
    carried = moments_of(ArmModel(LENGTH, worn_cog, worn_mass))
    relaxed = [true.observe(theta, LEANING, added=carried) for theta in RELAXED]
    relaxed = [
        one._replace(effort=one.effort + rng.normal(0.0, BREATHING, 4), direction=turned(one.direction, -left))
        for one in relaxed
    ]
    arm = replace(nominal, robot=robot_of(found), compensator=found)
    found |= {change.name: change.value for change in wearer_from(arm, relaxed).changes}
    pose = relaxed[EQUILIBRIUM]
    tabled = gravity_torque(ArmModel(LENGTH, load.cog, load.mass), pose.theta, pose.direction)
    carried_there = pose.effort - gravity_torque(arm.robot, pose.theta, pose.direction)
    scaled = load.mass * (tabled @ carried_there) / (tabled @ tabled)
    full = settings_of(found)
    ways = (
        ArmModel(LENGTH, load.cog, load.mass),
        ArmModel(LENGTH, full.wearer_cog, full.wearer_mass),
        ArmModel(LENGTH, load.cog, scaled),
    )
    wrong = rng.uniform(1.0 - WITHIN, 1.0 + WITHIN, (2, 4))
    motors = tuple(
        JointMotor(MOTORS[name], n + 1, torque_scale=values["torque_scale"][n]) for n, name in enumerate(MOTOR_NAMES)
    )
    settings = replace(
        full, max_effort=[min(MOST, motor.peak_effort) for motor in motors],
        terms=TermSettings(friction=Friction(0.0, coulomb * wrong[0], viscous * wrong[1])),
    )  # fmt: skip
    return Worn(seed, side, config, scale, settings, motors, left, ways)


def turned(vector: Vector, turn: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,) turned by the small rotation `turn`, (3,) rad."""
    moved = np.asarray(vector) + np.cross(turn, vector)
    return np.asarray(moved / np.linalg.norm(moved))
