# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Writes the tables of the documents from the declarations in the code.

`python docs/tables.py` renews them. With `--check` it changes nothing, names each table that differs, and exits with 1.
A table stands between the lines `<!-- table: NAME -->` and `<!-- end of table -->`. Needs the extra `sim`, not ROS.
"""

from __future__ import annotations

import argparse
import json
import re
import runpy
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from exo_gravity.core.compensation.settings import COMPENSATOR, compensator_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import OURS
from exo_gravity.core.motors.frames import MotorSpec, WireFormat
from exo_gravity.core.params import Param
from exo_gravity.core.safety.command import FaultCode
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.core.trunk.checks import IMU
from exo_gravity.lab.bag.content import RECORDER
from exo_gravity.lab.view import ROBOT_MODEL
from exo_gravity.panel.control import PANEL
from exo_gravity.sim.params import SIMULATOR

DOCS = Path(__file__).parent
POLICY = DOCS.parent / "config" / "sros2" / "policy.py"  # a test compares it with the running nodes
TOPICS = DOCS / "topics.md"
EVERY_NODES = {"/parameter_events", "/rosout"}
STRINGS = DOCS.parent / "exo_gravity" / "panel" / "strings.json"
#: States on the operator's card, in the order of a session.
CARD = (
    *("disabled", "checking", "pose", "proving signs", "ramping in", "active"),
    *("moving", "sinking", "letting down", "fault", "silent", "unseen"),
)
COMMAND = "python docs/tables.py"
OF_URDF = compensator_table({"law": "urdf", "joint_names": ["joint"], "command_interface": "joint_state"})
OF_PAPER = [param.for_joints(1) for param in COMPENSATOR]
PARAMETERS = {
    "can_bridge": CAN_BRIDGE,
    "compensator": COMPENSATOR,
    "urdf_arm": [param for param in OF_URDF if param not in OF_PAPER],
    "imu": IMU,
    "simulator": SIMULATOR,
    "recorder": RECORDER,
    "robot_model": ROBOT_MODEL,
    "panel": PANEL,
}
BASES = ("can_bridge", "compensator")
# Their tables name the parameters that they share with one of BASES, and leave them out.
REPEATING = ("compensator", "simulator", "urdf_arm")
RANGES = ("position_range", "velocity_range", "torque_range")
MOTOR_HEAD = (
    "`motor`",
    "`wire_format`",
    "on the wire: rad, rad/s, Nm",
    "rated, peak Nm",
    "rated, no-load rad/s",
    "gear, encoder",
    "rotor kg m²",
)
TABLE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def parameter_table(node: str) -> str:
    """Return the Markdown lists of one node's parameters: the usual ones, then the names of those for experts."""
    bases = [base for base in BASES if base != node]
    shared: dict[str, list[Param]] = defaultdict(list)
    own = []
    for param in PARAMETERS[node]:
        same = _plays if node == "simulator" else _same
        base = next((base for base in bases if any(same(param, other) for other in PARAMETERS[base])), None)
        if base and node in REPEATING:
            shared[base].append(param)
        else:
            own.append(param)
    whose = "true values of" if node == "simulator" else "as of"
    as_in = "; ".join(f"{whose} `{base}`: {_runs(params, PARAMETERS[node])}" for base, params in shared.items())
    rare = [
        p for p in own if (p.fixed if node == "simulator" else p.expert)
    ]  # those of the simulated arm that are live
    usual, expert = [p for p in own if p not in rare], rare
    before = (f"{as_in[0].upper()}{as_in[1:]}.\n\n" if as_in else "") + _live_ones(PARAMETERS[node])
    text = before + _parameter_items(usual, with_range=node != "simulator")
    names = ", ".join(f"`{param.name}`" for param in expert)
    return f"{text}\nFurther ones, which `ros2 param describe` explains: {names}.\n" if expert else text


