"""Parameters: a table for each node, and the check of given values against it.

A name that is not in the table is an error, because a misspelt safety limit must not silently keep its default. If a
frozen dataclass uses a parameter, the dataclass owns its default, bounds, unit and description (`owned`) and the table
takes them from there (`param_of`). These dataclasses also check the rules that relate several values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import four_floats, one_float

# ROS declares these on every node, and `ros2 param dump` writes them to files.
ROS_PARAMETERS = ("use_sim_time", "start_type_description_service")
ROS_QOS_PREFIX = "qos_overrides."
KINDS = {float: "number", int: "whole number", str: "string", bool: "true or false"}
# Parameters that are gone, by the node that had them, and what replaces each.
GONE: dict[str, str] = {
    # can_bridge
    "max_effort_rate": "always 50 Nm/s; the compensator's own max_effort_rate may be lower",
    "max_temperature": "always 80 degC",
    "ramp_time": "always 1 s",
    "fade_time": "always 2 s",
    "damping": "always 5 Nm s/rad, the most that the motors can",
    "home": "always 0: joint angles are measured from the hanging arm, see the parameter zero",
    "home_tolerance": "always 0.5 rad for an AK60-6 and 0.34 rad for an AK80-9, less than half a turn of the rotor",
    "status_rate": "V3 boards are to send 500 status frames a second, 200 on a bus below 500 kbit/s",
    "lock_memory": "memory is locked where thread_priority is not 0",
    # compensator
    # imu
    # calibrator
    # simulator
}


@dataclass(frozen=True)
class Param:
    """One parameter. The type of `default` is the parameter's type.

    unit: '' for none. bounds: lowest and highest value, also for each number in a list. fixed: read-only while the
    node runs. required: the user must give a non-empty value. expert: only an expert changes it; the documents list it
    apart, and the panel does not show it.
    """

    name: str
    default: Any
    description: str
    bounds: tuple[float, float] | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    fixed: bool = False
    required: bool = False
    expert: bool = False

    def check(self, value: Any) -> Any:
        """Return `value` in this parameter's type; an integer is converted if the type is float.

        Raises ParameterError if the type, the length of a list or a value is wrong.
        """
        is_list = isinstance(value, Sequence) and not isinstance(value, str)
        items, kind = list(value) if is_list else [value], type(self.default)
        if kind is list:
            kind = type(self.default[0]) if self.default else str
            # A list with a default has one entry per joint, and keeps that length.
            if not is_list or len(items) != len(self.default or items):
                raise ParameterError(self.name, value, self.expected)
        elif is_list:
            raise ParameterError(self.name, value, self.expected)
        if kind is float:
            items = [float(item) if type(item) is int else item for item in items]
        if self.required and not (items and all(item != "" for item in items)):
            raise ParameterError(self.name, value, f"set to {self.expected}")
        if not all(self._allows(item, kind) for item in items):
            raise ParameterError(self.name, value, self.expected)
        return items if isinstance(self.default, list) else items[0]

    def _allows(self, item: Any, kind: type[Any]) -> bool:
        if type(item) is not kind or (self.choices and item not in self.choices):
            return False
        return self.bounds is None or self.bounds[0] <= item <= self.bounds[1]

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
        if isinstance(self.default, list):
            kind = KINDS[type(self.default[0]) if self.default else str]
            text = f"{len(self.default)} {kind}s" if self.default else f"a list of {kind}s"
        else:
            kind = KINDS[type(self.default)]
            text = kind if isinstance(self.default, bool) else f"a {kind}"
        return f"{text}{', ' if self.choices else ' '}{self.range}".rstrip()


def owned(
    default: Any,
    description: str,
    bounds: tuple[float, float] | None = None,
    unit: str = "",
    choices: tuple[str, ...] = (),
    expert: bool = False,
) -> Any:
    """Return a dataclass field that owns a parameter; a tuple as default makes it a list with one entry per joint."""
    plain = list(default) if isinstance(default, tuple) else default
    param = Param("", plain, description, bounds, unit, choices, expert=expert)
    return field(default=default, metadata={"param": param})


def param_of(owner: type, name: str, fixed: bool = False) -> Param:
    """Return the parameter that field `name` of the dataclass `owner` owns."""
    param: Param = next(f for f in fields(owner) if f.name == name).metadata["param"]
    return replace(param, name=name, fixed=fixed)


def params_of(owner: type, fixed: bool = False) -> tuple[Param, ...]:
    """Return all parameters that the dataclass `owner` owns, in the order of its fields."""
    return tuple(param_of(owner, f.name, fixed) for f in fields(owner) if "param" in f.metadata)


def check_owned(instance: Any) -> None:
    """Check every owned field of a frozen dataclass instance, and convert numbers to a float or a tuple of floats.

    Raises ParameterError that names the field.
    """
    for param in params_of(type(instance)):
        value = getattr(instance, param.name)
        if param.choices:
            if value not in param.choices:
                raise ParameterError(param.name, value, param.range)
        elif param.bounds and isinstance(param.default, list):
            checked = tuple(four_floats(param.name, value, *param.bounds, param.unit).tolist())
            object.__setattr__(instance, param.name, checked)
        elif param.bounds:
            object.__setattr__(instance, param.name, one_float(param.name, value, *param.bounds, param.unit))


def values_of(table: Sequence[Param], given: Mapping[str, Any], free_prefix: str = "") -> dict[str, Any]:
    """Return the value of every parameter of the table by name: the given value, or the default.

    Names that start with `free_prefix` and names that ROS declares are ignored. Raises ParameterError for an invalid
    value and for a name that is not in the table.
    """
    names = {param.name for param in table}
    prefixes = (ROS_QOS_PREFIX, free_prefix) if free_prefix else (ROS_QOS_PREFIX,)
    for name, value in given.items():
        if name not in names and name not in ROS_PARAMETERS and not name.startswith(prefixes):
            gone = f"left out, because it is gone: {GONE[name]}" if name in GONE else ""
            raise ParameterError(name, value, gone or f"one of {', '.join(sorted(names))}")
    return {param.name: param.check(given.get(param.name, param.default)) for param in table}


# Shared by several nodes.
JOINT_NAMES = Param(
    "joint_names",
    ["right_shoulder_rotation", "right_shoulder_abduction", "right_shoulder_flexion", "right_elbow_flexion"],
    "the four joints from the shoulder to the elbow, as in joint_states",
    fixed=True,
)
# fmt: off
REAL_TIME_PARAMETERS = (
    Param("thread_priority", 0, "SCHED_FIFO priority of the control loop's threads; 0 for none", (0, 99), fixed=True),
    Param("lock_memory", False, "lock the process's memory (mlockall) if permitted", fixed=True),
)
# fmt: on
