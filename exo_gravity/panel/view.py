"""What the page shows: the state of an arm, ten times a second; its limits and settings; the arms' URDF."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.view.urdf import described, urdf
from exo_gravity.panel.params import SETTABLE

Values = Mapping[str, Any]
SILENT = 1.5  # s without diagnostics or joint states after which the last ones are not shown any more


@dataclass(frozen=True)
class Newest:
    """The newest message of one kind, as the page gets it."""

    content: Any = None
    time: float = -math.inf  #: monotonic s of its arrival

    def at(self, now: float) -> Any:
        """Return the content; None if it is old."""
        return self.content if now - self.time < SILENT else None


def joint_rows(
    names: Sequence[str], position: Sequence[float], velocity: Sequence[float], effort: Sequence[float]
) -> list[dict[str, Any]]:
    """Return name, angle in rad, speed in rad/s and torque in Nm of each joint; None for a number that is not known."""

    def rounded(values: Sequence[float], index: int) -> float | None:
        return round(values[index], 4) if index < len(values) and math.isfinite(values[index]) else None

    columns = {"position": position, "velocity": velocity, "effort": effort}
    return [
        {"name": name, **{key: rounded(values, n) for key, values in columns.items()}} for n, name in enumerate(names)
    ]


def setup_of(nodes: Mapping[str, tuple[Values, Values]]) -> dict[str, Any]:
    """Return limits and settings of every arm, and the picture's URDF, None if it is not known.

    nodes: the parameters of `can_bridge` and `compensator` by arm, {} while they are not known.
    """
    try:
        picture = urdf([described(*both[::-1]) for both in nodes.values() if all(both)])
    except (ExoGravityError, KeyError):
        picture = None
    return {"arms": {arm: _arm_setup(*both) for arm, both in nodes.items()}, "urdf": picture}


def _arm_setup(bridge: Values, compensator: Values) -> dict[str, Any]:
    efforts = [values["max_effort"] for values in (bridge, compensator) if values.get("max_effort")]
    return {
        "max_effort": [min(column) for column in zip(*efforts, strict=True)] if efforts else None,
        "settings": {name: compensator.get(name) for name in SETTABLE},
    }
