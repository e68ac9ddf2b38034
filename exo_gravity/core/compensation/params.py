"""The parameters of `compensator`, and the settings that they describe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from exo_gravity.core.compensation.command_fade import COMMAND_PARAMETERS
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.settings import term_parameters, term_settings_of
from exo_gravity.core.compensation.terms.spring import PosePath
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.anfis_law import AnfisLaw
from exo_gravity.core.model.arm import (
    MAX_GAIN,
    MAX_GRAVITY,
    MAX_LENGTH,
    MAX_MASS,
    MAX_MOMENT,
    STANDARD_GRAVITY,
    ArmModel,
)
from exo_gravity.core.model.tilt import SIDES
from exo_gravity.core.model.wearer import SEX, TABLES, TYPICAL_LENGTH, Wearer
from exo_gravity.core.params import JOINT_NAMES, REAL_TIME_PARAMETERS, Param, param_of, params_of

# fmt: off
COMPENSATOR = (
    Param("side", "right", "side of the arm; the right arm mirrors the left", choices=SIDES, fixed=True),
    JOINT_NAMES,
    Param("link_length", [0.05, 0.13, 0.30, 0.30], "l_n, link lengths", (0.0, MAX_LENGTH), "m", fixed=True),
    param_of(Settings, "law"),
    Param("anfis_file", "", "model for the law anfis, written by train_anfis"),
    param_of(Settings, "mode"),
    param_of(Settings, "support"),
    Param("gain", [1.0, 1.0, 1.0, 1.0], "c_n, scales the torque of joint n", (0.0, MAX_GAIN)),
    Param("gravity", STANDARD_GRAVITY, "g, acceleration of gravity", (0.0, MAX_GRAVITY), "m/s^2"),
    Param("robot.mass", [0.585, 0.468, 0.598, 0.203], "m_n, link masses", (0.0, MAX_MASS), "kg"),
    Param("robot.cog", [0.046, 0.113, 0.237, 0.128], "d_n, centre of gravity from joint n", (0.0, MAX_LENGTH), "m"),
    Param("robot.first_moment", [0.0] * 4, "M1 to M4 by `calibrate`, in place of mass and cog; zeros: not given",
          (0.0, MAX_MOMENT), "kg m"),
    Param("robot.off_axis", [0.0] * 4, "W, Z, Y3, Y4 by `calibrate`: moments across the links, for the law exact",
          (-MAX_MOMENT, MAX_MOMENT), "kg m"),
    Param("wearer.mass", [0.0, 0.0, 0.0, 0.0], "mass of the wearer's arm on each link", (0.0, MAX_MASS), "kg"),
    Param("wearer.cog", [0.0, 0.0, 0.0, 0.0], "centre of gravity of that mass from joint n", (0.0, MAX_LENGTH), "m"),
    Param("wearer.body_mass", 0.0, "body mass; computes wearer.mass and wearer.cog if these are 0", (0.0, 300.0), "kg"),
    Param("wearer.sex", "male", "selects the column of the segment table", choices=SEX),
    Param("wearer.table", "de_leva", "table of segment masses and centres of gravity", choices=tuple(TABLES)),
    Param("wearer.segment_length", list(TYPICAL_LENGTH), "upper arm, forearm, hand", (0.0, 0.6), "m"),
    param_of(Settings, "max_total_mass", fixed=True),
    param_of(Settings, "max_effort"),
    param_of(Settings, "max_effort_rate"),
    param_of(Settings, "transition_time"),
    param_of(Settings, "inertial"),
    Param("shoulder_from_imu", [0.0] * 3, "the arm's base from the IMU along the trunk's axes, for inertial",
          (-1.0, 1.0), "m"),
    Param("use_imu", True, "false assumes an upright trunk (the paper's seated wearer)", fixed=True),
    param_of(Settings, "tilt_timeout"),
    *COMMAND_PARAMETERS,
    *term_parameters(),
    Param("spring.path_file", "", "CSV file with the path of the spring, rows of s and 4 angles in rad; empty: pose"),
    *REAL_TIME_PARAMETERS,
)
# fmt: on


def settings_of(values: Mapping[str, Any], anfis: AnfisLaw | None = None, path: PosePath | None = None) -> Settings:
    """Return the settings that `compensator`'s parameter values describe, or raise ParameterError.

    anfis: the model in `anfis_file`, path: the way in `spring.path_file`; None if no file is given.
    """
    robot = robot_of(values)
    mass, cog = wearer_of(values)
    return Settings(
        side=values["side"],
        robot=robot,
        wearer_mass=mass,
        wearer_cog=cog,
        shoulder_from_imu=tuple(values["shoulder_from_imu"]),
        use_imu=values["use_imu"],
        anfis=anfis,
        terms=term_settings_of(values, path),
        robot_by_mass=ArmModel(values["link_length"], values["robot.cog"], values["robot.mass"]),
        **{param.name: values[param.name] for param in params_of(Settings)},
    )


def robot_of(values: Mapping[str, Any]) -> ArmModel:
    """Return the robot's arm, by its moments if robot.first_moment is given, or raise ParameterError."""
    length, off_axis, rest = values["link_length"], values["robot.off_axis"], (values["gain"], values["gravity"])
    try:
        if any(values["robot.first_moment"]):
            return ArmModel.from_moments(length, values["robot.first_moment"], off_axis, *rest)
        return ArmModel(length, values["robot.cog"], values["robot.mass"], *rest, off_axis)
    except ParameterError as error:
        if error.name in ("mass", "cog", "first_moment", "off_axis"):
            raise ParameterError(f"robot.{error.name}", error.value, error.expected) from None
        raise


def wearer_of(values: Mapping[str, Any]) -> tuple[Sequence[float], Sequence[float]]:
    """Return mass and centre of gravity (4,) of the wearer on each link; explicit values override the table's."""
    if any(values["wearer.mass"]) or not values["wearer.body_mass"]:
        return values["wearer.mass"], values["wearer.cog"]
    person = {name: values[f"wearer.{name}"] for name in ("body_mass", "sex", "table", "segment_length")}
    try:
        load = Wearer(**person).on_links(values["link_length"])
    except ParameterError as error:
        raise ParameterError(f"wearer.{error.name}", error.value, error.expected) from None
    return load.mass.tolist(), load.cog.tolist()
