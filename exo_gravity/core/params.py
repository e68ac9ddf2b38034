"""Parameters: a table for each node, and the check of given values against it.

A name that is not in the table is an error, because a misspelt safety limit must not silently keep its default. A
parameter that a frozen dataclass uses is declared there (`owned`), with the rules that relate several values; the table
takes it from there (`param_of`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from exo_gravity.core.errors import ParameterError

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
    "max_velocity": "always 5, 5, 5, 6 rad/s",
    "reply_timeout": "always 0.05 s, or 7 cycles if that is longer",
    "torque_per_ampere": "always rated torque by rated current, as in the motors' data sheets",
    "status_rate": "V3 boards are to send 500 status frames a second, 200 on a bus below 500 kbit/s",
    # compensator
    "max_total_mass": "always 10 kg",
    "transition_time": "always 1 s; change `support` in small steps for a slower change",
    "wearer.table": "always de_leva; give wearer.mass and wearer.cog for other masses",
    "terms.max_effort": "always 2, 4, 2, 2 Nm",
    "terms.max_effort_rate": "always 50 Nm/s",
    "terms.ramp_time": "always 1 s",
    "inertia.rotor": "always that of the AK60-6 and AK80-9",
    "spring.max_effort": "always 1, 2, 1, 1 Nm",
    "spring.path_file": "spring.pose, which also takes a path: rows of the time in s and four angles",
    "coupling.leader": "coupling.stiffness, with an entry for each joint",
    "coupling.follower": "coupling.stiffness, whose largest entry is the follower's",
    "coupling.ratio": "coupling.stiffness: [0, -1, 2, 0] pulls joint 3 to half the angle of joint 2",
    "coupling.offset": "always 0 rad",
    "coupling.max_effort": "always 1 Nm",
    "limits.stiffness": "limits.range; the stiffness is 10 Nm/rad, or 0.8 of what is stable if that is less",
    "limits.lower": "limits.range, lower and upper edge of each joint in turn",
    "limits.upper": "limits.range, lower and upper edge of each joint in turn",
    "limits.max_effort": "always 1, 2, 1, 1 Nm",
    "assist.max_effort_rate": "always 10 Nm/s",
    "friction.coulomb": "the first four entries of friction.identified",
    "friction.viscous": "the last four entries of friction.identified",
    "inertial": "inertial.shoulder_from_imu, which switches it on",
    "shoulder_from_imu": "inertial.shoulder_from_imu, which also compensates the trunk's acceleration",
    "robot.first_moment": "the first four entries of robot.moments",
    "robot.off_axis": "the last four entries of robot.moments",
    "multi_array.fade_time": "always 2 s",
    "lock_memory": "thread_priority, which also locks the memory where it is above 0",
}


@dataclass(frozen=True)
class Param:
    """One parameter. The type of `default` is the parameter's type."""

    name: str
    default: Any
    description: str
    bounds: tuple[float, float] | None = None  #: lowest and highest value, also for each number in a list
    unit: str = ""
    choices: tuple[str, ...] = ()
    fixed: bool = False  #: read-only while the node runs
    required: bool = False  #: the user must give a non-empty value
    expert: bool = False  #: only an expert changes it; the documents list it apart, and the panel does not show it
    #: a list may have another length than its default; otherwise it has one entry per joint, and keeps its length
    any_length: bool = False

    def check(self, value: Any) -> Any:
        """Return `value` in this parameter's type; other numbers are converted if the type is float.

        Raises ParameterError if the type, the length of a list or a value is wrong.
        """
        is_list = isinstance(value, Sequence) and not isinstance(value, str)
        items: list[Any] = list(value) if is_list else [value]
        kind, count = self._kind_and_count
        if kind is float:
            items = [float(x) if isinstance(x, int | float) and type(x) is not bool else x for x in items]
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
            text = f"{count or 'a list of'} {KINDS[kind]}s"
        return f"{text}{', ' if self.choices else ' '}{self.range}".rstrip()


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


def check_owned(instance: Any) -> None:
    """Check every owned field of a frozen dataclass instance, and convert its numbers; a list becomes a tuple.

    Raises ParameterError that names the field.
    """
    for param in params_of(type(instance)):
        value = getattr(instance, param.name)
        plain = value.tolist() if isinstance(value, np.ndarray) else value
        checked = param.check(plain)
        object.__setattr__(instance, param.name, tuple(checked) if isinstance(checked, list) else checked)


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
# fmt: off
JOINT_NAMES = Param(
    "joint_names",
    ["right_shoulder_rotation", "right_shoulder_abduction", "right_shoulder_flexion", "right_elbow_flexion"],
    "the four joints from the shoulder to the elbow, as in joint_states", fixed=True)
REAL_TIME_PARAMETERS = (
    Param("thread_priority", 0,
          "above 0: SCHED_FIFO priority of the control loop's threads, and locked memory, where permitted", (0, 99),
          fixed=True, expert=True),
)
# fmt: on
