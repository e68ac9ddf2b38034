# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The mechanics of the simulated device: a MuJoCo arm on a moving base, with its own masses, friction and joint stops.

It is the paper's arm (`ArmConfig`), or one from a URDF (`UrdfConfig`, sim/urdf.py).

The paper's, in standard Denavit-Hartenberg, Table 1: a = link lengths, alpha = (-pi/2, +pi/2, 0, 0), d = 0, joint
offsets (0, -pi/2, 0, 0), z0 along gravity when the trunk is upright. Joint n turns about z_{n-1}; the centre of gravity
of link n lies at d_n along x_n, and beside the link at `cog_y` along y_n and `cog_z` along z_n. The model is built from
these and not from the laws of `core.arm.paper`, so that it can contradict them.

In the axes of an accelerated base, gravity is g - a: turned and scaled. If the base also turns, the Euler, centrifugal
and Coriolis forces act on each link. They are not small: a sway of 2 degrees at 1 Hz accelerates a forearm 0.4 m from
the shoulder by 0.6 m/s^2, as walking shakes the shoulder by 1 to 2. Together they are exact. The arm's reaction on the
trunk is neglected.

A joint with `joint_stiffness` is elastic (Spong 1987): its motor, with the rotor's inertia and all friction, is a body
of its own, and a spring with play drives the link. The encoder sits on the motor. The rotor's kinetic energy is that of
its spin alone, as for a rigid joint.

