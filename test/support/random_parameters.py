"""Random changes of the compensator's parameters, valid ones and invalid ones."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import Parameter

NUMBERS = ["support", "gravity", "wearer.body_mass", "max_effort_rate"]
LISTS = ["gain", "robot.mass", "robot.cog", "wearer.mass", "wearer.cog", "max_effort"]
CHOICES = ["law", "mode", "wearer.sex"]
READ_ONLY = ["side", "link_length", "joint_names", "use_imu"]


class Change(NamedTuple):
    """Parameters to be set in one request, and whether the node must refuse it."""

    values: dict[str, Any]
    invalid: bool


def random_changes(count: int, link_length: Sequence[float], seed: int = 5) -> Iterator[Change]:
    """Yield `count` changes; `link_length` (4,) m bounds the centres of gravity."""
    rng = random.Random(seed)
    for _ in range(count):
        values = _valid(rng, link_length)
        names = rng.sample(sorted(values), rng.choice([1, 1, 2, 4]))
        chosen = {name: values[name] for name in names}
        invalid = rng.random() < 0.5
        if invalid:
            name, value = rng.choice(_invalid(rng))
            chosen[name] = value
        yield Change(chosen, invalid)


def _valid(rng: random.Random, link_length: Sequence[float]) -> dict[str, Any]:
    """Return a random valid value of each parameter. A wearer may be too heavy all the same."""

    def four(low: float, high: float) -> list[float]:
        return [rng.uniform(low, high) for _ in range(4)]

    return {
        "law": rng.choice(["exact", "paper_static", "paper_mobile"]),
        "mode": rng.choice(["one_g", "zero_g"]),
        "support": rng.choice([0, 1, rng.random()]),
        "gain": four(0.0, 2.0),
        "gravity": rng.uniform(0.0, 20.0),
        "robot.mass": four(0.0, 1.0),
        "robot.cog": [rng.uniform(0.0, length) for length in link_length],
        "wearer.mass": [0.0, 0.0, *four(0.0, rng.choice([2.5, 9.0]))[2:]],
        "wearer.cog": [0.0, 0.0, *four(0.0, 0.3)[2:]],
        "wearer.body_mass": rng.uniform(40.0, 110.0),
        "wearer.sex": rng.choice(["female", "male"]),
        "max_effort": four(0.0, 18.0),
        "max_effort_rate": rng.choice([1, 50, rng.uniform(1.0, 50.0)]),
    }


def _invalid(rng: random.Random) -> list[tuple[str, Any]]:
    """Return invalid parameters of each kind."""
    return [
        (rng.choice(NUMBERS), rng.choice([-0.1, math.nan, math.inf, -math.inf, 1e6, "much", True, [0.5]])),
        (rng.choice(LISTS), rng.choice([[0.1] * 3, [0.1] * 5, [], 0.1, "heavy", [True] * 4, ["0.1"] * 4])),
        (rng.choice(LISTS), [0.1, 0.1, rng.choice([-1e-9, math.nan, math.inf, 900.0]), 0.1]),
        ("robot.cog", [0.0, 0.0, 0.31, 0.0]),  # outside the link
        (rng.choice(CHOICES), rng.choice(["", "newton", 1, []])),
        (rng.choice(READ_ONLY), "left"),
        (rng.choice(["suport", "", "robot", "robot.", "wearer.mass.0", "a" * 300]), 1.0),
        (rng.choice([*NUMBERS, *LISTS, "law"]), None),
        ("anfis_file", rng.choice(["/nowhere.json", "/", "\n"])),
        ("law", "anfis"),
    ]


def parameter_message(name: str, value: Any) -> ParameterMessage:
    """Return the message that sets a parameter, None to delete it."""
    if value == [] and type(value) is list:  # rclpy cannot infer its type
        return Parameter(name, Parameter.Type.DOUBLE_ARRAY, []).to_parameter_msg()
    return Parameter(name, value=value).to_parameter_msg()
