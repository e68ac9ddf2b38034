# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Gravity torques of a URDF by MuJoCo, to compare Pinocchio's with: of the bare arm, and of one that is worn."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import mujoco
import numpy as np

from exo_gravity.core.arm.interface import NO_LOAD, Payload
from exo_gravity.sim.urdf import UrdfConfig

UPRIGHT = (0.0, 0.0, -9.80665)  # m/s^2
UNUSED = ("visual", "collision")


class MujocoArm:
    """The arm that `joint_names` (n,) move in the URDF `text`; its other joints stay at 0."""

    def __init__(self, text: str, joint_names: Sequence[str]) -> None:
        robot = ElementTree.fromstring(text)
        for link in robot.findall("link"):
            for element in [child for child in link if child.tag in UNUSED]:
                link.remove(element)
        settings = ElementTree.SubElement(robot, "mujoco")
        # Fused links would lose their names, not their masses. Some descriptions have inertias that no body can have.
        # MuJoCo refuses moving links without mass.
        fixes = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-14", "boundinertia": "1e-14"}
        ElementTree.SubElement(settings, "compiler", fixes)
        self._model = mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))
        self._data = mujoco.MjData(self._model)
        self._model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        joints = [self._model.joint(name) for name in joint_names]
        self._positions = [int(joint.qposadr[0]) for joint in joints]
        self._speeds = [int(joint.dofadr[0]) for joint in joints]

    def energy(self, theta: Sequence[float], gravity: Sequence[float]) -> float:
        """Return the potential energy in J at `theta` (n,) rad, from which a torque can be differentiated."""
        self.torque(theta, gravity)
        return float(self._data.energy[0])

    def torque(self, theta: Sequence[float], gravity: Sequence[float]) -> np.ndarray:
        """Return what holds the arm at `theta`, (n,) in Nm.

        theta: (n,) rad. gravity: (3,) m/s^2 in the axes of the root link.
        """
        self._model.opt.gravity = gravity
        self._data.qpos[:] = 0.0
        self._data.qpos[self._positions] = theta
        mujoco.mj_forward(self._model, self._data)
        return self._data.qfrc_bias[self._speeds].copy()


class WornMujocoArm:
    """The arm that `joint_names` (n,) move in the URDF `text`, with all that it holds.

    mass, cog: of the wearer's segment on each link, (n,) kg and (n,) m. payload: kg, and (3,) m, in the link `hand`.
    stiffness, rest: of the springs of the wearer's joints, (n,) Nm/rad and (n,) rad; () for none.
    """

    def __init__(
        self,
        text: str,
        joint_names: Sequence[str],
        mass: Sequence[float],
        cog: Sequence[float],
        payload: Payload = NO_LOAD,
        stiffness: Sequence[float] = (),
        rest: Sequence[float] = (),
    ) -> None:
        none = (0.0,) * len(joint_names)
        config = UrdfConfig(
            text=text,
            joint_names=joint_names,
            hand="hand",
            wearer_mass=mass,
            wearer_cog=cog,
            wearer_stiffness=tuple(stiffness) or none,
            wearer_rest=tuple(rest) or none,
        )
        self._model, _ = config.models(payload)
        self._model.opt.gravity = UPRIGHT
        self._data = mujoco.MjData(self._model)

    def torque(self, theta: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return what holds the arm at `theta` (n,) rad on an upright base, (n,) Nm."""
        self._data.qpos[:] = theta
        mujoco.mj_forward(self._model, self._data)
        return self._data.qfrc_bias - self._data.qfrc_passive
