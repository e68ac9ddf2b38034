# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The settings of the compensator, checked against each other, and the parameters that describe them."""

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

from exo_gravity.core.arm.interface import (
    MAX_GAIN,
    MAX_GRAVITY,
    MAX_MASS,
    MAX_PAYLOAD,
    MAX_REACH,
    NO_LOAD,
    STANDARD_GRAVITY,
    Arm,
    Payload,
)
from exo_gravity.core.arm.paper import MAX_LENGTH, MAX_MOMENT, MAX_WORN_BESIDE, MAX_WORN_MOMENT, ArmModel
from exo_gravity.core.arm.springs import MAX_REST, MAX_STIFFNESS, SOFTEST, STIFFEST, Springs, held
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.arm.wearer import (
    MAX_TISSUE,
    PAPER_LINKS,
    SEX,
    TISSUE_REACH,
    TYPICAL_LENGTH,
    Wearer,
    load_by_moments,
)
from exo_gravity.core.compensation.laws import LAWS, URDF_LAW, ExactLaw, Law
from exo_gravity.core.compensation.terms.terms import GROUP, TermSettings, term_parameters, term_settings_of
from exo_gravity.core.errors import DataError, ParameterError, named
from exo_gravity.core.numbers import JOINT_COUNT, MAX_JOINTS, Torque, Vector, floats, for_joints
from exo_gravity.core.params import (
    JOINT_NAMES,
    REAL_TIME_PARAMETERS,
    Param,
    check_owned,
    installed,
    joint_count,
    loaded,
    owned,
    param_of,
    params_of,
    table_for,
)
from exo_gravity.core.safety.limits import MAX_EFFORT

MODES = ("one_g", "zero_g")
# Gain times gravity, m/s^2: twice the Earth's, rounded up. Calibrated gains are 0.8 to 1.3.
MAX_SCALE = 20.0
MAX_CARRIED = 10.0  # kg, robot and wearer's share: the arm of a 150 kg wearer has 8; more is probably in another unit
LARGEST_EFFORT = 1000.0  # Nm; an industrial arm's largest joint


class UrdfModel(Arm, Protocol):
    """An arm from a URDF."""

    @property
    def max_effort(self) -> tuple[float, ...]:
        """(n,) Nm, the joints' own limits; 0 if not known."""
        ...

    def scaled(self, gain: Sequence[float], gravity: float) -> Arm:
        """Return this arm with other gains, (n,), and another gravity, m/s^2. Raises ParameterError."""
        ...


@dataclass(frozen=True)
class ModelError:
    """How exactly an arm's model is known, as standard errors. Raises ParameterError."""

    torque: Sequence[float] = owned(
        (0.3, 0.3, 0.3, 0.1), "standard error of the robot's torque, by `calibrate`", (0.0, 5.0), "Nm"
    )
    scale: Sequence[float] = owned(
        (0.1,) * JOINT_COUNT,
        "standard error of torque_scale, as a share of it, by `calibrate`",
        (0.0, 1.0),
    )
    wearer: float = owned(
        0.15, "standard error of the wearer's arm's weight, as a share of it, by `calibrate`", (0.0, 1.0)
    )
    tilt: float = owned(0.0175, "standard error of the trunk's tilt", (0.0, 0.5), "rad")
    wearer_torque: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "standard error of the torque of the wearer's passive arm beyond that share, by `calibrate`",
        (0.0, 5.0),
        "Nm",
    )
    deflection: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "standard error of each link's angle behind its motor: play, and elasticity beyond `joint_stiffness`",
        (0.0, 0.2),
        "rad",
    )

    def __post_init__(self) -> None:
        check_owned(self)


