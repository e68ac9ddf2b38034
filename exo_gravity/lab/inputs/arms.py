# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The arms of a parameter file: the one reader that the tools share.

An arm is a namespace with a `can_bridge` and a `compensator`. Both are checked as the nodes check them at start, so an
unknown parameter is an error here too. Errors name node and parameter: `/right/can_bridge position_min`.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.compensation.laws import URDF_LAW
from exo_gravity.core.compensation.settings import Settings, compensator_table, settings_of
from exo_gravity.core.errors import DataError, ParameterError, named
from exo_gravity.core.motors.joint_motor import OPTIONS, JointMotor, motors_of
from exo_gravity.core.params import Param, in_force, table_for, values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE, Limits, limits_of
from exo_gravity.hardware.model_file import read_model
from exo_gravity.hardware.urdf_arm import arm_in_file
from exo_gravity.lab.inputs.parameter_file import Nodes, load, node_of, packaged_config, recorded_parameters

MASSES = {"robot.mass", "robot.first_moment"}  # a file with one of them describes the paper's arm


@dataclass(frozen=True, eq=False)
class ConfiguredArm:
    """One arm of a parameter file, the paper's or one from a URDF; checked."""

    namespace: str  #: '/right'
    can_bridge: Mapping[str, Any]  #: all parameter values by name
    compensator: Mapping[str, Any]  #: all parameter values by name
    motors: tuple[JointMotor, ...]
    limits: Limits
    robot: Arm  #: the arm without a wearer

    @property
    def name(self) -> str:
        """The namespace without slashes, 'arm' for the root namespace."""
        return self.namespace.strip("/") or "arm"

    @property
    def side(self) -> str:
        """'left' or 'right'; an arm from a URDF has that of its namespace, and without one it is a right one."""
        named_side = self.namespace.rpartition("/")[2]
        return str(self.compensator.get("side", named_side if named_side in SIDES else SIDES[-1]))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """From the shoulder on."""
        return tuple(self.compensator["joint_names"])

    @property
    def low(self) -> np.ndarray:
        """Lower joint limits (n,) in rad."""
        return np.array(self.limits.position_min)

    @property
    def high(self) -> np.ndarray:
        """Upper joint limits (n,) in rad."""
        return np.array(self.limits.position_max)

    @property
    def paper_arm(self) -> ArmModel:
        """The robot, for what no other arm than the paper's has. Raises ParameterError."""
        if "urdf.file" in self.compensator:
            expected = "exact: this is for the paper's arm alone"
            raise ParameterError(f"{self.namespace}/compensator law", self.compensator["law"], expected)
        return cast(ArmModel, self.robot)

    @cached_property
    def settings(self) -> Settings:
        """The compensator's settings, with the files that they name. Raises ParameterError."""
        with named(f"{self.namespace}/compensator "):
            return settings_from(self.compensator)


def settings_from(values: Mapping[str, Any], why: str = "", read: Callable[[str], str] | None = read_model) -> Settings:
    """Return the settings that a compensator's parameter values describe, with the files that they name.

    read: of the model of a law; None to leave it out. With `law: exact` any arm has its own torque.

    Raises ParameterError, also if a URDF comes from a topic; why: ends the sentence that it must be a file.
    """
    return settings_of(values, arm_in_file(values, why), read)


def read_arm(nodes: Nodes, namespace: str) -> ConfiguredArm:
    """Return the arm of `namespace` ('/right') in the nodes of a parameter file.

    Raises ParameterError where a node is missing or a parameter is unknown or impossible.
    """
    can_bridge = node_values(nodes, f"{namespace}/can_bridge", CAN_BRIDGE)
    node = f"{namespace}/compensator"
    given = nodes.get(node, {})
    if given.get("law") == URDF_LAW and MASSES.intersection(given):
        # The law `exact` gives the torques of a URDF of this arm.
        kept = {name: value for name, value in given.items() if not name.startswith(f"{URDF_LAW}.")}
        given = {**kept, "law": "exact"}
        nodes = {**nodes, node: given}
    compensator = node_values(nodes, node, compensator_table(given))
    with named(f"{namespace}/can_bridge "):
        motors, limits = motors_of(can_bridge), limits_of(can_bridge)
    with named(f"{node} "):
        # The robot does not depend on the law, and the model of `law: anfis` may not be trained yet.
        robot = settings_from({**compensator, "law": "exact"}, read=None).robot
    return ConfiguredArm(namespace, can_bridge, compensator, motors, limits, robot)


