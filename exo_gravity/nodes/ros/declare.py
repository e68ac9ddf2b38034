"""Declares the parameter tables of `core` on a node, with descriptions for `ros2 param` and rqt."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

from exo_gravity.core.motors.joint_motor import OPTIONS
from exo_gravity.core.params import Param, values_of


def declare(node: Node, table: Sequence[Param], free_prefix: str = "") -> dict[str, Any]:
    """Declare the table's parameters on `node` and return their values by name.

    The node must have been created with `automatically_declare_parameters_from_overrides=True`. Names that start with
    `free_prefix` are left as given. Raises ParameterError for an impossible value, and for a name that is not in the
    table.
    """
    given = {name: plain(parameter.value) for name, parameter in node.get_parameters_by_prefix("").items()}
    values = values_of(table, given, free_prefix)
    for param in table:
        if node.has_parameter(param.name):
            node.undeclare_parameter(param.name)
        node.declare_parameter(param.name, values[param.name], descriptor_of(param), ignore_override=True)
    return values


def values_after(node: Node, table: Sequence[Param], changes: Sequence[Parameter] = ()) -> dict[str, Any]:
    """Return the values of the table by name as they would be after `changes`, or raise ParameterError."""
    values = {param.name: node.get_parameter(param.name).value for param in table}
    values.update({change.name: change.value for change in changes})
    return values_of(table, {name: plain(value) for name, value in values.items()})


def with_floats(node: Node, table: Sequence[Param], changes: Sequence[Parameter]) -> list[Parameter]:
    """Return `changes` with whole numbers converted to float where needed, as in `ros2 param set ... support 1`.

    Raises ParameterNotDeclaredException with the unknown names, which rclpy itself leaves out.
    """
    unknown = [change.name for change in changes if not node.has_parameter(change.name)]
    if unknown:
        raise ParameterNotDeclaredException(unknown)
    floats = {param.name for param in table if isinstance(_first(param.default), float)}
    return [_with_float(change) if change.name in floats else change for change in changes]


def bus_of(node: Node, values: dict[str, Any]) -> tuple[str, str, dict[str, Any]]:
    """Return interface, channel and options of the node's python-can bus."""
    options = {name: parameter.value for name, parameter in node.get_parameters_by_prefix(OPTIONS).items()}
    return values["can.interface"], values["can.channel"], options


def descriptor_of(param: Param) -> ParameterDescriptor:
    """Return the descriptor that `ros2 param describe` shows."""
    unit = f" [{param.unit}]" if param.unit else ""
    descriptor = ParameterDescriptor(description=f"{param.description}{unit}", read_only=param.fixed)
    if param.choices:
        descriptor.additional_constraints = param.range
    elif param.bounds and isinstance(param.default, list):
        descriptor.additional_constraints = param.expected
    elif param.bounds and isinstance(param.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=param.bounds[0], to_value=param.bounds[1])]
    elif param.bounds:
        descriptor.integer_range = [IntegerRange(from_value=int(param.bounds[0]), to_value=int(param.bounds[1]))]
    return descriptor


def _with_float(change: Parameter) -> Parameter:
    if change.type_ == Parameter.Type.INTEGER:
        return Parameter(change.name, value=float(change.value))
    if change.type_ == Parameter.Type.INTEGER_ARRAY:
        return Parameter(change.name, value=[float(number) for number in change.value])
    return change


def _first(default: Any) -> Any:
    return next(iter(default), None) if isinstance(default, list) else default


def plain(value: Any) -> Any:
    """Return a parameter's value with arrays as lists."""
    return list(value) if isinstance(value, list | tuple) or hasattr(value, "tolist") else value
