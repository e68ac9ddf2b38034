"""The nodes of a parameter file as processes: which ones to start, and in which order to stop them.

`launcher` and `launch/exo.launch.py` share this. Bridges stop first: while they let the arms down they need the others.
The recorder stops last.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.tools.inputs.parameter_file import Loader, Nodes

DESCENT_TIMEOUT = 40.0  # s for a bridge to let its arm down, after which it is killed
WATCHDOG_TIMEOUT = 30.0  # s for the watchdog of a dead bridge to let the arm down
RECOVERY_TIMEOUT = WATCHDOG_TIMEOUT + DESCENT_TIMEOUT
STOP_TIMEOUT = 5.0  # s for any other node to end
SUPERVISED = {"EXO_GRAVITY_SUPERVISED": "1", "PYTHONUNBUFFERED": "1"}  # a node then ends with its standard input
# Starts can_bridge for one purpose: to let down an arm that was left behind, after that time for its watchdog.
RECOVERY = {"EXO_GRAVITY_RECOVER": f"{WATCHDOG_TIMEOUT:g}"}
ENDED_WELL = (0, 2)  # exit codes of a node that ended by itself: stopped, or with wrong parameters or no bus
OBSERVERS = ("/recorder", "/robot_model", "/panel")
ABSOLUTE_TOPICS = ("/imu/data", "/imu/data_raw", "/imu/pitch_yaw")  # those that a namespace must be added to


class Stages(NamedTuple):
    """Names of nodes, in the order in which they stop."""

    bridges: list[str]
    others: list[str]
    recorders: list[str]

    @classmethod
    def of(cls, nodes: Iterable[str]) -> Stages:
        """Return the stages of `nodes`, full names."""
        names = list(nodes)
        bridges = [node for node in names if node.endswith("/can_bridge")]
        recorders = [node for node in names if node.endswith("/recorder")]
        return cls(bridges, [node for node in names if node not in (*bridges, *recorders)], recorders)


def is_observer(node: str) -> bool:
    """Return whether `node` may end alone: the arm does not depend on it, and a full disk must not let the arm down."""
    return node.endswith(OBSERVERS)


def chosen(nodes: Iterable[str], only: Sequence[str]) -> list[str]:
    """Return the `nodes` that match one of the shell patterns `only`; without patterns, all.

    A pattern is compared with the full name: `/right/*`, `*/compensator`. Raises ParameterError if one matches no node.
    """
    names = list(nodes)
    for pattern in only:
        if not any(fnmatchcase(node, pattern) for node in names):
            raise ParameterError("only", pattern, f"a pattern that matches one of {', '.join(names)}")
    return [node for node in names if not only or any(fnmatchcase(node, pattern) for pattern in only)]


def check_buses(nodes: Nodes) -> None:
    """Raise ParameterError if two bridges would command motors on the same bus, which has one owner."""
    owner: dict[tuple[tuple[str, str], ...], str] = {}
    for node in Stages.of(nodes).bridges:
        bus = tuple(sorted((k, str(v)) for k, v in nodes[node].items() if k.startswith("can.")))
        other = owner.setdefault(bus, node)
        if other != node:
            raise ParameterError(f"{node} can", dict(bus), f"different from the bus of {other}: one arm per bus")


def in_namespace(params: Path, namespace: str) -> Path:
    """Return a parameter file whose nodes are in `namespace` ('/lab'): `params` itself if that is ''."""
    if not namespace:
        return params
    content = yaml.load(params.read_text(encoding="utf-8"), Loader)
    path = Path(tempfile.mkdtemp(prefix="exo_gravity_"), params.name)
    path.write_text(yaml.safe_dump({f"{namespace}{node}": entry for node, entry in content.items()}), encoding="utf-8")
    return path