MuJoCo models dry friction as a soft constraint, which creeps. Measured on a 0.3 m link with 0.15 Nm of friction and
0.05 Nm of imbalance: 18 degrees per minute with MuJoCo's defaults, 0.002 with the stiffness below.
"""

import copy
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is rendered: skips MuJoCo's search for a display
import mujoco
import numpy as np

from exo_gravity.core.arm.interface import MAX_MASS, NO_LOAD, Payload
from exo_gravity.core.arm.paper import MAX_LENGTH, MAX_OFFSET, ROTORS, ArmModel
from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.springs import MAX_REST, MAX_STIFFNESS
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.arm.wearer import MAX_TISSUE
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT, Vector, floats
from exo_gravity.core.params import check_owned, owned
from exo_gravity.sim.trunk_motion import TrunkState

STEP = 0.001  # s
ELASTIC_STEPS = 4  # of MuJoCo in one STEP of an elastic arm: 3 % of an AK60-6's rotor on 1,000 Nm/rad, 170 Hz
MAX_JOINT_STIFFNESS = 5000.0  # Nm/rad; a stiffer joint is rigid, and its rotor too fast for the steps
MAX_BACKLASH = 0.1  # rad
# s, damping of a joint's spring per stiffness, an estimate: at 1,000 Nm/rad an AK60-6's rotor has a damping ratio of
# 0.1 on it, a link of 0.1 kg m^2 one of 0.01, as arms of tube and printed parts have.
JOINT_LOSS = 2e-4

_ALPHA = (-math.pi / 2, math.pi / 2, 0.0, 0.0)
_OFFSET = (0.0, -math.pi / 2, 0.0, 0.0)
_TUBE_RADIUS = 0.03  # m; each link has the inertia of a thin carbon tube
_MIN_MASS = 0.001  # kg; MuJoCo cannot simulate a massless link
_MIN_ROTOR = 1e-5  # kg m^2, added to the rotor's own: MuJoCo needs bodies with inertia
_STOPS = (-math.pi, math.pi)  # rad
_BESIDE = (-MAX_OFFSET, MAX_OFFSET)  # m
_ZEROS = (0.0,) * JOINT_COUNT

# The paper's lengths. Each link carries the motor of the next joint at its far end (AK80-9 0.485 kg, AK60-6 0.368 kg,
# published motor tables) and 0.1 to 0.25 kg of carbon tube, bracket and cuff.
DEFAULT_LINKS = ArmModel((0.05, 0.13, 0.30, 0.30), (0.045, 0.115, 0.235, 0.13), (0.60, 0.46, 0.61, 0.20))

POINT = (1e-7, 1e-7, 1e-7)  # kg m^2, the inertia of a point of mass


class Stiffness(NamedTuple):
    """How stiff a soft constraint of MuJoCo is."""

    reference: tuple[float, float]  #: solref: s, and the damping ratio
    impedance: tuple[float, float, float]  #: solimp: least, most, and the width over which it rises


FRICTION, STOP = Stiffness((0.002, 1.0), (0.9999, 0.9999, 0.001)), Stiffness((0.004, 1.0), (0.99, 0.999, 0.001))


def _radians(*degrees: float) -> tuple[float, ...]:
    return tuple(map(math.radians, degrees))


@dataclass(frozen=True, eq=False, kw_only=True)
class JointConfig:
    """The joints of a simulated arm, and who wears it. Sequences have one entry per joint (n,), shoulder to elbow.

    Raises ParameterError that names the offending value.
    """

    #: The passive arm of a wearer: the upper arm on link 3, forearm and hand on link 4.
    wearer_mass: Sequence[float] = owned(_ZEROS, "mass of the wearer's passive arm on each link", (0.0, MAX_MASS), "kg")
    wearer_cog: Sequence[float] = owned(_ZEROS, "its centre of gravity from joint n", (0.0, MAX_LENGTH), "m")
    #: The springs of their relaxed joints.
    wearer_stiffness: Sequence[float] = owned(_ZEROS, "stiffness of the wearer's joints", (0.0, MAX_TISSUE), "Nm/rad")
    wearer_rest: Sequence[float] = owned(_ZEROS, "angle at which they rest", _STOPS, "rad")
    rotor_inertia: Sequence[float] = owned(ROTORS, "rotor inertia at the gear's output", (0.0, 1.0), "kg m^2")
    #: Estimates for backdrivable planetary gears.
    coulomb_friction: Sequence[float] = owned((0.2, 0.4, 0.2, 0.2), "Coulomb friction", (0.0, 10.0), "Nm")
    viscous_friction: Sequence[float] = owned((0.02, 0.05, 0.02, 0.02), "viscous friction", (0.0, 10.0), "Nm s/rad")
    #: On top at standstill; it fades with speed v as exp(-(v / stribeck_speed)^2).
    stribeck_friction: Sequence[float] = owned(_ZEROS, "friction at standstill beyond Coulomb's", (0.0, 10.0), "Nm")
    stribeck_speed: Sequence[float] = owned((0.05,) * JOINT_COUNT, "speed at which it fades", (0.001, 10.0), "rad/s")
    #: Of the torque that the motor's gear carries.
    load_friction: Sequence[float] = owned(_ZEROS, "share of the gear's torque that is friction", (0.0, 0.5))
    #: Cables and hoses across the joints.
    spring_stiffness: Sequence[float] = owned(_ZEROS, "springs across the joints", (0.0, MAX_STIFFNESS), "Nm/rad")
    spring_rest: Sequence[float] = owned(_ZEROS, "angle at which they are slack", (-MAX_REST, MAX_REST), "rad")
    #: Between the motor, where the encoder sits, and the link.
    joint_stiffness: Sequence[float] = owned(
        _ZEROS, "stiffness between motor and link; 0: rigid", (0.0, MAX_JOINT_STIFFNESS), "Nm/rad"
    )
    backlash: Sequence[float] = owned(_ZEROS, "play between motor and link", (0.0, MAX_BACKLASH), "rad")
    #: The paper's motor mounts turn 190 degrees.
    position_min: Sequence[float] = owned(_radians(-95.0, -10.0, -45.0, -10.0), "lower joint stops", _STOPS, "rad")
    position_max: Sequence[float] = owned(_radians(95.0, 180.0, 145.0, 180.0), "upper joint stops", _STOPS, "rad")

    def __post_init__(self) -> None:
        check_owned(self)
        if np.any(np.greater_equal(self.position_min, self.position_max)):
            expected = f"below position_max = {list(self.position_max)} rad"
            raise ParameterError("position_min", self.position_min, expected)
        if any(play and not stiffness for play, stiffness in zip(self.backlash, self.joint_stiffness, strict=True)):
            raise ParameterError("backlash", self.backlash, "0 rad where joint_stiffness is 0, which is rigid")

    @property
    def elastic(self) -> list[int]:
        """The elastic joints, from 0 on: the motor of each is a separate body."""
        return [n for n, stiffness in enumerate(self.joint_stiffness) if stiffness]

    def bodies(self, payload: Payload) -> mujoco.MjSpec:
        """Return base, links and joints, and what is on the links.

        payload: its place is in the frame of the hand.
        """
        raise NotImplementedError

    def felt(self, side: str, state: TrunkState) -> tuple[Floats3, Floats3, Floats3]:
        """Return what the base of the `side` arm feels, in its own axes, as for `SimulatedArm.move_base`."""
        raise NotImplementedError

    def motors_among(self, count: int) -> np.ndarray:
        """Return the place (n,) of each motor among `count` velocities: with its link, or at the end."""
        motors = np.arange(len(self.joint_stiffness))
        motors[self.elastic] = range(len(motors), count)
        return motors

    def models(self, payload: Payload = NO_LOAD) -> tuple[mujoco.MjModel, mujoco.MjModel]:
        """Return the arm, and its bodies alone on a base that can turn about its origin.

        payload: as for `bodies`.
        """
        spec = self.bodies(payload)
        turning, names = spec.copy(), [joint.name for joint in spec.joints]
        for n in self.elastic:
            stiffness, half = self.joint_stiffness[n], self.backlash[n] / 2.0
            motor = spec.worldbody.add_body(mass=_MIN_MASS, inertia=(_MIN_ROTOR,) * 3, explicitinertial=True)
            motor.add_joint(name=f"motor of {names[n]}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
            damping = JOINT_LOSS * stiffness
            shaft = spec.add_tendon(stiffness=stiffness, damping=damping, springlength=(-half, half))
            shaft.wrap_joint(f"motor of {names[n]}", 1.0)
            shaft.wrap_joint(names[n], -1.0)
        base = turning.worldbody.first_body()
        base.add_joint(type=mujoco.mjtJoint.mjJNT_BALL)
        # In place of its own inertia, which does not matter; a full one, with products, would count beside this one.
        base.fullinertia = (math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
        base.mass, base.inertia, base.explicitinertial = 1.0, (1.0, 1.0, 1.0), True
        return self._with_mechanics(spec.compile()), turning.compile()

    def _with_mechanics(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """Return the arm's model with the mechanics of joints and motors."""
        joints, motors = slice(len(self.joint_stiffness)), self.motors_among(model.nv)
        model.opt.timestep = STEP / ELASTIC_STEPS if self.elastic else STEP
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        model.dof_armature[motors] = self.rotor_inertia
        model.dof_damping[motors] = self.viscous_friction
        model.dof_frictionloss[motors] = self.coulomb_friction
        model.dof_solref[motors], model.dof_solimp[motors, : len(FRICTION.impedance)] = FRICTION
        spring, worn = np.array(self.spring_stiffness), np.array(self.wearer_stiffness)
        model.jnt_stiffness[joints] = both = spring + worn
        pull = spring * self.spring_rest + worn * self.wearer_rest
        model.qpos_spring[joints] = np.divide(pull, both, out=np.zeros(len(both)), where=both > 0.0)
        model.jnt_limited[joints] = True
        model.jnt_range[joints] = np.transpose((self.position_min, self.position_max))
        model.jnt_solref[joints], model.jnt_solimp[joints, : len(STOP.impedance)] = STOP
        mujoco.mj_setConst(model, mujoco.MjData(model))  # what depends on the rotors
        return model