def _runs(params: Sequence[Param], table: Sequence[Param]) -> str:
    """Return the names of these parameters; of three or more that follow each other in the table the first and last."""
    numbers = [index for index, param in enumerate(table) if param in params]
    runs = [[index for _, index in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    names = [[f"`{table[index].name}`" for index in run] for run in runs]
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(run) for run in names)


def _live_ones(params: Sequence[Param]) -> str:
    """Return a sentence that says which parameters a running node accepts; '' where it accepts none."""
    live, fixed = ([p for p in params if p.fixed is wanted] for wanted in (False, True))
    if not live:
        return ""
    few, what = (fixed, "All but these are live") if len(fixed) < len(live) else (live, "Live")
    return f"{what}: {_runs(few, params)}.\n\n" if few else "All are live.\n\n"


def _parameter_items(params: Sequence[Param], with_range: bool) -> str:
    """Return a Markdown list, with one item for the components x, y and z of a vector."""
    items = []
    for _, group in groupby(params, lambda param: re.sub("_[xyz]$", "_", param.name)):
        first, *others = group
        names = ", ".join(f"`{param.name}`" for param in (first, *others))
        axes = ", ".join(rf"{param.name[-1]}\2" for param in (first, *others))
        meaning = (
            re.sub(r"\b(along|about) [xyz](_n)?\b", rf"\1 {axes}", first.description) if others else first.description
        )
        permitted = _range(first) if with_range or first.choices else ""
        value = " ".join(filter(None, (_default(first), permitted)))
        items.append(f"- {names}, {value}: {meaning}\n")
    return "".join(items)


def _same(param: Param, other: Param) -> bool:
    """Whether two nodes' parameters are the same to their user, except for when they may change, and on another arm."""
    return replace(param, fixed=other.fixed, expert=other.expert, vector=other.vector) == other


def _plays(param: Param, other: Param) -> bool:
    """Whether the simulated arm has a parameter of the real one: its true value."""
    return param.name == other.name


def fault_list() -> str:
    """Return the Markdown list of the fault codes."""
    return "".join(f"- `{code}`: {code.meaning}\n" for code in FaultCode)


def motor_table() -> str:
    """Return the Markdown table of our motors; what no source states is marked."""
    rows = []
    for family in OURS:
        for spec in family.motors.values():
            star = {name: "*" if name in spec.assumed else "" for name in MotorSpec.__dataclass_fields__}
            speeds = (f"{getattr(spec, name):.3g}{star[name]}" for name in ("rated_speed", "no_load_speed"))
            on_wire = (f"{getattr(spec, name):g}{star[name]}" for name in RANGES)
            formats = [name for name, board in family.formats.items() if _has_ranges(board, spec)]
            encoder = "output" if spec.output_encoder else "rotor"
            rows.append(
                (
                    f"`{spec.name}`",
                    ", ".join(f"`{name}`" for name in formats) + (", FD" if spec.can_fd else ""),
                    ", ".join(on_wire),
                    f"{spec.rated_torque:g}, {spec.peak_torque:g}",
                    ", ".join(speeds),
                    f"{spec.gear_ratio:g}, {encoder}{star['output_encoder']}",
                    f"{spec.rotor_inertia:.2g}",
                )
            )
    return markdown(MOTOR_HEAD, rows)


def _has_ranges(board: WireFormat, spec: MotorSpec) -> bool:
    try:
        board.ranged(spec)
    except ParameterError:
        return False
    return True


def topic_list() -> str:
    """Return the Markdown list of each topic's publishers and subscribers, as the policy has them.

    Raises ValueError for a topic that docs/topics.md does not describe.
    """
    topics = runpy.run_path(str(POLICY))["TOPICS"]
    described = set(re.findall(r"^- `([\w/]+)`, \w+_msgs/", TOPICS.read_text(encoding="utf-8"), re.MULTILINE))
    if missing := topics.keys() - EVERY_NODES - described:
        raise ValueError(f"{TOPICS}: must describe {', '.join(sorted(missing))}")
    items = []
    for name in sorted(topics.keys() - EVERY_NODES, key=lambda name: (name.lstrip("/"), name)):
        ways = [", ".join(sorted(f"`{node.rpartition('/')[2]}`" for node in way)) or "any" for way in topics[name]]
        items.append(f"- `{name}`: {ways[0]} to {ways[1]}\n")
    return "".join(items)


def card_table(column: int) -> str:
    """Return the table of the operator's card from the page's texts: what it says, what that means, what to do.

    column: of the language in strings.json.
    """
    texts = defaultdict(lambda: ["", ""], json.loads(STRINGS.read_text(encoding="utf-8"))["texts"])
    words = {word: texts[f"state.{word}"] if f"state.{word}" in texts else texts[word] for word in CARD}
    keys = [(words[word], texts[f"sentence.{word}"], texts[f"todo.{word}"]) for word in CARD]
    return markdown(
        [texts[f"card.{part}"][column] for part in ("state", "why", "todo")],
        [[cell[column] for cell in row] for row in keys],
    )


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def renewed(text: str) -> str:
    """Return a document's text with every table as the code declares it. Raises KeyError for an unknown table."""
    tables = {node: parameter_table(node) for node in PARAMETERS} | {
        "faults": fault_list(),
        "motors": motor_table(),
        "topics": topic_list(),
        "card_en": card_table(0),
        "card_de": card_table(1),
    }
    return TABLE.sub(lambda found: f"{found[1]}\n{tables[found[2]]}\n{found[3]}", text)


def stale_tables(text: str) -> list[str]:
    """Return the names of the tables in a document that differ from the declarations."""
    pairs = zip(TABLE.finditer(text), TABLE.finditer(renewed(text)), strict=True)
    return [old[2] for old, new in pairs if old[0] != new[0]]


def _default(param: Param) -> str:
    if param.required:
        return "required"
    value = param.default
    each = isinstance(value, list) and len(value) > 1 and len(set(value)) == 1
    return " ".join(filter(None, (_shown(value[0] if each else value) or "empty", param.unit)))


def _range(param: Param) -> str:
    """Return the values other than the default that are permitted, in parentheses; '' if all of the type are."""
    if param.name == "motor":
        return "([motors](motors.md))"
    if others := [choice for choice in param.choices if choice not in _shown(param.default).split(", ")]:
        return f"(or {', '.join(others)})"
    return f"({param.bounds[0]:g}..{param.bounds[1]:g})" if param.bounds else ""


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_shown(item) for item in value)
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def main() -> None:
    """Renew or check the documents."""
    parser = argparse.ArgumentParser(description="Renew the tables in docs/ from the code's declarations.")
    parser.add_argument("--check", action="store_true", help="change nothing; exit with 1 if a table differs")
    parser.add_argument("documents", nargs="*", type=Path, default=sorted(DOCS.glob("*.md")), help="(docs/*.md)")
    options = parser.parse_args()
    stale = {path: stale_tables(path.read_text(encoding="utf-8")) for path in options.documents}
    for path, names in stale.items():
        if names and not options.check:
            path.write_text(renewed(path.read_text(encoding="utf-8")), encoding="utf-8")
        for name in names:
            print(f"{path}: table {name} {f'differs from the code; run {COMMAND}' if options.check else 'renewed'}")
    raise SystemExit(1 if options.check and any(stale.values()) else 0)


if __name__ == "__main__":
    main()