def configured_arms(params: str | Path) -> list[ConfiguredArm]:
    """Return every arm of a parameter file. Raises ParameterError if there is none."""
    nodes = load(params)
    namespaces = [node.removesuffix("/compensator") for node in nodes if node.endswith("/compensator")]
    if not namespaces:
        raise ParameterError("params", str(params), "a file with a compensator")
    return [read_arm(nodes, namespace) for namespace in namespaces]


def configured_arm(params: str | Path | None = None, side: str = "right") -> ConfiguredArm:
    """Return the only arm of `side` in a parameter file, by default in the packaged exo.yaml. Raises ParameterError."""
    path = params or packaged_config("exo.yaml")
    found = [arm for arm in configured_arms(path) if arm.side == side]
    if len(found) != 1:
        expected = f"a file with one compensator whose side is {side}, not {len(found)}"
        raise ParameterError("params", str(path), expected)
    return found[0]


def with_cog_at_link_ends(arm: ArmModel) -> ArmModel:
    """Return the arm under the paper's assumptions: d_n = l_n, c_n = 1 and g = 9.8 m/s^2. Raises ParameterError."""
    arm.check_masses("the paper's assumptions")
    return ArmModel(arm.length, arm.length, arm.mass, gravity=9.8)


def node_values(nodes: Nodes, node: str, table: tuple[Param, ...]) -> dict[str, Any]:
    """Return every parameter of `node` by name, checked against its `table`. Raises ParameterError."""
    if node not in nodes:
        raise ParameterError("params", sorted(nodes), f"a file with {node}")
    with named(f"{node} "):
        return values_of(table, nodes[node], OPTIONS)


def recorded_of(parameters: Mapping[str, str], arm: str, executable: str) -> dict[str, Any]:
    """Return every parameter of the compensator or can_bridge of `arm` in a recording, {} if it has none of that node.

    parameters: YAML text by node. One that the recorded version lacked has its default, one that is gone its new name.

    Raises DataError if the text is not that of parameters, or a value of another type or length.
    """
    node = node_of(arm, executable)
    if node not in parameters:
        return {}
    recorded = recorded_parameters(parameters[node], node)
    given = {new: plain for name, value in recorded.items() for new, plain in in_force(name, value).items()}
    table = _table_of(executable, given)
    for param in table:
        if param.name in given:
            try:  # a range may have been another one
                replace(param, bounds=None, choices=(), required=False).check(given[param.name])
            except ParameterError as error:
                raise DataError(f"{node}: the recording has parameters of another form: {error}") from None
    return {param.name: param.default for param in table} | given


def fitting(node: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters of a running node; of an arm's compensator or can_bridge without those that it cannot have.

    Another program may have a node of that name, with parameters of the same names and of other types.

    node: its full name.
    """
    executable = node.rpartition("/")[2]
    if executable not in ("compensator", "can_bridge"):
        return values
    params = {param.name: param for param in _table_of(executable, values)}
    fit: dict[str, Any] = {}
    for name, value in values.items():
        with suppress(ParameterError):
            fit[name] = params[name].check(value) if name in params else value
    return fit


def _table_of(executable: str, given: Mapping[str, Any]) -> Sequence[Param]:
    """Return the table of a compensator or can_bridge that has the parameters `given`."""
    table = compensator_table(given) if executable == "compensator" else CAN_BRIDGE
    return table_for(table, given)