@dataclass(frozen=True, eq=False)
class ArmConfig(JointConfig):
    """The paper's arm. Raises ParameterError that names the offending value."""

    links: ArmModel = DEFAULT_LINKS
    #: Beside the link in the frames of Table 1.
    cog_y: Sequence[float] = owned(_ZEROS, "true centre of gravity beside link n, along y_n", _BESIDE, "m")
    cog_z: Sequence[float] = owned(_ZEROS, "true centre of gravity beside link n, along z_n", _BESIDE, "m")
    wearer_cog_y: Sequence[float] = owned(_ZEROS, "that of the wearer's segment, along y_n", _BESIDE, "m")
    wearer_cog_z: Sequence[float] = owned(_ZEROS, "that of the wearer's segment, along z_n", _BESIDE, "m")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.links.check_masses("the simulated arm")
        if np.any(self.links.mass < _MIN_MASS):
            raise ParameterError("links.mass", self.links.mass, f"at least {_MIN_MASS:g} kg each")
        if np.any(np.greater(self.wearer_cog, self.links.length)):
            raise ParameterError("wearer_cog", self.wearer_cog, f"at most length = {self.links.length.tolist()} m")

    def bodies(self, payload: Payload) -> mujoco.MjSpec:
        """Return base, links and joints, and what is on the links. They have no geometry, so they cannot collide."""
        spec = mujoco.MjSpec()
        spec.compiler.degree, spec.compiler.fusestatic = False, True
        body, links = spec.worldbody.add_body(), self.links
        for n, (length, mass, cog) in enumerate(zip(links.length, links.mass, links.cog, strict=True)):
            # The frame of joint n on link n - 1: shifted along x by the length, turned about x by alpha, then about z.
            place, alpha = ((links.length[n - 1], 0.0, 0.0), _ALPHA[n - 1]) if n else (ZERO, 0.0)
            own = _tube(length, mass, n, (cog, self.cog_y[n], self.cog_z[n]))
            body = body.add_body(pos=place, euler=(alpha, 0.0, _OFFSET[n]), **own)
            body.add_joint(name=f"joint {n + 1}", axis=(0.0, 0.0, 1.0))
            if worn := self.wearer_mass[n]:
                at = self.wearer_cog[n], self.wearer_cog_y[n], self.wearer_cog_z[n]
                body.add_body(**_tube(length, worn, n, at))
        if payload.mass:
            add_point(body, payload.mass, np.add(payload.cog, (length, 0.0, 0.0)))
        return spec

    def felt(self, side: str, state: TrunkState) -> tuple[Floats3, Floats3, Floats3]:
        """Return what the base of the `side` arm feels, in its own axes."""
        felt = self.links.gravity * gravity_in_trunk(state.pitch, state.roll) - state.acceleration
        spin, spin_up = state.angular_velocity, state.angular_acceleration
        return in_base(side, felt.tolist()), in_base(side, spin, turning=True), in_base(side, spin_up, turning=True)


