"""What the page shows: the state of an arm, ten times a second; its limits and settings; the arms' URDF."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.view.arm_description import described
from exo_gravity.core.view.urdf import urdf
from exo_gravity.panel.params import SETTABLE

Values = Mapping[str, Any]
SILENT = 1.5  # s without diagnostics or joint states after which the last ones are not shown any more
OF_BRIDGE = {
    "state": "state",
    "fault": "fault",
    "limits": "limits acting",
    "rate": "rate (Hz)",
    "answered": "age of efforts (ms)",
}


@dataclass
class Joints:
    """The newest message with joint values."""

    time: float = -math.inf  #: monotonic s of its arrival
    names: Sequence[str] = ()
    position: Sequence[float] = ()
    effort: Sequence[float] = ()


@dataclass
class Status:
    """The newest diagnostics of one node."""

    level: int = 0  #: 0 OK, 1 warning, 2 error
    message: str = ""
    values: Mapping[str, str] = field(default_factory=dict)
    time: float = -math.inf  #: monotonic s of its arrival


def arm_state(now: float, joints: Joints, bridge: Status, compensator: Status) -> dict[str, Any]:
    """Return the state of one arm for the page; None in the place of what is old."""
    state: dict[str, Any] = {"bridge": None, "compensator": None, "joints": None}
    if now - bridge.time < SILENT:
        values = {key: bridge.values.get(name, "") for key, name in OF_BRIDGE.items()}
        state["bridge"] = {"level": bridge.level, "message": bridge.message, **values}
    if now - compensator.time < SILENT:
        carried = compensator.values.get("mass carried (kg)")
        shown = {"mass_carried": carried, "largest_support": _number(compensator.values.get("largest support"))}
        state["compensator"] = {"level": compensator.level, "message": compensator.message, **shown}
    if now - joints.time < SILENT:
        state["joints"] = [
            {
                "name": name,
                "position": _rounded(joints.position, n),
                "effort": _rounded(joints.effort, n),
                "temperature": _number(bridge.values.get(f"{name} temperature (degC)")) if state["bridge"] else None,
            }
            for n, name in enumerate(joints.names)
        ]
    return state


def _rounded(values: Sequence[float], index: int) -> float | None:
    return round(values[index], 4) if index < len(values) and math.isfinite(values[index]) else None


def _number(text: str | None) -> float | None:
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


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
