# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Writes the tables of the documents from the declarations in the code.

`python docs/tables.py` renews them. With `--check` it changes nothing, names each table that differs, and exits with 1.
A table stands between the lines `<!-- table: NAME -->` and `<!-- end of table -->`. Needs the extra `sim`, not ROS.
"""

from __future__ import annotations

import argparse
import re
import runpy
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from exo_gravity.core.compensation.settings import COMPENSATOR, urdf_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT_V3
from exo_gravity.core.motors.families import OURS
from exo_gravity.core.motors.frames import MotorSpec, WireFormat
from exo_gravity.core.params import Param
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.core.trunk.params import IMU
from exo_gravity.lab.bag.content import RECORDER
from exo_gravity.lab.view.urdf import ROBOT_MODEL
from exo_gravity.panel.view import PANEL
from exo_gravity.sim.motors.firmware import FIRMWARES, FIRST_SPECIAL, SHUT_OFF_AT, WARM_ABOVE, Firmware
from exo_gravity.sim.params import SIMULATOR

DOCS = Path(__file__).parent
POLICY = DOCS.parent / "config" / "sros2" / "policy.py"  # a test compares it with the running nodes
TOPICS = DOCS / "topics.md"
EVERY_NODES = {"/parameter_events", "/rosout"}
COMMAND = "python docs/tables.py"
OF_URDF = urdf_table({"joint_names": ["joint"], "command_interface": "joint_state"})
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


def _is_v3(firmware: Firmware) -> bool:
    return firmware.wire_format == MIT_V3.name


def _enter(f: Firmware) -> str:
    if f.exit_clears:
        return "carries out a command that came while off; EXIT clears the last one"
    return "resumes the last command" + ("" if f.remembers_off else " of motor mode")


def _set_zero(f: Firmware) -> str:
    reply = f"no reply, silent for {f.zero_silence:g} s" if f.zero_silence else "replies at once"
    return reply + ("" if f.zero_while_on else "; ignored while on")


def _timeout(f: Firmware) -> str:
    return f"{1000.0 * f.timeout:g} ms" if f.timeout else "none"


def _reply(f: Firmware) -> str:
    if not _is_v3(f):
        sender = "the ID 0" if f.reply_to_master else "its own ID"
        return f"{f.reply_length} bytes with {sender}, within {1e6 * f.reply_delay[1]:.0f} us"
    return f"{f.status_rate:g} status frames a second" if f.reports else "none: silent until asked"


def _special(f: Firmware) -> str:
    return "FF x 7 and FC, FD, FE" if f.first_special == FIRST_SPECIAL else "FF x 7 and EE to FE: FB leaves the bus"


def _also_obeyed(f: Firmware) -> str:
    also = [
        "IDs with the same lowest 7 bits" if f.id_bits < 11 else "",
        "frames of 1 to 7 bytes" if f.shortest_command == 1 else "",
        "frames of 1 to 7 bytes and remote frames" if f.shortest_command == 0 else "",
        "ID 0xFF" if f.obeys_broadcast else "",
    ]
    return ", ".join(filter(None, also)) or "nothing"


# What docs/motors.md asks of a firmware, the fields that may be assumed, and the answer.
Question = tuple[str, tuple[str, ...], Callable[[Firmware], str]]
MIT_QUESTIONS: tuple[Question, ...] = (
    (
        "a command while off",
        ("remembers_off",),
        lambda f: "kept for ENTER; replies" if f.remembers_off else "ignored; replies",
    ),
    ("ENTER", ("remembers_off", "exit_clears"), _enter),
    ("SET_ZERO", ("zero_silence", "zero_while_on"), _set_zero),
    ("zero after a power cycle", ("zero_kept",), lambda f: "the new one" if f.zero_kept else "the old one"),
    (
        "error byte",
        (),
        lambda f: f"mask: 2 above {WARM_ABOVE:g} degC, 6 and off at {SHUT_OFF_AT:g}" if f.error_is_mask else "a code",
    ),
    ("position range", (), lambda f: f"{f.position_range} rad" if f.position_range else "usual"),
    ("special frames", (), _special),
)
QUESTIONS: tuple[Question, ...] = (
    ("CAN time-out", ("timeout",), _timeout),
    (
        "switching on with an encoder error",
        ("refuses_encoder_error",),
        lambda f: "refused in silence" if f.refuses_encoder_error else "obeyed",
    ),
    ("reply or status", ("reports",), _reply),
    ("also obeyed", ("shortest_command",), _also_obeyed),
    ("after a bus error", ("retransmits",), lambda f: "sends again" if f.retransmits else "the frame is lost"),
)


def parameter_table(node: str) -> str:
    """Return the Markdown tables of one node's parameters: the usual ones, then those for experts, without ranges."""
    bases = [base for base in BASES if base != node]
    shared: dict[str, list[str]] = defaultdict(list)
    own = []
    for param in PARAMETERS[node]:
        base = next((base for base in bases if any(_same(param, other) for other in PARAMETERS[base])), None)
        if base and node in REPEATING:
            shared[base].append(f"`{param.name}`")
        else:
            own.append(param)
    as_in = "; ".join(f"as of `{base}`: {', '.join(names)}" for base, names in shared.items())
    usual, expert = ([p for p in own if p.expert is wanted] for wanted in (False, True))
    before = (f"A{as_in[1:]}.\n\n" if as_in else "") + _live_ones(PARAMETERS[node])
    text = before + _parameter_rows(usual, with_range=True)
    return f"{text}\nFor experts:\n\n{_parameter_rows(expert, with_range=False)}" if expert else text


