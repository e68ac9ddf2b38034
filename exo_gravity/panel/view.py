# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameters of `panel`, those of other nodes that its page may change, and what the page shows of the arms."""

import math
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from typing import Any

from exo_gravity.core.compensation.guidance import CAUSE_TIME
from exo_gravity.core.compensation.settings import COMPENSATOR, URDF, WORN_MOMENTS
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.params import Param
from exo_gravity.lab.source import source_of
from exo_gravity.lab.view import described, urdf

# fmt: off
PANEL = (
    Param("host", "127.0.0.1", "address of the page; other than loopback only with a token", fixed=True),
    Param("port", 8080, "TCP port of the page", (1, 65535), fixed=True),
    Param("token", "", "secret that opens the page; empty: random beyond loopback, in the log",
          fixed=True),
    Param("dead_man", False, "let the arms down when the page that holds control has been gone for 1 s", fixed=True),
    Param("language", "auto", "language of the page until its user chooses another; auto: the browser's",
          choices=("auto", "en", "de"), fixed=True),
    Param("trials", "", "folder with trial scripts; empty: those of the package", fixed=True),
    Param("markers", ["begin", "end", "rest", "fatigue", "pain", "artefact"], "texts of the buttons that set a marker",
          any_length=True, fixed=True),
    Param("output", "recordings", "folder for recordings, trials and saved parameters", fixed=True),
)
# fmt: on
# What the page may change on a compensator. Every limit stays with the compensator and the bridge.
# Found by `calibrate wearer`: the page withdraws them with another wearer's data.
CALIBRATED = ("wearer.first_moment", "wearer.off_axis", *WORN_MOMENTS, "wearer.joint_stiffness")
LOAD = ("mode", "wearer.body_mass", "wearer.sex", "wearer.segment_length", *CALIBRATED, "support", "payload.mass")
SETTABLE = {param.name: param for param in (*COMPENSATOR, *URDF) if param.name in LOAD}
# What belongs to a subject: in the wearer's file, and set by the page together with the wearer's data.
OF_SUBJECT = {p.name: p for p in COMPENSATOR if p.name in (*LOAD[1:4], "limits.lower", "limits.upper")}

Values = Mapping[str, Any]
FIELDS = ("position", "velocity", "effort")
NEWS_DELAY = 1.5  # s after a fault in which the panel may still learn of a change that came before it


def joint_rows(states: Any) -> list[dict[str, Any]]:
    """Return name, angle in rad, speed in rad/s and torque in Nm of each joint; None for a number that is not known.

    states: a sensor_msgs/JointState.
    """

    def known(values: Sequence[float], n: int) -> float | None:
        return round(values[n], 4) if n < len(values) and math.isfinite(values[n]) else None

    joints = enumerate(states.name)
    return [{"name": name, **{field: known(getattr(states, field), n) for field in FIELDS}} for n, name in joints]


def setup_of(nodes: Mapping[str, tuple[Values, Values]]) -> dict[str, Any]:
    """Return limits and settings of every arm, and the picture's URDF, None if it is not known.

    nodes: the parameters of `can_bridge` and `compensator` by arm, {} while they are not known.
    """
    try:
        picture = urdf([described(*both[::-1]) for both in nodes.values() if all(both)])
    except (ExoGravityError, KeyError):
        picture = None
    return {"arms": {arm: _arm_setup(*both) for arm, both in nodes.items()}, "urdf": picture}


class LoadChanges:
    """Names the change of load that came shortly before an arm's fault, and may be its cause."""

    def __init__(self) -> None:
        # By arm: each load that it had lately, and monotonic s at which that was last in force; the present one is last
        self._loads: dict[str, deque[tuple[Values, float]]] = defaultdict(deque)
        self._faults: dict[str, float] = {}  # monotonic s at which the present one was seen first

    def with_causes(
        self, arms: Mapping[str, Any], nodes: Mapping[str, tuple[Values, Values]], now: float
    ) -> dict[str, Any]:
        """Return the states of `arms`, each with the `cause` of its fault or None. Call it with each new state.

        nodes: the parameters of `can_bridge` and `compensator` by arm.
        now: monotonic s.
        """
        return {arm: {**state, "cause": self._cause(arm, state, nodes[arm][1], now)} for arm, state in arms.items()}

    def _cause(self, arm: str, state: Mapping[str, Any], compensator: Values, now: float) -> dict[str, Any] | None:
        loads, is_faulty = self._loads[arm], (state["bridge"] or {}).get("fault", "none") != "none"
        if not is_faulty:
            self._faults.pop(arm, None)
        began = self._faults.setdefault(arm, now) if is_faulty else now
        if compensator and now - began <= NEWS_DELAY:
            load = {name: compensator.get(name) for name in LOAD}
            if loads and loads[-1][0] == load:
                loads.pop()
            loads.append((load, now))
            if not is_faulty and (state["compensator"] or {}).get("changing load", "none") != "none":
                loads[0] = loads[0][0], now  # the old load still acts
            while began - loads[0][1] > CAUSE_TIME:
                loads.popleft()
        return difference(loads[0][0], loads[-1][0]) if is_faulty and loads else None


def difference(before: Values, load: Values) -> dict[str, Any] | None:
    """Return how `load` differs from the load before, None if it does not; of the wearer's data, only that they do."""
    acting = LOAD if load["mode"] == "zero_g" else ("mode", "payload.mass")
    name = next((name for name in acting if load[name] != before[name]), "")
    what = name.partition(".")[0]
    if what in ("", "wearer"):
        return {"what": what} if what else None
    return {"what": what, "from": before[name], "to": load[name]}


def _arm_setup(bridge: Values, compensator: Values) -> dict[str, Any]:
    efforts = [values["max_effort"] for values in (bridge, compensator) if values.get("max_effort")]
    # With a URDF, 0 of the compensator stands for the limit in it.
    # Nodes of arms with different joints, which do not work together, may be in one namespace.
    given = [[limit for limit in column if limit > 0.0] for column in zip(*efforts, strict=False)]
    return {
        "max_effort": [min(column, default=None) for column in given] if given else None,
        "settings": {name: compensator.get(name) for name in SETTABLE},
        "source": source_of(bridge, False).value,
    }