@dataclass(frozen=True)
class Settings:
    """What holds an arm of n joints. All but `side` and `use_imu` may change while the arm is worn.

    Raises ParameterError.
    """

    side: str  #: 'left' or 'right'; 'left' for any arm from a URDF, whose root link's axes are not mirrored
    robot: Arm  #: the arm alone
    law: str = owned("exact", "law that computes the gravity torque", choices=LAWS)
    mode: str = owned("one_g", "one_g: the robot; zero_g: also the wearer's arm", choices=MODES)
    support: float = owned(0.0, "share of the wearer's arm that zero_g compensates", (0.0, 1.0))
    support_adapts: bool = owned(False, "the support rises above `support` while the wearer's arm sinks")
    raised_support: float = 0.0  #: to which it has risen on request (support.py)
    wearer_mass: Sequence[float] = ()  #: (n,) kg, the wearer's segment on each link; () for none
    wearer_cog: Sequence[float] = ()  #: (n,) m from joint n, its centre of gravity
    #: kg m, what the wearer's arm adds to the robot's moments (`Arm.with_wearer_moments`), in place of these masses in
    #: all but the inertia; () for none
    wearer_moments: Sequence[Sequence[float]] = ()
    tissue: Springs = field(default_factory=Springs)  #: of the wearer's relaxed joints
    max_effort: Sequence[float] = owned((3.0, 9.0, 3.0, 3.0), "torque limit per joint", (0.0, LARGEST_EFFORT), "Nm")
    max_effort_rate: float = owned(50.0, "fastest change of torque at rest", (1.0, 1000.0), "Nm/s", expert=True)
    tilt_timeout: float = owned(
        0.08, "age of the trunk tilt at which the efforts are withdrawn", (0.01, 0.5), "s", expert=True
    )
    inertial: bool = owned(False, "also compensate the trunk's measured acceleration")
    shoulder_from_imu: tuple[float, float, float] = owned(
        (0.0, 0.0, 0.0),
        "from the IMU to the arm's base along the trunk's axes, for `inertial`",
        (-1.0, 1.0),
        "m",
        vector=True,
    )
    use_imu: bool = True  #: False assumes an upright trunk
    trained: str = field(default="", repr=False)  #: text of the file that a law was trained into, as `anfis`
    terms: TermSettings = field(default_factory=TermSettings)
    model_error: ModelError = field(default_factory=ModelError)  #: for the bands of what is estimated
    joint_spring: Springs = field(default_factory=Springs)  #: the device's own; every law gets it
    joint_stiffness: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT,
        "stiffness between each motor and its link; 0: rigid. Not `joint_spring`",
        (0.0, STIFFEST),
        "Nm/rad",
        expert=True,
    )
    robot_by_mass: Arm | None = None  #: the robot by its masses, for `terms`; None: `robot`
    payload: Payload = NO_LOAD  #: in the hand
    #: the robot with the load in its hand, which is carried in full in both modes, like the robot's own weight
    loaded: Arm = field(init=False, repr=False, compare=False)
    #: what is compensated: `loaded` in One-G, the same plus `support` times the wearer in Zero-G
    arm: Arm = field(init=False, repr=False, compare=False)
    moving: Arm = field(init=False, repr=False, compare=False)  #: the same by its masses
    chosen: Law = field(init=False, repr=False, compare=False)  #: the law called `law`
    exact: Law = field(init=False, repr=False, compare=False)  #: what replaces it where it does not apply

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ParameterError("side", self.side, f"one of {', '.join(SIDES)}")
        check_owned(self, len(self.robot.scale))
        for name in ("wearer_mass", "wearer_cog"):
            object.__setattr__(self, name, tuple(getattr(self, name)) or (0.0,) * len(self.robot.scale))
        for prefix, springs, stiffest, most in (
            ("joint_spring.", self.joint_spring, MAX_STIFFNESS, MAX_REST),
            ("wearer.joint_", self.tissue, MAX_TISSUE, math.pi),
        ):
            if springs.on:  # else the default, of any length
                floats(f"{prefix}stiffness", springs.stiffness, len(self.robot.scale), 0.0, stiffest, "Nm/rad")
                floats(f"{prefix}rest", springs.rest, len(self.robot.scale), -most, most, "rad")
        if soft := [k for k in self.joint_stiffness if 0.0 < k < SOFTEST]:
            raise ParameterError("joint_stiffness", soft, f"0 for a rigid joint, or at least {SOFTEST:g} Nm/rad")
        self._carry(self.robot)
        object.__setattr__(self, "chosen", LAWS[self.law](self))
        object.__setattr__(self, "exact", ExactLaw(self.arm))

    def _carry(self, robot: Arm) -> None:
        """Compute what is carried."""
        loaded = robot.with_payload(*self.payload)
        # Computed in every mode, so that an impossible wearer is refused now and not when the mode becomes zero_g.
        whole = self.worn(loaded, self.support_now)
        if self.wearer_moments and self.mode == "zero_g" and self.law not in LAWS.by_moments:
            raise ParameterError("law", self.law, "exact with wearer.first_moment: it needs mass and cog")
        wearer = sum(self.wearer_mass) * (1.0 if self.support_adapts else self.support_now)
        given = loaded.given_mass
        if given + wearer > MAX_CARRIED:
            bare = given - self.payload.mass
            parts = f"robot {bare:.2f}, wearer's share {wearer:.2f}, payload.mass {self.payload.mass:.2f}"
            bound = f"at most {MAX_CARRIED:g} ({parts})"
            raise ParameterError("total mass in kg", round(given + wearer, 2), bound)
        if max(robot.scale) > MAX_SCALE:
            scale = [round(value, 2) for value in robot.scale]
            raise ParameterError("gain times gravity", scale, f"at most {MAX_SCALE:g} m/s^2, twice the Earth's gravity")
        by_mass = (self.robot_by_mass or robot).with_payload(*self.payload)
        carried = by_mass.with_wearer(self.wearer_mass, self.wearer_cog, self.support_now)
        object.__setattr__(self, "terms", self.terms.on_arm(self.robot_by_mass or robot))
        object.__setattr__(self, "loaded", loaded)
        object.__setattr__(self, "arm", whole if self.mode == "zero_g" else loaded)
        object.__setattr__(self, "moving", carried if self.mode == "zero_g" else by_mass)

    def worn(self, arm: Arm, support: float = 1.0) -> Arm:
        """Return `arm` plus a share `support` (0..1) of the wearer's arm. Raises ParameterError."""
        if self.wearer_moments:
            return arm.with_wearer_moments(self.wearer_moments, support)
        return arm.with_wearer(self.wearer_mass, self.wearer_cog, support)

    @cached_property
    def unit_load(self) -> Arm:
        """A load of 1 kg in the hand, without an arm, where gravity is 1 m/s^2.

        Raises ParameterError if it is not known where a load is held.
        """
        return self.robot.massless(1.0).with_payload(1.0, self.payload.cog)

    @property
    def is_adaptive(self) -> bool:
        """Whether the support follows requests."""
        return self.mode == "zero_g" and self.support_adapts

    @property
    def support_now(self) -> float:
        """The share of the wearer's arm that zero_g compensates at present."""
        return max(self.support, self.raised_support)

    @property
    def mass(self) -> float:
        """What is carried, in kg."""
        return self.arm.total_mass

    def torque(self, theta: Sequence[float], tilt: Tilt, exact: bool = False) -> tuple[Torque, str]:
        """Return the torque (n,) in Nm that holds the arm at `theta` (n,) rad; exact: by the exact law in any case.

        theta: of the motors, behind which the links of elastic joints lie.
        The joints' own springs are included, in zero_g also `support` of the wearer's tissue. And why the chosen law
        does not apply here, or ''. Then the exact law replaces it.
        """
        reason = self.chosen.outside(theta, tilt)
        law = self.exact if exact or reason else self.chosen
        if any(self.joint_stiffness):
            return held(lambda links: self._of_links(law, links, tilt), theta, self.joint_stiffness), reason
        return self._of_links(law, theta, tilt), reason

    def sprung(self, torque: Torque, theta: Sequence[float]) -> Torque:
        """Return `torque` (n,) in Nm with that of the robot's own springs at `theta` (n,) rad."""
        return tuple(map(operator.add, torque, self.joint_spring.torque(theta))) if self.joint_spring.on else torque

    def _of_links(self, law: Law, theta: Sequence[float], tilt: Tilt) -> Torque:
        """Return the torque (n,) in Nm by `law` with all springs for links at `theta` (n,) rad."""
        torque = self.sprung(law.torque(theta, tilt), theta)
        if self.mode == "zero_g" and self.tissue.on:
            share = self.support_now
            torque = tuple([tau + share * own for tau, own in zip(torque, self.tissue.torque(theta), strict=True)])
        return torque


