"""Any serial arm, as `compensator` runs it with `law: urdf`: its URDF from a file or from `robot_description`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from exo_gravity.core.compensation.any_arm import (
    LAW,
    MAX_JOINTS,
    AnyArm,
    AnyArmSettings,
    any_arm_settings,
    any_arm_table,
)
from exo_gravity.core.compensation.compensator import Answer
from exo_gravity.core.compensation.params import COMPENSATOR
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.nodes.ros.hot_path import LATCHED
from exo_gravity.nodes.ros.messages import row
from exo_gravity.nodes.ros.parameters import declare

DESCRIPTION_TIMEOUT = 10.0  # s in which robot_description must arrive


def is_any_arm(node: Node) -> bool:
    """Return whether the node's parameters choose the law `urdf`."""
    return node.has_parameter("law") and node.get_parameter("law").value == LAW


class AnyUrdfArm:
    """Parameters, control and reports of an arm of n joints; the counterpart of `ExoArm`."""

    failure: Exception | None = None

    def __init__(self, node: Node) -> None:
        _forget_unused(node)
        self.table = any_arm_table(len(_joint_names(node)))
        self.values = declare(node, self.table)
        self._model = UrdfArm(_description(node, self.values), self.values["joint_names"])
        self.control = AnyArm(self._model, self.read(self.values))

    def read(self, values: dict[str, Any]) -> AnyArmSettings:
        """Return the settings that parameter values describe. Raises ParameterError."""
        return any_arm_settings(values, self._model)

    def start(self) -> None:
        """Do nothing: there is no outer loop."""

    def stop(self) -> None:
        """Do nothing: there is no outer loop."""

    def update(self) -> None:
        """Do nothing: there is no torque budget."""

    def on_motion(self, *_sample: Any) -> None:
        """Do nothing: the root link counts as at rest."""

    def sentence(self, s: AnyArmSettings) -> str:
        """Return settings in a sentence for the log."""
        return f"law {LAW}, {len(s.gain)} joints: compensates {self._model.mass:.2f} kg, at most {row(s.max_effort)} Nm"

    def concern(self, _answer: Answer) -> str:
        """Return '': the law applies everywhere."""
        return ""

    def report(self, _answer: Answer) -> dict[str, object]:
        """Return the current values for /diagnostics."""
        s = self.control.settings
        carried, limits = f"{self._model.mass:.3f}", row(s.max_effort)
        return {"law": LAW, "mass carried (kg)": carried, "gain": row(s.gain), "max effort (Nm)": limits}


def _forget_unused(node: Node) -> None:
    """Undeclare the parameters of the exoskeleton's own arm, which a file may have, and log them."""
    used = {param.name for param in any_arm_table(1)}
    unused = [param.name for param in COMPENSATOR if param.name not in used and node.has_parameter(param.name)]
    for name in unused:
        node.undeclare_parameter(name)
    if unused:
        node.get_logger().warning(f"law {LAW} takes the arm from its URDF and ignores {', '.join(unused)}")


def _joint_names(node: Node) -> list[str]:
    names = list(node.get_parameter("joint_names").value or ()) if node.has_parameter("joint_names") else []
    if not 1 <= len(set(names)) == len(names) <= MAX_JOINTS:
        raise ParameterError("joint_names", names, f"1 to {MAX_JOINTS} different joints of the URDF")
    return names


def _description(node: Node, values: dict[str, Any]) -> str:
    """Return the URDF from its file or topic. Raises ParameterError."""
    path = values["urdf.file"]
    if not path:
        return _published(node, values["urdf.topic"])
    try:
        return Path(path).expanduser().read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError("urdf.file", path, f"a URDF file ({error})") from None


def _published(node: Node, topic: str) -> str:
    received: list[String] = []
    subscription = node.create_subscription(String, topic, received.append, LATCHED)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = time.monotonic() + DESCRIPTION_TIMEOUT
    while not received and time.monotonic() < end and rclpy.ok(context=node.context):
        executor.spin_once(timeout_sec=0.1)
    executor.remove_node(node)
    executor.shutdown()
    node.destroy_subscription(subscription)
    if not received:
        raise ParameterError("urdf.topic", topic, f"published, latched, within {DESCRIPTION_TIMEOUT:g} s")
    return received[0].data
