# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Random devices with a wearer in them, and what the package's own calibration finds of each.

`identify` and `wearer_from` work on what slow tours measure: torques of the true arm, a worn one's by MuJoCo, with
friction of both signs, noise and 12-bit codes (bench/calibration/random_device.py), gravity's direction as an IMU gives
it that is mounted a degree off, and a relaxed person who breathes. The tours themselves are not simulated; `make study
NAME=calibrate` does that, and leaves errors of the same size. The body-mass table is wrong for the person by MASS_ERROR
and COG_ERROR, and friction is found to WITHIN. What else the wearer has is one of EFFECTS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from bench.calibration.device import COULOMB, CURRENT_NOISE, LARGEST_OFFSET, SPREAD, VISCOUS
from bench.calibration.random_device import LEANING, LENGTH, PAPERS, UPRIGHT, Device, off_axis_of
from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings, robot_of, settings_of
from exo_gravity.core.compensation.terms.catalogue import Friction
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.numbers import Vector
from exo_gravity.lab.calibration.identification import identify
from exo_gravity.lab.calibration.poses import candidates, hanging, next_pose
from exo_gravity.lab.calibration.tours import moments_from
from exo_gravity.lab.calibration.wearer import WEARER, wearer_from
from exo_gravity.lab.calibration.worn_arm import WORN
from exo_gravity.lab.inputs.arms import ConfiguredArm, configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from .strapped_arm import StrappedArm

MOTOR_NAMES = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
STRIBECK = 0.05  # Nm
LEANT = Tilt.of("right", -0.15, 0.22).direction  # the stand while the weight hangs
MOUNTING = math.radians(1.2)  # of the IMU, before the weight of the arm corrects it
BODY_MASS = (55.0, 90.0)  # kg
MASS_ERROR, COG_ERROR = 0.15, 0.03  # of the body-mass table: share of a segment's mass; m along the segment
# What the body-mass table leaves out of the wearer's arm; `shoulder` is a strapped arm (strapped_arm.py), not in `all`:
EFFECTS = ("none", "beside", "springs", "carries", "all", "shoulder")
BESIDE = 0.04  # m, of both segments' centres of gravity from their links, in any direction
STIFFNESS, REST, REST_SPREAD = 1.5, (0.1, 0.5, 0.4, 0.8), 0.3  # Nm/rad and rad, of all joints
CARRIED = 0.2  # share of their arm that they may carry while they mean to relax, the same in all poses
BREATHING = 0.1  # Nm
WITHIN = 0.1  # share of friction
MOST = 18.0  # Nm that a joint may be asked for
HANGING = (0.0, 0.05, 0.05, 0.05)  # rad
NOTHING = (0.0,) * 4


@dataclass(frozen=True, eq=False)
class Worn:
    """A device with a wearer in it. settings, motors: as calibrated; the rest is the truth.

    mounting: (3,) rad, the rotation of gravity that calibration leaves. calibrated: the arm with all but its wearer, as
    it was when `relaxed` was seen. refusals: of the calibration of the wearer. is_strapped: whether the wearer's arm
    moves in its straps, and their shoulder moves.
    """

    seed: int
    side: str
    config: ArmConfig
    scale: np.ndarray
    settings: Settings
    motors: tuple[JointMotor, ...]
    mounting: np.ndarray
    calibrated: ConfiguredArm
    relaxed: tuple[Observation, ...]
    refusals: tuple[str, ...]
    is_strapped: bool

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


