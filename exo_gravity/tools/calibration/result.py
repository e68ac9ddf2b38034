"""What a calibration found, and the parameter file that it writes.

The new file is a copy of the old one in which everything else stays as it is, comments and order included. Each value
is replaced in the text, at the place that PyYAML's parser reports. A line above it says when it was measured, and how
exactly. The copy is read again before it is kept: it must differ in the new values only.
"""

import datetime
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from exo_gravity.core.calibration.identification import Identified, Observation
from exo_gravity.core.calibration.motion import FrictionCurve
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import Vector
from exo_gravity.tools.inputs.arms import ConfiguredArm
from exo_gravity.tools.inputs.parameter_file import load

PARAMETERS = "ros__parameters"
WIDTH = 118  # characters of a comment line
DIGITS = 7  # significant

Value = bool | int | float | str | list[int] | list[float] | list[str]


class Change(NamedTuple):
    """A new value of a parameter, or a comment alone."""

    node: str  #: '/right/compensator'
    name: str  #: dotted, 'robot.moments'; '' for a comment alone
    value: Value
    note: str = ""  #: uncertainty and unit, for a comment in the file


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The result of one subcommand of `calibrate`."""

    changes: tuple[Change, ...] = ()  #: written unless there are `refusals`
    lines: tuple[str, ...] = ()  #: the result in sentences
    refusals: tuple[str, ...] = ()  #: why it is not calibrated, in sentences
    arm: ConfiguredArm | None = None  #: as configured before
    observations: tuple[Observation, ...] = ()
    identified: Identified | None = None
    suggestion: Vector | None = None  #: the next best pose, (4,) rad, None if none is wanted
    curves: tuple[FrictionCurve, ...] = ()  #: of each joint


def check_output(path: Path) -> None:
    """Raise ParameterError unless `path` is new, in an existing folder."""
    if path.exists():
        raise ParameterError("output", str(path), "a new file: an existing one is never overwritten")
    if not path.parent.is_dir():
        raise ParameterError("output", str(path), "in a folder that exists")


def write_changes(
    params: Path, output: Path, changes: Sequence[Change], command: str, today: datetime.date | None = None
) -> None:
    """Write a copy of `params` with `changes` to `output`.

    command: 'calibrate gravity', for the comments. Raises ParameterError if `output` exists, if a node is not in
    `params`, or if a value cannot be set alone, because an anchor shares it with another entry.
    """
    check_output(output)
    wanted = load(params)
    text = params.read_text(encoding="utf-8")
    origin = f"{today or datetime.date.today()} {command}"
    for change in changes:
        change = change._replace(value=plain(change.value), note=": ".join(filter(None, (origin, change.note))))
        text = _changed(text, change)
        if change.name:
            wanted[change.node][change.name] = change.value
    with output.open("x", encoding="utf-8") as stream:
        stream.write(text)
    if load(output) != wanted:
        output.unlink()
        names = ", ".join(f"{change.node} {change.name}" for change in changes)
        raise ParameterError("params", str(params), f"without anchors and repeated keys, to set {names} alone")


def plain(value: Any) -> Any:
    """Return a value in Python's own types, floats rounded to DIGITS."""
    value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def value_text(value: Value) -> str:
    """Return a plain value as YAML on one line, floats always with a decimal point: ROS refuses [1, 2.5]."""
    return yaml.safe_dump([value], default_flow_style=True, width=math.inf).strip()[1:-1]


def _changed(text: str, change: Change) -> str:
    """Return the text with one change, in the node's mapping of parameters or in a mapping inside it."""
    root: Any = yaml.compose(text, yaml.SafeLoader)
    entries = dict(_entries("", root))
    target = ".".join(filter(None, (change.node, PARAMETERS, change.name)))
    if target in entries:
        key, old = entries[target]
        nodes = old.value if isinstance(old, yaml.SequenceNode) else [old]
        items = change.value if isinstance(change.value, list) else [change.value]
        # Of a list, entry by entry: the comments between them stay.
        pairs = zip(nodes, items, strict=False) if change.name else ()
        edits = [(node.start_mark.index, node.end_mark.index, value_text(item)) for node, item in pairs]
        return _edited(text, key, change.note, edits)
    parent = max((name for name in entries if target.startswith(f"{name}.")), key=len, default="")
    if PARAMETERS not in parent:
        raise ParameterError("params", change.node, "a node of the file that has parameters")
    mapping = entries[parent][1]
    if not isinstance(mapping, yaml.MappingNode) or not mapping.value:
        raise ParameterError(f"{change.node} {change.name}", mapping.value, "a mapping, to add a value to it")
    entry = f"{target.removeprefix(f'{parent}.')}: {value_text(change.value)}"
    last_key, last_value = mapping.value[-1]
    end = _end(last_value)
    if mapping.flow_style:
        return _edited(text, last_key, change.note, [(end, end, f", {entry}")])
    line_end = end + len(text[end:].partition("\n")[0])
    indent = " " * last_key.start_mark.column
    return f"{text[:line_end]}\n{_comment(indent, change.note)}{indent}{entry}{text[line_end:]}"


def _entries(prefix: str, mapping: yaml.MappingNode) -> Iterator[tuple[str, tuple[yaml.Node, yaml.Node]]]:
    """Yield the dotted name of each entry, also of those in mappings inside, with its key and value."""
    for key, value in mapping.value:
        yield prefix + key.value, (key, value)
        if isinstance(value, yaml.MappingNode):
            yield from _entries(f"{prefix}{key.value}.", value)


def _end(value: yaml.Node) -> int:
    """Return where the text of a value ends, without the comments after it, which PyYAML adds to a block."""
    if isinstance(value, yaml.CollectionNode) and not value.flow_style:
        last = value.value[-1]
        return _end(last[1] if isinstance(value, yaml.MappingNode) else last)
    return int(value.end_mark.index)


def _edited(text: str, key: yaml.Node, note: str, edits: Iterable[tuple[int, int, str]]) -> str:
    """Return the text with a comment above the line of `key`, and with each edit: from, to, new characters."""
    at = text.rfind("\n", 0, key.start_mark.index) + 1
    line = text[at : key.start_mark.index]
    indent = line[: len(line) - len(line.lstrip())]
    for start, end, new in sorted([*edits, (at, at, _comment(indent, note))], reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _comment(indent: str, note: str) -> str:
    lines = textwrap.wrap(note, WIDTH - len(indent), break_long_words=False, break_on_hyphens=False)
    return "".join(f"{indent}# {line}\n" for line in lines)
