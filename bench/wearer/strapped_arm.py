# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm of the wearer that moves relative to the robot's: straps that give, and a shoulder that moves.

The wearer's arm is modelled separately from the robot's, with the same joints, and the muscles act on it. Springs and
dampers tie it to the robot at two cuffs. The shoulder moves up and towards the spine as the upper arm rises
(scapulo-humeral rhythm).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from scipy.optimize import root

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE, Torque
from exo_gravity.core.numbers import Vector
from exo_gravity.sim import ArmConfig, SimulatedArm, VirtualWearer
from exo_gravity.sim import arm as arms

STRAP, STRAP_DAMPING = 2000.0, 40.0  # N/m and N s/m of each cuff
CUFFS = (0.2, 0.2)  # m along the upper arm and the forearm
SHOULDER, SHOULDER_DAMPING, GIRDLE = 5000.0, 200.0, 2.0  # N/m, N s/m and kg
RHYTHM = np.array((-0.02, 0.0, -0.03))  # m in the base's axes at 90 degrees of elevation: to the spine, and up
LIGHT = 0.001  # kg; links of the wearer's chain in which there is no segment
REST = 1e-9  # of the search for the place where the wearer's arm rests
INERTIA = (0.002,) * 4  # kg m^2, of flesh about each of the wearer's joints


class StrappedArm(SimulatedArm):
    """The robot's arm with a wearer's strapped to it. rhythm: (3,) m, of the shoulder's centre at 90 degrees.

    gap: m, the largest between the robot and the wearer's arm at a cuff so far.
    """

    config: ArmConfig

    def __init__(self, config: ArmConfig, rhythm: np.ndarray = RHYTHM) -> None:
        self._worn = replace(
            config, links=ArmModel(config.links.length, (0.0,) * 4, (LIGHT,) * 4), rotor_inertia=INERTIA,
            coulomb_friction=NO_TORQUE, viscous_friction=NO_TORQUE, stribeck_friction=NO_TORQUE, cog_y=NO_TORQUE,
            cog_z=NO_TORQUE,
        )  # fmt: skip
        self._rhythm, self.gap = rhythm, 0.0
        super().__init__(replace(config, wearer_mass=NO_TORQUE))

    def hold(self, wearer: VirtualWearer) -> None:
        """Let `wearer` act on their own joints from now on, and not on the robot's."""
        own = wearer.torque

        def torque(elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
            data = self.data
            data.qfrc_applied[7:] = own(elapsed, data.qpos[7:].tolist(), data.qvel[7:].tolist())
            return NO_TORQUE

        wearer.torque = torque  # type: ignore[method-assign]

    def reset(self, theta: Vector) -> None:
        """Put both arms at rest at `theta`, (4,) rad."""
        super().reset(theta)
        self.data.qpos[7:] = theta
        mujoco.mj_forward(self.model, self.data)

    def held(self, theta: Vector) -> np.ndarray:
        """Return the torque (4,) in Nm that holds the robot at `theta` (4,) rad, while the wearer's arm rests in it.

        Raises RuntimeError if it finds no rest.
        """
        model, data = self.model, self.data
        data.qpos[:4], data.qvel[:] = theta, 0.0

        def unbalanced(worn: np.ndarray) -> np.ndarray:
            data.qpos[4:] = worn
            mujoco.mj_forward(model, data)
            self._tied()  # moves the shoulder's rest
            mujoco.mj_forward(model, data)
            return np.asarray(data.qfrc_bias - data.qfrc_passive - self._tied())

        found = root(lambda worn: unbalanced(worn)[4:], np.concatenate((np.zeros(3), theta)), tol=REST)
        if not found.success:
            raise RuntimeError(f"the wearer's arm finds no rest behind {list(theta)} rad: {found.message}")
        return unbalanced(found.x)[:4]

    def step(
        self,
        torque: Sequence[float],
        count: int = 1,
        of_motors: Sequence[float] | None = None,
        damping: Sequence[float] = (),
    ) -> None:
        """Apply `torque` (4,) Nm, which is that of the motors, for `count` times STEP. The base does not turn."""
        model, data = self.model, self.data
        muscles = data.qfrc_applied[7:].copy()
        for _ in range(count):
            fading = np.exp(-np.square(self._velocity / self._speed))
            model.dof_frictionloss[:4] = self._coulomb + self._stribeck * fading
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:] = self._tied()
            data.qfrc_applied[:4] += torque
            data.qfrc_applied[7:] += muscles
            mujoco.mj_step2(model, data)
        data.qfrc_applied[7:] = muscles

    def _load(self, payload: Sequence[float]) -> None:
        super()._load(payload)
        robot, worn = (arms._mjcf(config) for config in (self.config, self._worn))
        inside = worn.partition("<worldbody>")[2].partition("</worldbody>")[0]
        inside = inside.replace('joint name="', 'joint name="worn ')
        slides = "".join(
            f'<joint type="slide" axis="{axis}" stiffness="{SHOULDER}" damping="{SHOULDER_DAMPING}"/>'
            for axis in ("1 0 0", "0 1 0", "0 0 1")
        )
        girdle = f'<inertial pos="0 0 0" mass="{GIRDLE}" diaginertia="0.01 0.01 0.01"/>'
        both = f'<body gravcomp="1">{slides}{girdle}{inside}</body></worldbody>'
        self.model = mujoco.MjModel.from_xml_string(robot.replace("</worldbody>", both))
        self.data = mujoco.MjData(self.model)
        self._theta, self._velocity, self._torque = self.data.qpos[:4], self.data.qvel[:4], self.data.qfrc_applied[:4]

    def _tied(self) -> np.ndarray:
        """Return the straps' torques and forces on all joints, (11,); move the shoulder's rest."""
        model, data = self.model, self.data
        upper, fore = data.xpos[8], data.xpos[9]
        along = (fore - upper) / self.config.links.length[2]
        model.qpos_spring[4:7] = self._rhythm * (1.0 - along[2])  # z points down
        total, of_robot, of_wearer = np.zeros(11), np.empty((3, 11)), np.empty((3, 11))
        for robot, wearer, at in ((3, 8, CUFFS[0]), (4, 9, CUFFS[1])):
            ends = [data.xpos[body] + at * data.xmat[body][::3] for body in (robot, wearer)]
            mujoco.mj_jac(model, data, of_robot, None, ends[0], robot)
            mujoco.mj_jac(model, data, of_wearer, None, ends[1], wearer)
            way, jacobian = ends[1] - ends[0], of_wearer - of_robot
            self.gap = max(self.gap, float(np.linalg.norm(way)))
            total -= jacobian.T @ (STRAP * way + STRAP_DAMPING * (jacobian @ data.qvel))
        return total
