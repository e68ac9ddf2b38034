"""The arm that `compensator` carries: its parameters, its compensator, and what is reported of it.

The exoskeleton's own arm has its laws, a wearer, terms, an outer loop and a torque budget. With `law: urdf` it is any
serial arm, whose URDF comes from a file or from `robot_description`, with gravity compensation alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import String

from exo_gravity.core.compensation.compensator import Answer, Compensator
from exo_gravity.core.compensation.params import (
    COMPENSATOR,
    MAX_JOINTS,
    compensator_table,
    settings_of,
    urdf_settings_of,
    urdf_table,
)
from exo_gravity.core.compensation.settings import URDF_LAW, Settings, UrdfSettings
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.core.params import Param
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.nodes.ros.hot_path import LATCHED
from exo_gravity.nodes.ros.messages import row
from exo_gravity.nodes.ros.parameters import declare

DESCRIPTION_TIMEOUT = 10.0  # s in which robot_description must arrive

Read = Callable[[dict[str, Any]], Settings | UrdfSettings]


def declared(node: Node) -> tuple[Sequence[Param], dict[str, Any], Read]:
    """Declare the parameters of the node's arm. Raises ParameterError.

    Returns their table, their values, and a function that returns the settings that such values describe.
    """
    given = node.get_parameters_by_prefix("")
    if "law" not in given or given["law"].value != URDF_LAW:
        table = compensator_table(given)
        return table, declare(node, table), _settings
    table = urdf_table(len(_joint_names(node)), given)
    _forget_unused(node, {param.name for param in table})
    values = declare(node, table)
    model = UrdfArm(_description(node, values), values["joint_names"])
    return table, values, lambda values: urdf_settings_of(values, model)


def _settings(values: dict[str, Any]) -> Settings:
    """Return the settings of the exoskeleton's own arm, with the file that they name. Raises ParameterError."""
    path = values["anfis_file"]
    try:
        anfis = AnfisLaw.load(Path(path).read_text(encoding="utf-8")) if path else None
    except (OSError, UnicodeDecodeError, DataError) as error:
        raise ParameterError("anfis_file", path, f"a file from train_anfis ({error})") from None
    return settings_of(values, anfis)


def sentence(s: Settings | UrdfSettings) -> str:
    mode = f"{s.side} arm, mode {s.mode}, support {s.support:g}, " if isinstance(s, Settings) else ""
    mass = s.arm.total_mass if isinstance(s, Settings) else s.arm.mass
    return f"{mode}law {s.law}: compensates {mass:.2f} kg, at most {row(s.max_effort)} Nm"


def report(control: Compensator, answer: Answer, names: Sequence[str]) -> dict[str, object]:
    """Return what the arm's settings and terms are, for /diagnostics. names: of the joints."""
    s, terms = control.settings, control.terms
    most, name = max(zip(map(abs, answer.remainder), names, strict=False), default=(0.0, ""))
    values: dict[str, object] = {"law": s.law, "changing load": f"{name}, {most:.1f} Nm to go" if name else "none"}
    if isinstance(s, UrdfSettings):
        carried, limits = f"{s.arm.mass:.3f}", row(s.max_effort)
        return {**values, "mass carried (kg)": carried, "gain": row(s.gain), "max effort (Nm)": limits}
    values |= {
        "law in use": "exact" if answer.fallback else s.law,
        "mode": s.mode,
        "support": s.support,
        "robot mass (kg)": "not known" if s.robot.by_moments else row(s.robot.mass),
        "robot cog (m)": "not known" if s.robot.by_moments else row(s.robot.cog),
        "robot moments (kg m)": row((*s.robot.first_moment, *s.robot.off_axis)),
        "wearer mass (kg)": row(s.wearer_mass),
        "wearer cog (m)": row(s.wearer_cog),
        "mass carried (kg)": f"{s.arm.total_mass:.3f}",
        "max effort (Nm)": row(s.max_effort),
    }
    if terms:
        values["terms"] = ", ".join(terms.active) or "none"
        values["assist"] = terms.assist.report
        values["inertia tank (J)"] = f"{terms.energy:.2f}"
    return values


def _forget_unused(node: Node, used: set[str]) -> None:
    """Undeclare the parameters of the exoskeleton's own arm, which a file may have, and log them."""
    unused = [param.name for param in COMPENSATOR if param.name not in used and node.has_parameter(param.name)]
    for name in unused:
        node.undeclare_parameter(name)
    if unused:
        node.get_logger().warning(f"law {URDF_LAW} takes the arm from its URDF and ignores {', '.join(unused)}")


def _joint_names(node: Node) -> list[str]:
    names = list(node.get_parameter("joint_names").value or ()) if node.has_parameter("joint_names") else []
    if not 1 <= len(set(names)) == len(names) <= MAX_JOINTS:
        raise ParameterError("joint_names", names, f"1 to {MAX_JOINTS} different joints of the URDF")
    return names


def _description(node: Node, values: dict[str, Any]) -> str:
    """Return the URDF from its file or topic. Raises ParameterError."""
    path, topic = values["urdf.file"], values["urdf.topic"]
    if not path:
        arrived, message = wait_for_message(String, node, topic, qos_profile=LATCHED, time_to_wait=DESCRIPTION_TIMEOUT)
        if not arrived:
            raise ParameterError("urdf.topic", topic, f"published, latched, within {DESCRIPTION_TIMEOUT:g} s")
        return str(message.data)
    try:
        return Path(path).expanduser().read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError("urdf.file", path, f"a URDF file ({error})") from None