# fmt: off
COMPENSATOR = (
    Param("side", "right", "side of the arm; the right arm mirrors the left", choices=SIDES, fixed=True),
    replace(JOINT_NAMES, vector=True),
    Param("link_length", [0.05, 0.13, 0.30, 0.30], "l_n, link lengths", (0.0, MAX_LENGTH), "m", fixed=True),
    param_of(Settings, "law"),
    Param("anfis_file", "", "model for the law anfis, written by train_anfis", expert=True),
    param_of(Settings, "mode"),
    param_of(Settings, "support"),
    param_of(Settings, "support_adapts"),
    Param("gain", [1.0, 1.0, 1.0, 1.0], "c_n, scales the torque of joint n", (0.0, MAX_GAIN)),
    Param("gravity", STANDARD_GRAVITY, "g, acceleration of gravity", (1.0, MAX_GRAVITY), "m/s^2"),
    Param("robot.mass", [0.585, 0.468, 0.598, 0.203], "m_n, link masses", (0.0, MAX_MASS), "kg"),
    Param("robot.cog", [0.046, 0.113, 0.237, 0.128], "d_n, centre of gravity from joint n", (0.0, MAX_LENGTH), "m"),
    Param("robot.first_moment", [0.0] * JOINT_COUNT, "M1 to M4 along the links, by `calibrate`, for the law exact; all "
          "0: by mass and cog", (0.0, MAX_MOMENT), "kg m", expert=True),
    Param("robot.off_axis", [0.0] * JOINT_COUNT, "W, Z, Y3, Y4 across them, by `calibrate`, for the law exact",
          (-MAX_MOMENT, MAX_MOMENT), "kg m", expert=True),
    Param("wearer.mass", [0.0, 0.0, 0.0, 0.0], "mass of the wearer's arm on each link", (0.0, MAX_MASS), "kg"),
    Param("wearer.cog", [0.0, 0.0, 0.0, 0.0], "centre of gravity of that mass from joint n", (0.0, MAX_LENGTH), "m"),
    Param("wearer.body_mass", 0.0, "body mass; for wearer.mass and wearer.cog, if these are 0", (0.0, 300.0), "kg"),
    Param("wearer.sex", "male", "selects the column of the segment table", choices=SEX),
    Param("wearer.segment_length", list(TYPICAL_LENGTH), "upper arm, forearm, hand", (0.0, 0.6), "m", vector=True),
    Param("wearer.first_moment", [0.0] * JOINT_COUNT, "what the wearer's arm adds to M1 to M4, by `calibrate wearer`; "
          "all 0: by mass and cog", (0.0, MAX_WORN_MOMENT), "kg m", expert=True),
    Param("wearer.off_axis", [0.0] * JOINT_COUNT, "what it adds to W, Z, Y3, Y4, where wearer.first_moment is given",
          (-MAX_WORN_BESIDE, MAX_WORN_BESIDE), "kg m", expert=True),
    Param("wearer.joint_stiffness", [0.0] * JOINT_COUNT, "of the wearer's relaxed joints, by `calibrate wearer`; "
          "zero_g compensates `support` of it", (0.0, MAX_TISSUE), "Nm/rad", expert=True),
    Param("wearer.joint_rest", [0.0] * JOINT_COUNT, "angle at which they rest", (-math.pi, math.pi), "rad",
          expert=True),
    Param("payload.mass", 0.0, "load in the hand, carried in full in both modes; 0 once it was dropped",
          (0.0, MAX_PAYLOAD), "kg"),
    Param("payload.cog", [0.0] * 3, "its centre of gravity from the end of link 4, along x_4, y_4, z_4",
          (-MAX_REACH, MAX_REACH), "m", vector=True),
    replace(param_of(Settings, "max_effort"), bounds=(0.1, MAX_EFFORT)),
    param_of(Settings, "max_effort_rate"),
    param_of(Settings, "inertial"),
    param_of(Settings, "shoulder_from_imu"),
    Param("use_imu", True, "false assumes an upright trunk (the paper's seated wearer)", fixed=True),
    param_of(Settings, "tilt_timeout"),
    Param("joint_spring.stiffness", [0.0] * JOINT_COUNT, "of the device's own springs, such as cables, by `calibrate`",
          (0.0, MAX_STIFFNESS), "Nm/rad", expert=True),
    Param("joint_spring.rest", [0.0] * JOINT_COUNT, "angle at which each of them is slack", (-MAX_REST, MAX_REST),
          "rad", expert=True),
    param_of(Settings, "joint_stiffness"),
    *term_parameters(),
    *REAL_TIME_PARAMETERS,
)
# What is declared where a file gives `command_interface`, for an arm with an effort controller of ros2_control.
COMMAND_PARAMETERS = (
    Param("command_interface", "joint_state",
          "joint_state: to can_bridge; multi_array: to an effort controller of ros2_control", fixed=True,
          choices=("joint_state", "multi_array")),
    Param("multi_array.topic", "effort_controller/commands", "topic of the effort controller's commands", fixed=True),
    Param("multi_array.joint_states", "joint_states", "topic of the joint states, which may have further joints",
          fixed=True),
    Param("multi_array.timeout", 0.05, "age of the joint states at which the torque begins to fade", (0.01, 0.15), "s",
          fixed=True, expert=True),
)
# What is declared where a file gives one of them, as `calibrate` writes them.
MODEL_PARAMETERS = tuple(replace(param, name=f"model_error.{param.name}") for param in params_of(ModelError))
WORN_MOMENTS = ("wearer.moment_x", "wearer.moment_y", "wearer.moment_z")  # of an arm from a URDF
# What an arm from a URDF has in place of PAPER: the first also in `simulator`.
URDF_FILE = Param("urdf.file", "", "path of the URDF; empty: the topic urdf.topic", fixed=True)
URDF_HAND = Param("urdf.hand", "", "link that holds the load; empty: no load, no wearer on the last link", fixed=True)
URDF = (
    URDF_FILE,
    Param("urdf.topic", "/robot_description", "latched topic of the URDF, a std_msgs/String", fixed=True),
    URDF_HAND,
    Param("wearer.links", list(PAPER_LINKS), "links that carry upper arm, and forearm and hand, from 1 on; 0: none",
          (0, MAX_JOINTS), vector=True, fixed=True),
    *(Param(f"urdf.moment_{axis}", [0.0] * JOINT_COUNT, "by `calibrate gravity`: each link's first moment beyond the "
            f"URDF's, along {axis} of the joint's frame", (-MAX_MOMENT, MAX_MOMENT), "kg m",
            fixed=True, expert=True) for axis in "xyz"),
    *(Param(f"urdf.turn_{axis}", [0.0] * JOINT_COUNT, "by `calibrate gravity`: turn of each joint's axis beyond the "
            f"URDF's, about {axis} of the joint's frame", (-0.2, 0.2), "rad",
            fixed=True, expert=True) for axis in "xyz"),
    *(Param(name, [0.0] * JOINT_COUNT, "by `calibrate wearer`: what the wearer's arm adds to each link's first "
            f"moment, along {name[-1]} of the joint's frame; all 0: by mass and cog",
            (-MAX_WORN_MOMENT, MAX_WORN_MOMENT), "kg m", expert=True) for name in WORN_MOMENTS),
)
PAPER = {"side", "link_length", "anfis_file", "robot.mass", "robot.cog", "robot.first_moment", "robot.off_axis",
         "wearer.first_moment", "wearer.off_axis"}
