# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated arm from a URDF: MuJoCo reads the links; the joints' mechanics and what the arm holds are added.

The model is MuJoCo's own reading of the URDF and not Pinocchio's, on which the compensator's law is built, so that it
can contradict it. Shapes are left out: the bodies cannot collide, and meshes need not be there. The root link has the
trunk's axes (REP-103).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from xml.etree import ElementTree

import mujoco
import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY, Payload
from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import for_joints
from exo_gravity.hardware.urdf_checks import SHAPES, robot_of
from exo_gravity.hardware.urdf_model import LEAST_LENGTH
from exo_gravity.sim.arm import JointConfig, add_point
from exo_gravity.sim.trunk_motion import TrunkState

# Links without mass, which MuJoCo refuses to move, get the least; inertias that no body can have are corrected.
COMPILER = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-14", "boundinertia": "1e-14"}


@dataclass(frozen=True, eq=False, kw_only=True)
class UrdfConfig(JointConfig):
    """The arm that `joint_names` (n,) move in a URDF, in the order of its chain; its other joints are fixed at 0.

    What has one entry per joint and is left out is the least of the paper's arm; stops are the URDF's. Raises
    ParameterError that names the offending value.
    """

    text: str  #: the URDF
    joint_names: Sequence[str]
    hand: str = ""  #: the link that holds a load, '' if there is none
    gravity: float = STANDARD_GRAVITY  #: m/s^2

    def __post_init__(self) -> None:
        stops = dict(zip(("position_min", "position_max"), self._stops, strict=True))
        for own in fields(JointConfig):
            if getattr(self, own.name) is own.default:
                usual = stops.get(own.name) or for_joints(own.default, len(self.joint_names))
                object.__setattr__(self, own.name, usual)
        super().__post_init__()
        if self.hand and self.hand not in [body.name for body in self._spec.bodies]:
            raise ParameterError("urdf.hand", self.hand, "a link of the URDF")
        for n, (mass, cog, (_, way)) in enumerate(zip(self.wearer_mass, self.wearer_cog, self._links, strict=True)):
            length = float(np.linalg.norm(way))
            if mass and not (cog <= length and length >= LEAST_LENGTH):
                raise ParameterError("wearer_cog", self.wearer_cog, f"at most {length:.3f} m on link {n + 1}")

    def bodies(self, payload: Payload) -> mujoco.MjSpec:
        """Return the links and joints that move, and what is on the links."""
        if payload.mass and not self.hand:
            raise ParameterError("load", payload.mass, "0 without urdf.hand, which says where a load is held")
        spec = self._spec.copy()
        for (name, way), worn, cog in zip(self._links, self.wearer_mass, self.wearer_cog, strict=True):
            if worn:
                add_point(spec.body(name), worn, way * (cog / np.linalg.norm(way)))
        if payload.mass:
            add_point(spec.body(self.hand), payload.mass, payload.cog)
        return spec

    def felt(self, side: str, state: TrunkState) -> tuple[Floats3, Floats3, Floats3]:
        """Return what the root link feels, each (3,) in its axes: those of the trunk, whatever the side."""
        felt = self.gravity * gravity_in_trunk(state.pitch, state.roll) - state.acceleration
        x, y, z = felt.tolist()
        return (x, y, z), state.angular_velocity, state.angular_acceleration

    @cached_property
    def _spec(self) -> mujoco.MjSpec:
        """The arm as MuJoCo reads it, without the joints that are fixed."""
        robot = robot_of(self.text)
        try:
            for link in robot.findall("link"):
                for shape in [child for child in link if child.tag in SHAPES]:
                    link.remove(shape)
            ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler", COMPILER)
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
            spec.compile()
        except ValueError as error:
            what = f"a URDF that MuJoCo reads ({error})"
            raise ParameterError("urdf.file", f"{self.text[:60].strip()} ...", what) from None
        chain = [joint.name for joint in spec.joints]
        for joint in list(spec.joints):
            if joint.name not in self.joint_names:
                spec.delete(joint)
        if [joint.name for joint in spec.joints] != list(self.joint_names):
            expected = f"joints of the URDF in the order of its chain: {', '.join(chain)}"
            raise ParameterError("joint_names", list(self.joint_names), expected)
        return spec

    @cached_property
    def _model(self) -> mujoco.MjModel:
        return self._spec.copy().compile()

    @property
    def _stops(self) -> tuple[list[float], list[float]]:
        """The joints' limits in the URDF, (n,) rad each; half a turn each way where it has none."""
        limited = self._model.jnt_limited.astype(bool)
        low, high = (
            np.clip(np.where(limited, edge, whole), -math.pi, math.pi).tolist()
            for edge, whole in zip(self._model.jnt_range.T, (-math.pi, math.pi), strict=True)
        )
        return low, high

    @cached_property
    def _links(self) -> list[tuple[str, np.ndarray]]:
        """Of each joint the body that it moves, and the way (3,) in m from it to the next joint, or to the hand."""
        model, data = self._model, mujoco.MjData(self._model)
        mujoco.mj_kinematics(model, data)
        last = data.body(self.hand).xpos if self.hand else data.xanchor[-1]
        links = []
        for body, end in zip(model.jnt_bodyid.tolist(), [*data.xanchor[1:], last], strict=True):
            links.append((model.body(body).name, data.xmat[body].reshape(3, 3).T @ (end - data.xpos[body])))
        return links
