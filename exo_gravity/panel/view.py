"""The parameters of `panel`, those of other nodes that its page may change, and what the page shows of the arms."""

import math
from collections.abc import Mapping, Sequence
from itertools import chain, repeat, zip_longest
from typing import Any

from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.motors.joint_motor import SIMULATED_BUSES
from exo_gravity.core.params import Param
from exo_gravity.core.view.urdf import described, urdf

# fmt: off
PANEL = (
    Param("host", "127.0.0.1", "address of the page; other than loopback only with a token", fixed=True),
    Param("port", 8080, "TCP port of the page", (1, 65535), fixed=True),
    Param("token", "", "secret that opens the page; empty: none on loopback, elsewhere a random one in the log",
          fixed=True),
    Param("dead_man", False, "let the arms down when the page that holds control has been gone for 1 s", fixed=True),
    Param("language", "auto", "language of the page until its user chooses another; auto: the browser's",
          choices=("auto", "en", "de"), fixed=True),
    Param("trials", "", "folder with trial scripts; empty: those of the package", fixed=True),
    Param("output", "recordings", "folder for recordings, trials and saved parameters", fixed=True),
)
# fmt: on
# What the page may change on a compensator. Every limit stays with the compensator and the bridge.
SETTABLE = {
    param.name: param
    for param in COMPENSATOR
    if param.name in ("support", "mode", "wearer.body_mass", "wearer.sex", "wearer.segment_length")
}

Values = Mapping[str, Any]
NUMBERS = ("position", "velocity", "effort")


def joint_rows(
    names: Sequence[str], position: Sequence[float], velocity: Sequence[float], effort: Sequence[float]
) -> list[dict[str, Any]]:
    """Return name, angle in rad, speed in rad/s and torque in Nm of each joint; None for a number that is not known."""
    rows = zip_longest(position, velocity, effort, fillvalue=math.nan)
    known = ([round(x, 4) if math.isfinite(x) else None for x in row] for row in chain(rows, repeat((math.nan,) * 3)))
    return [{"name": name, **dict(zip(NUMBERS, row, strict=True))} for name, row in zip(names, known, strict=False)]


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
        "simulated": bridge.get("can.interface") in SIMULATED_BUSES,
    }