# fmt: on


def terms_of_others(names: Iterable[str]) -> dict[str, Any]:
    """Return the terms of other distributions that parameter `names` are of, by prefix. Raises ParameterError."""
    ours = (param.name for param in (*COMPENSATOR, *COMMAND_PARAMETERS, *MODEL_PARAMETERS, *URDF))
    known, given = ({name.partition(".")[0] for name in each} for each in (ours, names))
    return {name: loaded(GROUP, name, "term") for name in sorted(given - known) if name in installed(GROUP)}


def compensator_table(given: Mapping[str, Any]) -> tuple[Param, ...]:
    """Return the parameters of `compensator` for the paper's arm, or the one from a URDF, of `given` ones."""
    groups = [part for part in (COMMAND_PARAMETERS, MODEL_PARAMETERS) if any(param.name in given for param in part)]
    optional = (*itertools.chain(*groups), *term_parameters(terms_of_others(given)))
    if given.get("law") != URDF_LAW:
        return (*COMPENSATOR, *optional)
    count = joint_count(given)
    changes: dict[str, dict[str, Any]] = {
        "law": {"default": URDF_LAW, "choices": (URDF_LAW,), "fixed": True,
                "description": "urdf computes the torque of any serial arm from its URDF"},
        "joint_names": {"vector": False,
                        "description": "in the order of the commands"},
        "max_effort": {"default": [0.0] * count, "bounds": (0.0, LARGEST_EFFORT),
                       "description": "torque limit per joint; 0: the URDF's"},
        "spring.pose": {"default": [0.0] * count},
        "payload.cog": {"description": "its centre of gravity in the frame of the link urdf.hand"},
        "use_imu": {"description": "false assumes that the root link's z axis points up"},
    }  # fmt: skip
    shared = [replace(param, **changes.get(param.name, {})) for param in COMPENSATOR if param.name not in PAPER]
    return tuple(table_for((*shared, *URDF, *optional), given))


