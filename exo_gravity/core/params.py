# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters: a table for each node, and the check of given values against it.

A name that is not in the table is an error, because a misspelt safety limit must not silently keep its default. A
parameter that a frozen dataclass uses is declared there (`owned`), with the rules that relate several values; the table
takes it from there (`param_of`).
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import MAX_JOINTS

# ROS declares these on every node, and `ros2 param dump` writes them to files.
ROS_PARAMETERS = ("use_sim_time", "start_type_description_service")
ROS_QOS_PREFIX = "qos_overrides."
COUNTED = ("joint_names", "can_id")  # lists that say how many joints an arm has
KINDS = {float: "number", int: "whole number", str: "string", bool: "true or false"}
# Parameters that were valid once and are gone: what to write for such a value, by the names in force.
GONE: dict[str, Callable[[list[Any]], dict[str, Any]]] = {
    "robot.moments": lambda value: {"robot.first_moment": value[:4], "robot.off_axis": value[4:]},
    "first_moment": lambda value: {"robot.first_moment": value},  # of the calibrator, as `off_axis`
    "off_axis": lambda value: {"robot.off_axis": value},
    "friction.identified": lambda value: {"friction.coulomb": value[:4], "friction.viscous": value[4:]},
    "limits.range": lambda value: {"limits.lower": value[0::2], "limits.upper": value[1::2]},
    "inertial.shoulder_from_imu": lambda value: {"inertial": any(value), "shoulder_from_imu": value},
    **dict.fromkeys(("serial.port", "serial.baud"), lambda value: {"source": "topic"}),  # its ROS driver reads it
}


