"""Parameters: a table of them for each node, and how a value given is checked against it.

What a table does not know is refused: a misspelt safety limit must not be a silent default. What values mean together
is checked where they become a frozen dataclass.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.errors import ParameterError

# Every node's, declared by ROS itself; `ros2 param dump` writes them, too.
OF_ROS = ("use_sim_time", "start_type_description_service")
QOS_OF_ROS = "qos_overrides."
KINDS = {float: "number", int: "whole number", str: "text", bool: "true or false"}


@dataclass(frozen=True)
class Param:
    """One parameter. `default` also says its type; an empty `required` list or string must be given by the user.

    bounds: lowest and highest value, of the number or of each number of a list. fixed: set at start, then read-only.
    """

    name: str
    default: Any
    description: str
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    required: bool = False

    def check(self, value: Any) -> Any:
        """Return `value` in this parameter's type, or raise ParameterError: whole numbers count as floats."""
        listed = isinstance(value, Sequence) and not isinstance(value, str)
        items, wanted = list(value) if listed else [value], type(self.default)
        if wanted is list:
            wanted = type(self.default[0]) if self.default else str
            # A list of four is a list of the four joints.
            if not listed or len(items) != len(self.default or items):
                raise ParameterError(self.name, value, self.expected)
        elif listed:
            raise ParameterError(self.name, value, self.expected)
        if wanted is float:
            items = [float(item) if type(item) is int else item for item in items]
        if self.required and not (items and all(item != "" for item in items)):
            raise ParameterError(self.name, value, f"given: {self.expected}")
        low, high = self.bounds or (None, None)
        if (
            any(type(item) is not wanted for item in items)
            or (low is not None and not all(low <= item <= high for item in items))
            or (self.choices and not all(item in self.choices for item in items))
        ):
            raise ParameterError(self.name, value, self.expected)
        return items if isinstance(self.default, list) else items[0]

    @property
    def expected(self) -> str:
        """What would be right, in words."""
        if isinstance(self.default, list):
            kind = KINDS[type(self.default[0]) if self.default else str]
            text = f"{len(self.default)} {kind}s" if self.default else f"a list of {kind}s"
        else:
            kind = KINDS[type(self.default)]
            text = kind if isinstance(self.default, bool) else f"a {kind}"
        if self.choices:
            return f"{text}, one of {', '.join(self.choices)}"
        return f"{text} from {self.bounds[0]:g} to {self.bounds[1]:g}" if self.bounds else text


def values_of(table: Sequence[Param], given: Mapping[str, Any], free_prefix: str = "") -> dict[str, Any]:
    """Return every value of the table by name: the one given, or the default.

    Names that start with `free_prefix`, and those of ROS itself, are left out. Raises ParameterError for a value that a
    parameter refuses, and for a name that the table does not have.
    """
    names = {param.name for param in table}
    for name, value in given.items():
        free = name in OF_ROS or name.startswith((QOS_OF_ROS, free_prefix or QOS_OF_ROS))
        if name not in names and not free:
            raise ParameterError(name, value, f"one of {', '.join(sorted(names))}")
    return {param.name: param.check(given.get(param.name, param.default)) for param in table}