def in_base(side: str, vector: Sequence[float], turning: bool = False) -> Floats3:
    """Return a vector (3,) of the trunk's axes in the base frame of the `side` arm, of which the right is a mirror.

    turning: whether it is an angular velocity or acceleration, which a mirror reverses.
    """
    x, y, z = vector
    if side == "left":
        return y, x, -z
    return (y, -x, z) if turning else (-y, x, -z)


class SimulatedArm:
    """Joints that move under motor and wearer torques, gravity and friction.

    model, data: MuJoCo's structures, for inspection.
    """

    def __init__(self, config: JointConfig | None = None) -> None:
        self.config = config or ArmConfig()
        self._load(NO_LOAD)
        own = self.config
        columns = own.coulomb_friction, own.stribeck_friction, own.stribeck_speed, own.load_friction
        self._coulomb, self._stribeck, self._speed, self._load_share = map(np.array, columns)
        self._has_stribeck, self._has_load_friction = bool(self._stribeck.any()), bool(self._load_share.any())
        self.move_base(self.config.felt("left", TrunkState())[0])
        self.reset(np.zeros(len(self._theta)))

    def __deepcopy__(self, memo: dict[int, Any]) -> "SimulatedArm":
        """Return an arm in the same state, which moves on its own."""
        other = object.__new__(type(self))
        memo[id(self)], memo[id(self.config)] = other, self.config  # which never changes
        vars(other).update(copy.deepcopy(vars(self), memo))
        joints = slice(len(self._theta))
        other._theta, other._velocity = other.data.qpos[joints], other.data.qvel[joints]
        other._torque, other._damping = other.data.qfrc_applied, other.model.dof_damping
        return other

    def carry(self, mass: float, cog: Floats3 = ZERO) -> None:
        """Have a point of `mass` kg in the hand from now on, at `cog` (3,) m in frame 4; 0 for none.

        A joint's motion goes on as it is: what is taken moves along, and what is dropped is gone.
        """
        theta, velocity, gravity = self.data.qpos.copy(), self.data.qvel.copy(), self.model.opt.gravity.copy()
        motion = self._turning_data.qvel[:3].copy(), self._turning_data.qacc[:3].copy()
        self._load(Payload(mass, cog))
        self.data.qpos[:], self.data.qvel[:] = theta, velocity
        mujoco.mj_forward(self.model, self.data)
        self.move_base(gravity.tolist(), *(vector.tolist() for vector in motion))

    def _load(self, payload: Payload) -> None:
        """Make MuJoCo's structures for the arm with a load in its hand."""
        # The same arm on a base that can turn: its torques for a given motion of the base.
        self.model, self._turning_model = self.config.models(payload)
        self.data = mujoco.MjData(self.model)
        self._still, self._held = mujoco.MjData(self.model), np.zeros(self.model.nv)  # for `weight`
        self._turning_data = mujoco.MjData(self._turning_model)
        # Views of `data`, whose arrays stay in place: each lookup of an attribute costs as much as its use.
        count = len(self.config.joint_stiffness)
        self._theta, self._velocity = self.data.qpos[:count], self.data.qvel[:count]
        self._torque, self._damping = self.data.qfrc_applied, self.model.dof_damping
        self._viscous = self._damping.copy()
        self._motors = self.config.motors_among(self.model.nv)
        self.is_elastic = bool(self.config.elastic)  #: whether motors move apart from their links
        self._substeps = round(STEP / self.model.opt.timestep)

    @property
    def positions(self) -> list[float]:
        """Joint angles (n,) in rad."""
        return list(self._theta.tolist())

    @property
    def velocities(self) -> list[float]:
        """Joint velocities (n,) in rad/s."""
        return list(self._velocity.tolist())

    @property
    def motor_positions(self) -> list[float]:
        """Angles of the joints' motors (n,) in rad; those of the links where the joints are rigid."""
        return list(self.data.qpos[self._motors].tolist()) if self.is_elastic else self.positions

    @property
    def motor_velocities(self) -> list[float]:
        """Velocities of the joints' motors (n,) in rad/s."""
        return list(self.data.qvel[self._motors].tolist()) if self.is_elastic else self.velocities

    @property
    def weight(self) -> list[float]:
        """Torques (n,) in Nm that hold the joints against what the base feels as gravity, without friction."""
        model, still = self.model, self._still
        still.qpos[:] = self.data.qpos
        mujoco.mj_kinematics(model, still)
        mujoco.mj_comPos(model, still)
        mujoco.mj_rne(model, still, 0, self._held)
        return list(self._held[: len(self._theta)].tolist())

    def reset(self, theta: Vector) -> None:
        """Put the arm at rest at `theta`, (n,) rad, with no torque in elastic joints."""
        mujoco.mj_resetData(self.model, self.data)
        self._theta[:] = floats("theta", theta, len(self._theta), -math.pi, math.pi, "rad")
        self.data.qpos[self._motors] = self._theta
        mujoco.mj_forward(self.model, self.data)

    def move_base(
        self,
        gravity: Sequence[float],
        angular_velocity: Sequence[float] = ZERO,
        angular_acceleration: Sequence[float] = ZERO,
    ) -> None:
        """Set how the base moves from now on; every vector is (3,) in the base's own frame.

        gravity: m/s^2, less the acceleration of the base's origin. angular_velocity rad/s, angular_acceleration
        rad/s^2: of the base, against the world.
        """
        self.model.opt.gravity[:] = self._turning_model.opt.gravity[:] = gravity
        self._turns = any(angular_velocity) or any(angular_acceleration)
        self._turning_data.qvel[:3], self._turning_data.qacc[:3] = angular_velocity, angular_acceleration

    def step(
        self,
        torque: Sequence[float],
        count: int = 1,
        of_motors: Sequence[float] | None = None,
        damping: Sequence[float] = (),
    ) -> None:
        """Apply `torque`, (n,) Nm of motors and wearer together, for `count` times STEP.

        of_motors: (n,) Nm, the part that gears carry; None: all of it.
        damping: (n,) Nm s/rad, of the motors, whose part of `torque` follows the velocity within a step; () for none.
        """
        own, motors = torque if of_motors is None else of_motors, self._motors
        drive = own if self.is_elastic else torque
        self._damping[:] = self._viscous
        if any(damping):
            # MuJoCo applies it implicitly: a step of constant torque would shake a light arm
            self._damping[motors] += damping
            drive = drive + self.data.qvel[motors] * damping
        if self.is_elastic:
            self._torque[:] = 0.0
            self._torque[motors] = drive
            self._torque[: len(self._theta)] += np.subtract(torque, own)
        else:
            self._torque[:] = drive
        constant, count = self._coulomb, count * self._substeps
        if self._has_load_friction:
            constant = self._coulomb + self._load_share * np.abs(torque if of_motors is None else of_motors)
            self.model.dof_frictionloss[self._motors] = constant
        if not (self._turns or self._has_stribeck):
            mujoco.mj_step(self.model, self.data, count)
            return
        given, links = self._torque.copy(), slice(len(self._theta))
        for _ in range(count):
            fading = np.exp(-np.square(self.data.qvel[self._motors] / self._speed))
            self.model.dof_frictionloss[self._motors] = constant + self._stribeck * fading
            mujoco.mj_step1(self.model, self.data)
            if self._turns:
                self._torque[links] = given[links] + self.data.qfrc_bias[links] - self._turning_bias()
            mujoco.mj_step2(self.model, self.data)

    def _turning_bias(self) -> np.ndarray:
        """Return the torque (n,) in Nm of gravity and inertia at constant joint velocities, on a base that turns."""
        model, data = self._turning_model, self._turning_data
        data.qpos[4:], data.qvel[3:] = self._theta, self._velocity
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            compute(model, data)
        bias = np.empty(3 + len(self._theta))
        mujoco.mj_rne(model, data, 1, bias)
        return bias[3:]


def _tube(length: float, mass: float, n: int, centre: Sequence[float]) -> dict[str, Any]:
    """Return the inertia of a thin tube on link n + 1; centre: of gravity, (3,) m along x_n, y_n and z_n.

    The axes of its joint are x_n, and z_{n-1} as z.
    """
    x, y, z = centre
    cosine, sine = math.cos(_ALPHA[n]), math.sin(_ALPHA[n])
    along = mass * _TUBE_RADIUS**2
    across = along / 2 + mass * length**2 / 12
    place = x, cosine * y - sine * z, sine * y + cosine * z
    return {"mass": mass, "ipos": place, "inertia": (along, across, across), "explicitinertial": True}


def add_point(body: mujoco.MjsBody, mass: float, place: Sequence[float] | np.ndarray) -> None:
    """Add a point of `mass` kg to a body, at `place` (3,) m in its frame."""
    body.add_body(mass=mass, ipos=place, inertia=POINT, explicitinertial=True)