def _live_ones(params: Sequence[Param]) -> str:
    """Return a sentence that says which parameters a running node accepts; '' where it accepts none."""
    live, fixed = ([f"`{p.name}`" for p in params if p.fixed is wanted] for wanted in (False, True))
    if not live:
        return ""
    few, what = (fixed, "All but these are live") if len(fixed) < len(live) else (live, "Live")
    return f"{what}: {', '.join(few)}.\n\n" if few else "All are live.\n\n"


def _parameter_rows(params: Sequence[Param], with_range: bool) -> str:
    """Return a Markdown table, with one row for the components x, y and z of a vector."""
    rows = []
    for _, group in groupby(params, lambda param: re.sub("_[xyz]$", "_", param.name)):
        first, *others = group
        names = ", ".join(f"`{param.name}`" for param in (first, *others))
        axes = ", ".join(rf"{param.name[-1]}\2" for param in (first, *others))
        meaning = (
            re.sub(r"\b(along|about) [xyz](_n)?\b", rf"\1 {axes}", first.description) if others else first.description
        )
        permitted = _range(first) if with_range else ""
        rows.append((names, f"{_default(first)} {permitted}".rstrip(), meaning))
    return markdown(("parameter", "default (range)" if with_range else "default", "meaning"), rows)


def _same(param: Param, other: Param) -> bool:
    """Whether two nodes' parameters are the same to their user, except for when they may change, and on another arm."""
    return replace(param, fixed=other.fixed, expert=other.expert, vector=other.vector) == other


def fault_table() -> str:
    """Return the Markdown table of the fault codes."""
    return markdown(("fault", "meaning"), ((f"`{code}`", code.meaning) for code in FaultCode))


def firmware_table() -> str:
    """Return the Markdown tables of what each firmware does, of V1 and V2 boards, then of V3 boards.

    What is not known is marked: there the worst case is played.
    """
    mit, v3 = ({name: f for name, f in FIRMWARES.items() if _is_v3(f) is wanted} for wanted in (False, True))
    both = _answers("V1 and V2 boards", mit, (*MIT_QUESTIONS, *QUESTIONS)), _answers("V3 boards", v3, QUESTIONS)
    return "\n".join(both)


def _answers(boards: str, firmwares: Mapping[str, Firmware], questions: Iterable[Question]) -> str:
    rows = []
    for question, names, answer in questions:
        marks = ("*" if firmware.assumed & set(names) else "" for firmware in firmwares.values())
        rows.append((question, *(f"{answer(f)}{mark}" for f, mark in zip(firmwares.values(), marks, strict=True))))
    return markdown((boards, *(f"`{name}`" for name in firmwares)), rows)


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


def topic_table() -> str:
    """Return the Markdown table of the policy's publishers and subscribers of each topic.

    Raises ValueError for a topic that docs/topics.md does not describe.
    """
    topics = runpy.run_path(str(POLICY))["TOPICS"]
    described = set(re.findall(r"^\| `([\w/]+)` \| \w+_msgs/", TOPICS.read_text(encoding="utf-8"), re.MULTILINE))
    if missing := topics.keys() - EVERY_NODES - described:
        raise ValueError(f"{TOPICS}: must describe {', '.join(sorted(missing))}")
    rows = [
        (f"`{name}`", *(", ".join(sorted(f"`{node.rpartition('/')[2]}`" for node in way)) for way in topics[name]))
        for name in sorted(topics.keys() - EVERY_NODES, key=lambda name: (name.lstrip("/"), name))
    ]
    return markdown(("topic", "published by", "subscribed by"), rows)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def renewed(text: str) -> str:
    """Return a document's text with every table as the code declares it. Raises KeyError for an unknown table."""
    tables = {node: parameter_table(node) for node in PARAMETERS} | {
        "faults": fault_table(),
        "firmwares": firmware_table(),
        "motors": motor_table(),
        "topics": topic_table(),
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
        return "([motors.md](motors.md))"
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
