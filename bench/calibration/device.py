# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A device drawn at random, as a parameter file: what the file of a new arm says, and what the simulator is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bench.calibration.random_device import off_axis_of
from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import moments_of
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import MAX_CAN_ID
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim.arm import DEFAULT_LINKS

BRIDGE, SIMULATOR = "/right/can_bridge", "/right/simulator"
SPREAD = 0.3  # of masses, centres of gravity and torque scales
LARGEST_OFFSET = 0.015  # m, the largest offset of a centre of gravity from its link
COULOMB = (0.1, 0.4)  # Nm
VISCOUS = (0.02, 0.1)  # Nm s/rad
CURRENT_NOISE = 0.02  # of the torque, in replies
ZERO = 3.0  # rad, and whole turns of the rotor in addition
ROTOR_TURNS = 2
# rad, pitch and roll of the stand. It leans to the arm's side: joint 1 then carries something, and hangs at its zero.
STAND = (-0.1, 0.17), (0.1, 0.24)
LEANT = (0.12, 0.2)  # rad, by which the stand is leant otherwise when the weight is hung, forward or back


@dataclass(frozen=True, eq=False)
class Device:
    """One device. params: its file, with nominal masses, default motors, and the true device as the simulator.

    moments: (8,) kg m, true ones. can_id, direction, zero: (4,), true ones. quaternion: true trunk from IMU.
    leant: pitch and roll of the stand in rad with the weight; without it, the file's.
    """

    seed: int
    params: Path
    links: ArmModel
    can_id: list[int]
    direction: list[int]
    zero: list[float]
    scale: list[float]
    quaternion: np.ndarray
    leant: tuple[float, float]

    @property
    def moments(self) -> np.ndarray:
        """First moments (8,) in kg m."""
        return moments_of(self.links)


def draw(seed: int, folder: Path) -> Device:
    """Return the device of `seed`; its parameter file is written to `folder`."""
    rng = np.random.default_rng(seed)
    content = yaml.safe_load(packaged_config("sim.yaml").read_text(encoding="utf-8"))
    nominal, low, high = DEFAULT_LINKS, 1.0 - SPREAD, 1.0 + SPREAD
    mass = nominal.mass * rng.uniform(low, high, 4)
    cog = np.minimum(nominal.cog * rng.uniform(low, high, 4), nominal.length)
    offset = rng.uniform(-LARGEST_OFFSET, LARGEST_OFFSET, (2, 4))
    bridge, simulator = (content[node]["ros__parameters"] for node in (BRIDGE, SIMULATOR))
    can_id = [int(i) for i in rng.choice(np.arange(1, MAX_CAN_ID + 1), 4, replace=False)]
    direction = [int(d) for d in rng.choice((1, -1), 4)]
    turns = rng.integers(-ROTOR_TURNS, ROTOR_TURNS + 1, 4)
    rotor = [2.0 * math.pi / MOTORS[kind].gear_ratio for kind in bridge["motor"]]
    zero = (rng.uniform(-ZERO, ZERO, 4) + turns * rotor).round(5).tolist()
    scale = rng.uniform(low, high, 4).round(4).tolist()
    quaternion = rng.standard_normal(4)
    quaternion /= np.linalg.norm(quaternion)
    stand = rng.uniform(*STAND).tolist()
    bridge["can"] = {"interface": "virtual", "channel": f"study-{seed}"}
    bridge.update(can_id=[1, 2, 3, 4], direction=[1] * 4, zero=[0.0] * 4)
    simulator["imu"]["rotation_trunk_from_imu"] = quaternion.tolist()
    simulator.update(
        can_id=can_id, direction=direction, zero=zero, torque_scale=scale, current_noise=CURRENT_NOISE,
        friction=_friction(rng), trunk={"pitch": stand[0], "roll": stand[1]},
        robot={"mass": mass.tolist(), "cog": cog.tolist(), "cog_y": offset[0].tolist(), "cog_z": offset[1].tolist()},
    )  # fmt: skip
    params = folder / "0.yaml"
    params.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    links = ArmModel(nominal.length, cog, mass, off_axis=off_axis_of(mass, *offset))
    other_pitch = stand[0] - math.copysign(rng.uniform(*LEANT), stand[0])  # to the side where there is more room
    leant = (other_pitch, float(rng.uniform(STAND[0][1], STAND[1][1])))
    return Device(seed, params, links, can_id, direction, zero, scale, quaternion, leant)


def _friction(rng: np.random.Generator) -> dict[str, Any]:
    return {"coulomb": rng.uniform(*COULOMB, 4).tolist(), "viscous": rng.uniform(*VISCOUS, 4).tolist()}
