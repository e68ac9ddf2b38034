"""The mechanics of the simulated device: a MuJoCo arm with friction, joint stops, and masses of its own.

Standard Denavit-Hartenberg, Table 1 of the paper: a = link lengths, alpha = (-pi/2, +pi/2, 0, 0), d = 0, joint offsets
(0, -pi/2, 0, 0), z0 along gravity when the trunk is upright; joint n turns about z_{n-1}, link n's centre of gravity
lies at d_n along x_n. It is built from these, not from the laws of `core.gravity`, so that it can contradict them.

MuJoCo's dry friction is a soft constraint and creeps by itself. Measured on a 0.3 m link with 0.15 Nm of friction and
0.05 Nm of imbalance: 18 degrees per minute at MuJoCo's defaults, 0.002 with the stiffness below.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn: spare the import a search for a display
import mujoco
import numpy as np

from exo_gravity.core.arm import JOINT_COUNT, MAX_LENGTH, MAX_MASS, ArmModel, four_floats
from exo_gravity.core.errors import ParameterError

STEP = 0.001  # s

_ALPHA = (-math.pi / 2, math.pi / 2, 0.0, 0.0)
_OFFSET = (0.0, -math.pi / 2, 0.0, 0.0)
_TUBE_RADIUS = 0.03  # m, of the carbon tube as which each link turns: only inertia depends on it
_MIN_MASS = 0.001  # kg: a link without any mass can't be simulated

DEFAULT_LINKS = ArmModel((0.05, 0.13, 0.30, 0.30), (0.045, 0.115, 0.235, 0.13), (0.60, 0.46, 0.61, 0.20))

_FRICTION_STIFFNESS = 'solreffriction=".002 1" solimpfriction=".9999 .9999 .001"'
_STOP_STIFFNESS = 'solreflimit=".004 1" solimplimit=".99 .999 .001"'


@dataclass(frozen=True, eq=False)
class ArmConfig:
    """The simulated arm. All arrays (4,), shoulder to elbow; raises ParameterError that names what is impossible.

    links: lengths, masses, centres of gravity and gravity of the robot's own links. Default: the paper's lengths; each
    link bears the motor of the next joint at its far end (AK80-9 0.485 kg, AK60-6 0.368 kg, published motor tables) and
    0.1 to 0.25 kg of carbon tube, bracket and cuff.
    wearer_mass kg, wearer_cog m: the passive arm of a wearer, per link (upper arm on link 3, forearm and hand on 4).
    rotor_inertia: kg m^2 at the output, a published table's 243.5 and 607 g cm^2 times the gear ratio squared.
    coulomb_friction Nm, viscous_friction Nm s/rad: estimates for low planetary gears that can be driven backwards.
    position_min, position_max: rad, the joint stops; the paper's motor mounts turn 190 degrees in all.
    """

    links: ArmModel = DEFAULT_LINKS
    wearer_mass: np.ndarray = (0.0, 0.0, 0.0, 0.0)
    wearer_cog: np.ndarray = (0.0, 0.0, 0.0, 0.0)
    rotor_inertia: np.ndarray = (8.8e-4, 4.9e-3, 8.8e-4, 8.8e-4)
    coulomb_friction: np.ndarray = (0.2, 0.4, 0.2, 0.2)
    viscous_friction: np.ndarray = (0.02, 0.05, 0.02, 0.02)
    position_min: np.ndarray = tuple(math.radians(a) for a in (-95.0, -10.0, -45.0, -10.0))
    position_max: np.ndarray = tuple(math.radians(a) for a in (95.0, 180.0, 145.0, 180.0))

    def __post_init__(self):
        bounds = {
            "wearer_mass": (0.0, MAX_MASS, "kg"),
            "wearer_cog": (0.0, MAX_LENGTH, "m"),
            "rotor_inertia": (0.0, 1.0, "kg m^2"),
            "coulomb_friction": (0.0, 10.0, "Nm"),
            "viscous_friction": (0.0, 10.0, "Nm s/rad"),
            "position_min": (-math.pi, math.pi, "rad"),
            "position_max": (-math.pi, math.pi, "rad"),
        }
        for name, (low, high, unit) in bounds.items():
            object.__setattr__(self, name, four_floats(name, getattr(self, name), low, high, unit))
        if np.any(self.links.mass < _MIN_MASS):
            raise ParameterError("links.mass", self.links.mass, f"at least {_MIN_MASS:g} kg each")
        if np.any(self.wearer_cog > self.links.length):
            raise ParameterError("wearer_cog", self.wearer_cog, f"at most length = {self.links.length.tolist()} m")
        if np.any(self.position_min >= self.position_max):
            raise ParameterError("position_min", self.position_min, f"below position_max = {self.position_max} rad")


class SimulatedArm:
    """Four joints that turn under the torques given, gravity and friction.

    `model` and `data` are MuJoCo's own structures, for whoever wants to look closer.
    """

    def __init__(self, config: ArmConfig | None = None):
        self.config = config or ArmConfig()
        self.model = mujoco.MjModel.from_xml_string(_mjcf(self.config))
        self.data = mujoco.MjData(self.model)
        # Views of `data`, which never moves: looking them up each time costs as much as reading them.
        self._theta, self._velocity, self._torque = self.data.qpos, self.data.qvel, self.data.qfrc_applied
        self.set_gravity((0.0, 0.0, 1.0))
        self.reset((0.0,) * JOINT_COUNT)

    @property
    def positions(self) -> list[float]:
        """Joint angles (4,) in rad."""
        return self._theta.tolist()

    @property
    def velocities(self) -> list[float]:
        """Joint velocities (4,) in rad/s."""
        return self._velocity.tolist()

    def reset(self, theta: Sequence[float]) -> None:
        """Put the arm at rest at `theta`, (4,) rad."""
        mujoco.mj_resetData(self.model, self.data)
        self._theta[:] = four_floats("theta", theta, -math.pi, math.pi, "rad")
        mujoco.mj_forward(self.model, self.data)

    def set_gravity(self, direction: Sequence[float]) -> None:
        """Let gravity act along `direction`, (3,) unit vector in the arm's base frame: `Tilt.direction` of a trunk.

        The trunk itself is taken to move so slowly that its own acceleration does not matter.
        """
        self.model.opt.gravity[:] = [self.config.links.gravity * component for component in direction]

    def step(self, torque: Sequence[float], count: int = 1) -> None:
        """Let `torque`, (4,) Nm of motors and wearer together, act for `count` times STEP."""
        self._torque[:] = torque
        mujoco.mj_step(self.model, self.data, count)


def _mjcf(config: ArmConfig) -> str:
    """Return the arm as MuJoCo's XML. No body has a shape, so nothing can collide."""
    links, body = config.links, ""
    for n in reversed(range(JOINT_COUNT)):
        # Where joint n sits on link n - 1: along x by the length, then about x by alpha and about z by the offset.
        position, alpha = (links.length[n - 1], _ALPHA[n - 1]) if n else (0.0, 0.0)
        worn = ""
        if config.wearer_mass[n] > 0:
            worn = f"<body>{_tube(links.length[n], config.wearer_cog[n], config.wearer_mass[n])}</body>"
        body = f"""
            <body pos="{position} 0 0" euler="{alpha} 0 {_OFFSET[n]}">
              <joint axis="0 0 1" armature="{config.rotor_inertia[n]}" damping="{config.viscous_friction[n]}"
                frictionloss="{config.coulomb_friction[n]}" {_FRICTION_STIFFNESS}
                range="{config.position_min[n]} {config.position_max[n]}" {_STOP_STIFFNESS}/>
              {_tube(links.length[n], links.cog[n], links.mass[n])}{worn}{body}
            </body>"""
    return f"""
        <mujoco>
          <compiler angle="radian" autolimits="true" fusestatic="true"/>
          <option timestep="{STEP}"><flag contact="disable"/></option>
          <worldbody>{body}</worldbody>
        </mujoco>"""


def _tube(length: float, cog: float, mass: float) -> str:
    """Return the inertia of a thin tube along x, its centre of gravity shifted to `cog`."""
    along = mass * _TUBE_RADIUS**2
    across = along / 2 + mass * length**2 / 12
    return f'<inertial pos="{cog} 0 0" mass="{mass}" diaginertia="{along} {across} {across}"/>'