class WornDevice(Device):
    """A device whose wearer means to relax, and carries the share `carried` of their arm's weight.

    device: the robot. config, is_strapped: of the simulated arm with the wearer in it, which needs the motors' torques.
    """

    def __init__(self, device: Device, config: ArmConfig, carried: float, is_strapped: bool) -> None:
        self.is_strapped = is_strapped
        self.rng, self.scale, self.friction, self.offset = device.rng, device.scale, device.friction, device.offset
        self._arm, self._bare, self._passive, self._carried = *simulated(config, is_strapped), carried

    def effort(self, theta: Vector, direction: Vector, added: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the commands (1, 4) in Nm that hold the arm without friction."""
        weight = holding(self._passive, theta, direction) - holding(self._bare, theta, direction)
        torque = holding(self._arm, theta, direction) - self._carried * weight
        return np.asarray(torque / self.scale + self.offset)[None]


def simulated(config: ArmConfig, is_strapped: bool) -> tuple[SimulatedArm, SimulatedArm, SimulatedArm]:
    """Return the arm of `config`, the same without a wearer, and with a wearer whose joints have no springs."""
    bare = replace(config, wearer_mass=NOTHING, wearer_stiffness=NOTHING)
    worn = StrappedArm(config) if is_strapped else SimulatedArm(config)
    return worn, SimulatedArm(bare), SimulatedArm(replace(config, wearer_stiffness=NOTHING))


def holding(arm: SimulatedArm, theta: Vector, direction: Vector) -> np.ndarray:
    """Return the torque (4,) in Nm that holds a simulated arm at `theta` (4,) rad, without friction, by MuJoCo.

    direction: gravity's unit vector (3,) in the base frame.
    """
    arm.move_base([STANDARD_GRAVITY * component for component in direction])
    if isinstance(arm, StrappedArm):
        return arm.held(theta)
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


def draw(seed: int, effect: str = "none") -> Worn:
    """Return the calibrated device `seed`; odd ones are left arms. effect: one of EFFECTS."""
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
    person, carried = _of_effect(seed, effect)
    columns = {
        "wearer_mass": worn_mass, "wearer_cog": worn_cog, "coulomb_friction": coulomb, "viscous_friction": viscous,
        "stribeck_friction": stribeck, "cog_y": y, "cog_z": z, **person,
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
    worn = WornDevice(true, config, carried, effect == "shoulder")
    relaxed = tuple(
        one._replace(effort=one.effort + rng.normal(0.0, BREATHING, 4), direction=turned(one.direction, -left))
        for one in (worn.observe(theta, UPRIGHT) for theta in relaxed_poses())
    )
    arm = replace(nominal, robot=robot_of(found), compensator=found)
    result = wearer_from(arm, relaxed, CARRIED if effect in ("carries", "all") else 0.0)
    found |= {change.name: change.value for change in result.changes}
    wrong = rng.uniform(1.0 - WITHIN, 1.0 + WITHIN, (2, 4))
    motors = tuple(
        JointMotor(MOTORS[name], n + 1, torque_scale=values["torque_scale"][n]) for n, name in enumerate(MOTOR_NAMES)
    )
    settings = replace(
        settings_of(found), max_effort=[min(MOST, motor.peak_effort) for motor in motors],
        terms=TermSettings(friction=Friction(0.0, coulomb * wrong[0], viscous * wrong[1])),
    )  # fmt: skip
    return Worn(seed, side, config, scale, settings, motors, left, arm, relaxed, result.refusals, worn.is_strapped)


def _of_effect(seed: int, effect: str) -> tuple[dict[str, np.ndarray], float]:
    """Return what the simulated wearer has beyond masses on the links, and the share that they carry."""
    rng, worn = np.random.default_rng(8000 + seed), np.array((0.0, 0.0, 1.0, 1.0))
    angle, rest, carried = rng.uniform(0.0, 2.0 * np.pi, 4), rng.uniform(-REST_SPREAD, REST_SPREAD, 4), rng.uniform()
    person: dict[str, np.ndarray] = {}
    if effect in ("beside", "all"):
        person |= {"wearer_cog_y": BESIDE * worn * np.cos(angle), "wearer_cog_z": BESIDE * worn * np.sin(angle)}
    if effect in ("springs", "all"):
        person |= {"wearer_stiffness": np.full(4, STIFFNESS), "wearer_rest": REST + rest}
    return person, CARRIED * carried if effect in ("carries", "all") else 0.0


def turned(vector: Vector, turn: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,) turned by the small rotation `turn`, (3,) rad."""
    moved = np.asarray(vector) + np.cross(turn, vector)
    return np.asarray(moved / np.linalg.norm(moved))
