# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where the links of an elastic arm rest behind their motors, by MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from exo_gravity.sim import SimulatedArm

STEPS, RELAXATION, AT_REST = 600, 0.1, 1e-6  # rad: the links find their rest step by step
LITTLE = 0.02  # Nm, below which a link hangs within its play


def resting_torque(arm: SimulatedArm, motors: np.ndarray) -> np.ndarray:
    """Return the torque (n,) in Nm that elastic joints carry behind motors at `motors` (n,) rad, without friction.

    Raises RuntimeError if the links find no rest.
    """
    model, data, config, count = arm.model, arm.data, arm.config, len(motors)
    data.qpos[count:], data.qvel[:] = motors, 0.0
    links = motors
    for _ in range(STEPS):
        data.qpos[:count] = links
        mujoco.mj_forward(model, data)
        springs = model.jnt_stiffness[:count] * (links - model.qpos_spring[:count])  # cables and tissue, at the links
        torque, before = data.qfrc_bias[:count] + springs, links
        side = np.clip(torque / LITTLE, -1.0, 1.0)  # of the play
        rest = motors - torque / config.joint_stiffness - side * np.divide(config.backlash, 2.0)
        links = before + RELAXATION * (rest - before)
        if np.abs(rest - before).max() < AT_REST:
            return torque
    raise RuntimeError(f"no rest behind motors at {motors.tolist()} rad")
