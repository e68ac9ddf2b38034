# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A node's own parameters, declared from a table of `core`."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import OPTIONS
from exo_gravity.core.params import ROS_PARAMETERS, Param, table_for, values_of

T = TypeVar("T")


def declare(node: Node, table: Sequence[Param], free_prefix: str = "") -> dict[str, Any]:
    """Declare the table's parameters on `node` and return their values by name.

    node: created with `automatically_declare_parameters_from_overrides=True`.
    free_prefix: names below it are left as given, and fixed; '' for none.

    Raises ParameterError for an impossible value, for a name that is not in the table, and for a file without the node.
    """
    given = given_to(node)
    if table and not given.keys() - set(ROS_PARAMETERS):
        _check_file(node.get_fully_qualified_name())
    table = table_for(table, given)
    values = values_of(table, given, free_prefix)
    free = [Param(name, given[name], "as given", fixed=True) for name in given if name.startswith(f"{free_prefix}.")]
    for param in (*table, *free):
        if node.has_parameter(param.name):
            node.undeclare_parameter(param.name)
        node.declare_parameter(
            param.name, values.get(param.name, param.default), descriptor_of(param), ignore_override=True
        )

    set_declared = node.set_parameters_atomically

    def set_others(given: list[Parameter]) -> SetParametersResult:
        """Refuse undeclared ones with a sentence of ours; `ros2 param load` may set read-only ones to what they are."""
        others = []
        for parameter in given:
            if not node.has_parameter(parameter.name):
                try:
                    values_of(table, {parameter.name: plain(parameter.value)})
                except ParameterError as error:
                    return SetParametersResult(successful=False, reason=str(error))
            is_fixed = node.has_parameter(parameter.name) and node.describe_parameter(parameter.name).read_only
            if not is_fixed or plain(parameter.value) != plain(node.get_parameter(parameter.name).value):
                others.append(parameter)
        return set_declared(others) if others else SetParametersResult(successful=True)

    node.set_parameters_atomically = set_others  # which rclpy's parameter services call
    return values


def _check_file(name: str) -> None:
    """Raise ParameterError if the node `name`, which got no parameters, was started by a person with a file of them."""
    if "--params-file" in sys.argv and not os.environ.get("EXO_GRAVITY_SUPERVISED"):
        path = sys.argv[sys.argv.index("--params-file") + 1]
        keys = ", ".join(yaml.safe_load(Path(path).read_text(encoding="utf-8")))
        raise ParameterError("--params-file", path, f"a file with the key {name}: it has {keys}")


def given_to(node: Node) -> dict[str, Any]:
    """Return the parameters that `node` was started with, by name."""
    return {name: plain(parameter.value) for name, parameter in node.get_parameters_by_prefix("").items()}


def accept_changes(
    node: Node, table: Sequence[Param], read: Callable[[dict[str, Any]], T], apply: Callable[[T, set[str]], object]
) -> None:
    """Let the table's parameters be changed live.

    read(values): what `apply` needs of all values by name; any exception of it refuses the change, which has had no
    effect yet.
    apply(what `read` returned, names): called after a change of the parameters `names`.
    """
    accepted: list[T] = []

    def check(changes: list[Parameter]) -> SetParametersResult:
        values = {param.name: node.get_parameter(param.name).value for param in table}
        values.update({change.name: change.value for change in changes})
        try:
            accepted[:] = [read(values_of(table, {name: plain(value) for name, value in values.items()}))]
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            names = ", ".join(change.name for change in changes)
            reason = f"{names}: cannot be used: {type(error).__name__}: {error}"
            node.get_logger().error(reason, once=True)
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(lambda changes: apply(accepted[0], {change.name for change in changes}))


def bus_of(node: Node, values: dict[str, Any]) -> tuple[str, str, dict[str, Any]]:
    """Return python-can's interface, the channel or channels, and the options that the node's parameters give."""
    options = {name: plain(parameter.value) for name, parameter in node.get_parameters_by_prefix(OPTIONS).items()}
    return values["can.interface"], values["can.channel"], options


def descriptor_of(param: Param) -> ParameterDescriptor:
    """Return the descriptor that `ros2 param describe` shows."""
    unit = f" [{param.unit}]" if param.unit else ""
    first = param.default[0] if isinstance(param.default, list) and param.default else param.default
    # A whole number is accepted for a float, as in `ros2 param set ... support 1`; `accept_changes` checks the type.
    descriptor = ParameterDescriptor(
        description=f"{param.description}{unit}", read_only=param.fixed, dynamic_typing=isinstance(first, float)
    )
    if not param.bounds or isinstance(param.default, list):
        descriptor.additional_constraints = param.expected
    elif isinstance(param.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=param.bounds[0], to_value=param.bounds[1])]
    else:
        descriptor.integer_range = [IntegerRange(from_value=int(param.bounds[0]), to_value=int(param.bounds[1]))]
    return descriptor


def plain(value: Any) -> Any:
    """Return a parameter's value with arrays as lists."""
    return list(value) if isinstance(value, list | tuple) or hasattr(value, "tolist") else value