def settings_of(
    values: Mapping[str, Any], urdf: UrdfModel | None = None, read: Callable[[str], str] | None = None
) -> Settings:
    """Return the settings that `compensator`'s parameter values describe, or raise ParameterError.

    urdf: the arm, for `law: urdf`. read: returns the text of the file `anfis_file`; without it the file is left out.
    """
    if urdf is None and values["law"] == URDF_LAW:
        raise ParameterError("law", URDF_LAW, "chosen at the start, with an arm from a URDF")
    robot: Arm = urdf.scaled(values["gain"], values["gravity"]) if urdf else robot_of(values)
    with named("robot."):
        by_mass = None if urdf else ArmModel(values["link_length"], values["robot.cog"], values["robot.mass"])
    mass, cog = wearer_of(values, robot.length)
    along = values.get("wearer.first_moment", ())
    worn = (along, values["wearer.off_axis"]) if along else zip(*(values[name] for name in WORN_MOMENTS), strict=True)
    moments = tuple(map(tuple, worn))
    errors: list[Any] = [values.get(param.name, param.default) for param in MODEL_PARAMETERS]
    sized: list[Any] = [for_joints(error, len(mass), max) if isinstance(error, Sequence) else error for error in errors]
    own = {param.name: values[param.name] for param in params_of(Settings)}
    limits = _limited(values, urdf.max_effort) if urdf else values["max_effort"]
    path = values.get("anfis_file", "")
    try:
        return Settings(
            side=values.get("side", SIDES[0]),  # a URDF's root link is not mirrored
            robot=robot,
            robot_by_mass=by_mass,
            wearer_mass=mass,
            wearer_cog=cog,
            wearer_moments=moments if any(along or itertools.chain(*moments)) else (),
            use_imu=values["use_imu"],
            trained=read(path) if path and read else "",
            terms=term_settings_of(values, terms_of_others(values)),
            model_error=ModelError(*sized),
            joint_spring=joint_spring_of(values),
            tissue=Springs(values["wearer.joint_stiffness"], values["wearer.joint_rest"], TISSUE_REACH),
            payload=Payload(values["payload.mass"], tuple(values["payload.cog"])),
            **{**own, "max_effort": limits},
        )
    except (OSError, UnicodeDecodeError, DataError) as error:
        raise ParameterError("anfis_file", path, f"a file from train_anfis ({error})") from None