@dataclass(frozen=True)
class Param:
    """One parameter. The type of `default` is the parameter's type."""

    name: str
    default: Any
    description: str
    bounds: tuple[float, float] | None = None  #: lowest and highest value, also for each number in a list
    unit: str = ""
    choices: Collection[str] = ()
    fixed: bool = False  #: read-only while the node runs
    required: bool = False  #: the user must give a non-empty value
    expert: bool = False  #: only an expert changes it; the documents list it apart, and the panel does not show it
    any_length: bool = False  #: a list may have another length than its default
    #: a list keeps the length of its default on any arm, as a vector does; otherwise it has one entry per joint
    vector: bool = False

    @property
    def is_per_joint(self) -> bool:
        """Whether the value is a list with one entry per joint."""
        return isinstance(self.default, list) and bool(self.default) and not (self.any_length or self.vector)

    @property
    def omitted(self) -> Any:
        """What a file has that leaves this parameter out: the default, or an empty list that `check` refuses."""
        return [] if self.required and isinstance(self.default, list) else self.default

    def for_joints(self, count: int) -> "Param":
        """Return this parameter for an arm of `count` joints.

        A default that is the same for all joints is kept. One that tells the joints of the paper's arm apart is no
        default for another arm: its file must give the list.
        """
        if not self.is_per_joint or len(self.default) == count:
            return self
        return replace(self, default=self.default[:1] * count, required=self.required or len(set(self.default)) > 1)

    def check(self, value: Any) -> Any:
        """Return `value` in this parameter's type; other numbers are converted if the type is float.

        Raises ParameterError if the type, the length of a list or a value is wrong.
        """
        is_list = isinstance(value, Sequence) and not isinstance(value, str)
        items: list[Any] = list(value) if is_list else [value]
        kind, count = self._kind_and_count
        if kind is float:
            items = [_float(x) for x in items]
        if self.required and (not items or "" in items):
            raise ParameterError(self.name, value, f"set to {self.expected}")
        fits = is_list == isinstance(self.default, list) and count in (None, len(items))
        low, high = self.bounds or (None, None)
        for item in items:
            fits = fits and type(item) is kind and (not self.choices or item in self.choices)
            fits = fits and (low is None or low <= item <= high)
        if not fits:
            raise ParameterError(self.name, value, self.expected)
        return items if is_list else items[0]

    @property
    def _kind_and_count(self) -> tuple[type[Any], int | None]:
        """The type of a value or of a list's entries, and how many there are; None for any number."""
        if not isinstance(self.default, list):
            return type(self.default), 1
        if not self.default:
            return str, None
        return type(self.default[0]), None if self.any_length else len(self.default)

    @property
    def range(self) -> str:
        """The permitted values: the choices, or the bounds and the unit; '' if every value of the type is valid."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        unit = f" {self.unit}" if self.unit else ""
        return f"from {self.bounds[0]:g} to {self.bounds[1]:g}{unit}" if self.bounds else ""

    @property
    def expected(self) -> str:
        """A description of the permitted values, for error messages."""
        kind, count = self._kind_and_count
        text = KINDS[kind] if kind is bool else f"a {KINDS[kind]}"
        if isinstance(self.default, list):
            text = f"{count or 'a list of'} {KINDS[kind]}{'' if count == 1 else 's'}"
        return f"{text}{', ' if self.choices else ' '}{self.range}".rstrip()


def _float(value: Any) -> Any:
    """Return a number as a float, infinite if it is too large for one; anything else as it is."""
    if not isinstance(value, int | float) or type(value) is bool:
        return value
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def owned(
    default: Any, description: str, bounds: tuple[float, float] | None = None, unit: str = "", **other: Any
) -> Any:
    """Return a dataclass field that owns a parameter; a tuple as default makes it a list. other: as in `Param`."""
    plain = list(default) if isinstance(default, tuple) else default
    return field(default=default, metadata={"param": Param("", plain, description, bounds, unit, **other)})


def param_of(owner: type, name: str, fixed: bool = False) -> Param:
    """Return the parameter that field `name` of the dataclass `owner` owns."""
    param: Param = next(f for f in fields(owner) if f.name == name).metadata["param"]
    return replace(param, name=name, fixed=fixed)


def params_of(owner: type, fixed: bool = False) -> tuple[Param, ...]:
    """Return all parameters that the dataclass `owner` owns, in the order of its fields."""
    return tuple(param_of(owner, f.name, fixed) for f in fields(owner) if "param" in f.metadata)


def check_owned(instance: Any, count: int | None = None) -> None:
    """Check every owned field of a frozen dataclass instance, and convert its numbers; a list becomes a tuple.

    count: of the arm's joints; None: as many as the longest list with one entry per joint has. A default that is the
    same for all joints has as many. Raises ParameterError that names the field.
    """
    params = {param.name: param for param in params_of(type(instance))}
    given = {name: getattr(instance, name) for name in params}
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in given.items()}
    if count is None:
        lists = [plain[name] for name, param in params.items() if param.is_per_joint]
        count = max([len(value) for value in lists if isinstance(value, list | tuple)], default=0)
    defaults = {field.name: field.default for field in fields(instance)}
    for name, param in params.items():
        sized = param.for_joints(count)
        checked = sized.check(sized.omitted if given[name] is defaults[name] else plain[name])
        object.__setattr__(instance, name, tuple(checked) if isinstance(checked, list) else checked)


def in_force(name: str, value: Any) -> dict[str, Any]:
    """Return a parameter that may be of `GONE` by the names in force: what to write for it, by name."""
    if name not in GONE:
        return {name: value}
    return GONE[name](list(value) if isinstance(value, Sequence) else [])


def joint_count(given: Mapping[str, Any]) -> int:
    """Return of how many joints `given` has the names, or else the motors' IDs; else how many the paper's arm has."""
    lists = (given[name] for name in COUNTED if isinstance(given.get(name), list | tuple))
    count = len(next(lists, ()))
    return count if 1 <= count <= MAX_JOINTS else len(JOINT_NAMES.default)


def table_for(table: Sequence[Param], given: Mapping[str, Any]) -> Sequence[Param]:
    """Return `table` for an arm of as many joints as `given` has; unchanged if it is for one arm only."""
    if not any(param.name in COUNTED and param.is_per_joint for param in table):
        return table
    count = joint_count(given)
    return [param.for_joints(count) for param in table]


def values_of(table: Sequence[Param], given: Mapping[str, Any], free_prefix: str = "") -> dict[str, Any]:
    """Return the value of every parameter of the table by name: the given value, or the default.

    Names below `free_prefix` and names that ROS declares are ignored. A list with one entry per joint has as
    many as the arm has joints (`table_for`). Raises ParameterError for an invalid value and for a name that is not in
    the table.
    """
    table = table_for(table, given)
    names = {param.name for param in table}
    prefixes = (ROS_QOS_PREFIX, f"{free_prefix}.") if free_prefix else (ROS_QOS_PREFIX,)
    for name, value in given.items():
        if name not in names and name not in ROS_PARAMETERS and not name.startswith(prefixes):
            if name in GONE:
                written = ", ".join(f"{new}: {plain}" for new, plain in in_force(name, value).items())
                raise ParameterError(name, value, f"written in other parameters: {written}")
            raise ParameterError(name, value, f"one of {', '.join(sorted(names))}")
    return {param.name: param.check(given.get(param.name, param.omitted)) for param in table}


# Shared by several nodes.
# fmt: off
JOINT_NAMES = Param(
    "joint_names",
    ["right_shoulder_rotation", "right_shoulder_abduction", "right_shoulder_flexion", "right_elbow_flexion"],
    "the joints from the shoulder on, as in joint_states", fixed=True)
REAL_TIME_PARAMETERS = (
    Param("thread_priority", 0,
          "above 0: SCHED_FIFO priority of the control loop, and locked memory, where permitted", (0, 99),
          fixed=True, expert=True),
)
# fmt: on


@cache
def installed(group: str) -> Mapping[str, Any]:
    """Return the entry points of a group by name, looked up once."""
    from importlib.metadata import entry_points  # slow to import

    return {entry.name: entry for entry in entry_points(group=group)}


def loaded(group: str, name: str, what: str, kind: type = object) -> Any:
    """Return what the entry point `name` leads to, which must be a `kind`.

    Raises KeyError, and ParameterError that says why `what` cannot be used.
    """
    entry = installed(group)[name]
    try:
        if not isinstance(found := entry.load(), kind):
            raise TypeError(f"it is no {kind.__name__}")
        return found
    except Exception as error:  # the code of others
        expected = f"a {what} that can be loaded: {entry.value} of {group} ({error})"
        raise ParameterError(what, name, expected) from error


class OpenChoices(tuple[str, ...]):
    """The choices of a parameter to which the entry points of `group` add others."""

    group = ""

    def __contains__(self, name: object) -> bool:
        """Return whether `name` is one of them, or a distribution has it."""
        return super().__contains__(name) or name in installed(self.group)
