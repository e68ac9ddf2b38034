# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The script of a trial: a list of timed steps for the wearer, as `docs/trials.md` lists them.

A human wearer reads the steps from the screen; the simulator's virtual wearer executes them.
"""

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from exo_gravity.core.arm.interface import MAX_PAYLOAD
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import MAX_JOINTS, floats, one_float

MAX_DURATION = 3600.0  # s
NAME = re.compile(r"\w[^/\x00-\x1f\x7f]{0,99}")
TIMED = {"hold": 0.1, "walk": 2.0, "sit": 1.0}  # steps that have only a duration, and the shortest of each in s


def _one_per_joint(name: str, values: Any, low: float, high: float, unit: str) -> np.ndarray:
    """Return `values` as an array (n,); `TrialScript.check` compares n with an arm."""
    count = len(values) if isinstance(values, list | tuple) and 1 <= len(values) <= MAX_JOINTS else 1
    return floats(name, values, count, low, high, unit)


# Steps with one number, or one per joint: how these are checked, the least, the largest, and their unit.
VALUED: dict[str, tuple[Callable[..., Any], float, float, str]] = {
    "move": (_one_per_joint, -3.5, 3.5, "rad"),
    "push": (_one_per_joint, -20.0, 20.0, "Nm"),
    "bow": (one_float, -1.6, 1.6, "rad"),
    "lean": (one_float, -0.8, 0.8, "rad"),
    "load": (one_float, 0.0, MAX_PAYLOAD, "kg"),
}
PER_JOINT = ("move", "push")
TRUNK_ACTIONS = ("bow", "lean", "walk", "sit")


@dataclass(frozen=True)
class Step:
    """One step: an `action` and its `value`.

    'move': the pose (n,) in rad; 'push': the torque (n,) in Nm; 'bow', 'lean': the angle (1,) in rad; 'load': the mass
    (1,) in kg; 'hold', 'walk', 'sit': ().
    """

    action: str
    duration: float
    value: tuple[float, ...] = ()

    @classmethod
    def parse(cls, entry: Any, where: str) -> "Step":
        """Return the step described by a mapping from YAML; `where` is its name in a ParameterError."""
        keys = set(entry) if isinstance(entry, Mapping) else set()
        action = next(iter(keys - {"over"}), "")
        name = f"{where}.{action}"
        if action in TIMED and keys == {action}:
            return cls(action, one_float(name, entry[action], TIMED[action], MAX_DURATION, "s"))
        if action in VALUED and keys == {action, "over"}:
            checked, low, high, unit = VALUED[action]
            value = np.ravel(checked(name, entry[action], low, high, unit)).tolist()
            return cls(action, one_float(f"{where}.over", entry["over"], 0.1, 60.0, "s"), tuple(value))
        expected = (
            "{move: [rad per joint], over: s}, {hold: s}, {push: [Nm per joint], over: s}, {bow: rad, over: s}, "
            "{lean: rad, over: s}, {walk: s}, {sit: s} or {load: kg, over: s}"
        )
        raise ParameterError(where, entry, expected)


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which YAML's own loader takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for key, times in keys.most_common(1):
            if times > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)


@dataclass(frozen=True)
class TrialScript:
    """A named list of steps."""

    name: str
    steps: tuple[Step, ...]

    @classmethod
    def read(cls, path: str | Path) -> "TrialScript":
        """Return the script in a YAML file. Raises ParameterError."""
        try:
            content = yaml.load(Path(path).read_text(encoding="utf-8"), _Loader)
        except (OSError, yaml.YAMLError, ValueError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise ParameterError("trial", str(path), f"a readable YAML file ({reason})") from None
        return cls.parse(content)

    @classmethod
    def parse(cls, content: Any) -> "TrialScript":
        """Return the script described by YAML content. Raises ParameterError that names the invalid entry."""
        if not isinstance(content, Mapping) or set(content) != {"name", "steps"}:
            raise ParameterError("script", content, "a mapping with the keys name and steps only")
        name, steps = str(content["name"] or ""), content["steps"]
        if not NAME.fullmatch(name):  # of the trial's folder
            raise ParameterError("name", name, "1 to 100 characters without / and line breaks, a letter or digit first")
        if not isinstance(steps, list) or not steps:
            raise ParameterError("steps", steps, "a list of at least one step")
        script = cls(name, tuple(Step.parse(entry, f"steps[{i}]") for i, entry in enumerate(steps)))
        script.check(next((len(step.value) for step in script.steps if step.action in PER_JOINT), 0))
        return script

    def check(self, count: int) -> None:
        """Raise ParameterError unless the script is for an arm of `count` joints."""
        for i, step in enumerate(self.steps):
            if step.action in PER_JOINT and len(step.value) != count:
                raise ParameterError(f"steps[{i}].{step.action}", list(step.value), f"{count} numbers, one per joint")

    @property
    def duration(self) -> float:
        """Total length of all steps in s."""
        return sum(step.duration for step in self.steps)

    def at(self, elapsed: float) -> tuple[int, float]:
        """Return the index of the active step `elapsed` s after the start, and the time since that step began.

        After the last step the index is len(steps).
        """
        index = bisect_right(self._ends, elapsed)
        return index, elapsed - (self._ends[index - 1] if index else 0.0)

    @cached_property
    def _ends(self) -> tuple[float, ...]:
        return tuple(accumulate(step.duration for step in self.steps))


IDLE = TrialScript("nothing", ())  #: its wearer leaves the arm alone