def _limited(values: Mapping[str, Any], most: Sequence[float]) -> tuple[float, ...]:
    """Return `max_effort` (n,) Nm, the URDF's `most` where it is 0. Raises ParameterError where neither has a limit."""
    limits = tuple(given or own for given, own in zip(values["max_effort"], most, strict=True))
    for name, limit in zip(values["joint_names"], limits, strict=True):
        if not limit:
            raise ParameterError(
                f"max_effort of {name}", limit, "greater than 0, because the URDF has no usable effort limit"
            )
    return limits


def joint_spring_of(values: Mapping[str, Any]) -> Springs:
    """Return the device's own springs that parameter values describe."""
    return Springs(values["joint_spring.stiffness"], values["joint_spring.rest"])


def robot_of(values: Mapping[str, Any]) -> ArmModel:
    """Return the robot's arm, by its moments if robot.first_moment has any, or raise ParameterError."""
    length, along, across = (values[name] for name in ("link_length", "robot.first_moment", "robot.off_axis"))
    rest = values["gain"], values["gravity"]
    with named("robot."):
        if any(along):
            return ArmModel.from_moments(length, along, across, *rest)
        return ArmModel(length, values["robot.cog"], values["robot.mass"], *rest, across)


def wearer_of(values: Mapping[str, Any], length: Vector) -> tuple[Sequence[float], Sequence[float]]:
    """Return mass and centre of gravity (n,) of the wearer on each link; explicit values override the table's.

    Where only the moments are given, those of typical masses: they are for the inertia alone.

    length: of the links, (n,) m.
    """
    if not any(values["wearer.mass"]) and not values["wearer.body_mass"] and any(values.get("wearer.first_moment", ())):
        moments = values["wearer.first_moment"]
        load = load_by_moments(length, moments)
        if load.mass.sum() > MAX_CARRIED:
            heaviest = f"that of an arm of at most {MAX_CARRIED:g} kg, not {load.mass.sum():.1f}"
            raise ParameterError("wearer.first_moment", moments, heaviest)
        return tuple(load.mass), tuple(load.cog)
    if any(values["wearer.mass"]) or not values["wearer.body_mass"]:
        return values["wearer.mass"], values["wearer.cog"]
    person = {name: values[f"wearer.{name}"] for name in ("body_mass", "sex", "segment_length")}
    with named("wearer."):
        wearer = Wearer(**person)
    load = wearer.on_links(length, values.get("wearer.links", PAPER_LINKS))
    return load.mass.tolist(), load.cog.tolist()
