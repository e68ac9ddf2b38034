"""Writes new values into a copy of a parameter file: everything else stays as it is, comments and order included.

Each value is replaced in the text, at the place that PyYAML's parser reports. A line above it says when it was
measured, and how exactly. The copy is read again before it is written: it must differ in the new values only.
"""

from __future__ import annotations

import datetime
import json
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.tools.calibration.outcome import Change, Value
from exo_gravity.tools.inputs.parameter_file import load

PARAMETERS = "ros__parameters"
WIDTH = 118  # characters of a comment line
DIGITS = 7  # significant


class Edit(NamedTuple):
    """Replace text[start:end] by `text`."""

    start: int
    end: int
    text: str


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
        change = change._replace(value=plain(change.value))
        text = _changed(text, change, origin)
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
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, str)):
        return value
    return float(f"{value:.{DIGITS}g}") if isinstance(value, (float, np.floating)) else int(value)


def value_text(value: Value) -> str:
    """Return a value as YAML on one line, floats always with a decimal point: ROS refuses [1, 2.5]."""
    if isinstance(value, list):
        return f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, float):
        text = repr(value)
        mantissa, exponent, power = text.partition("e")
        return text if "." in text else f"{mantissa}.0{exponent}{power}"
    return json.dumps(value)


def _changed(text: str, change: Change, origin: str) -> str:
    heading, parameters = _parameters(text, change.node)
    if not change.name:
        return _edited(text, [_above(text, heading, f"{origin}: {change.note}")])
    note = f"{origin}: {change.note}" if change.note else origin
    mapping, path = parameters, change.name.split(".")
    while path:
        found = _entry(mapping, path)
        if found is None:
            break
        key, value, path = found
        if not path:
            return _replaced(text, key, value, change.value, note)
        if not isinstance(value, yaml.MappingNode):
            raise ParameterError(f"{change.node} {change.name}", value.value, "a mapping, to add a value to it")
        mapping = value
    return _added(text, mapping, path, change.value, note)


def _entry(mapping: yaml.MappingNode, path: list[str]) -> tuple[yaml.Node, yaml.Node, list[str]] | None:
    """Return key and value of the entry that begins the dotted `path`, and the rest of the path."""
    for length in range(len(path), 0, -1):
        for key, value in mapping.value:
            if key.value == ".".join(path[:length]):
                return key, value, path[length:]
    return None


def _parameters(text: str, node: str) -> tuple[yaml.Node, yaml.MappingNode]:
    """Return the key `ros__parameters` of `node` and its value as parsed: their marks are positions in `text`."""
    root = yaml.compose(text, yaml.SafeLoader)
    for key, entry in root.value if isinstance(root, yaml.MappingNode) else ():
        if key.value != node or not isinstance(entry, yaml.MappingNode):
            continue
        for name, parameters in entry.value:
            if name.value == PARAMETERS and isinstance(parameters, yaml.MappingNode) and parameters.value:
                return name, parameters
    raise ParameterError("params", node, "a node of the file that has parameters")


def _replaced(text: str, key: yaml.Node, value: yaml.Node, new: Value, note: str) -> str:
    """Replace a value; a list of the same length entry by entry, which keeps the comments between them."""
    old = value.value if isinstance(value, yaml.SequenceNode) else [value]
    items = new if isinstance(new, list) else [new]
    if len(old) == len(items):
        edits = [_edit(node, value_text(item)) for node, item in zip(old, items, strict=True)]
    elif isinstance(value, yaml.SequenceNode) and not value.flow_style:
        edits = [Edit(key.end_mark.index, _end(value), f": {value_text(new)}")]
    else:
        edits = [_edit(value, value_text(new))]
    return _edited(text, [_above(text, key, note), *edits])


def _added(text: str, mapping: yaml.MappingNode, path: Sequence[str], new: Value, note: str) -> str:
    """Add a value at the end of `mapping`; path: the keys below it, dotted."""
    last_key, last_value = mapping.value[-1]
    name = ".".join(path)
    if mapping.flow_style:
        at = last_value.end_mark.index
        return _edited(text, [_above(text, last_key, note), Edit(at, at, f", {name}: {value_text(new)}")])
    end = _end(last_value)
    at = text.find("\n", end) + 1 or len(text)
    column = mapping.value[0][0].start_mark.column
    line_break = "" if at == 0 or text[at - 1] == "\n" else "\n"
    entry = f"{line_break}{_comment(column, note)}{' ' * column}{name}: {value_text(new)}\n"
    return _edited(text, [Edit(at, at, entry)])


def _end(value: yaml.Node) -> int:
    """Return where the text of a value ends, without the comments after it, which PyYAML counts to a block."""
    if isinstance(value, yaml.MappingNode) and not value.flow_style:
        return _end(value.value[-1][1])
    if isinstance(value, yaml.SequenceNode) and not value.flow_style:
        return _end(value.value[-1])
    return int(value.end_mark.index)


def _edit(node: yaml.Node, text: str) -> Edit:
    return Edit(node.start_mark.index, node.end_mark.index, text)


def _above(text: str, key: yaml.Node, note: str) -> Edit:
    at, column = _before(text, key)
    return Edit(at, at, _comment(column, note))


def _before(text: str, key: yaml.Node) -> tuple[int, int]:
    """Return the start of the line of `key`, and the column of the line's first character."""
    at = text.rfind("\n", 0, key.start_mark.index) + 1
    line = text[at : key.start_mark.index]
    return at, len(line) - len(line.lstrip())


def _comment(column: int, note: str) -> str:
    lead = f"{' ' * column}# "
    lines = textwrap.wrap(note, WIDTH - column, break_long_words=False, break_on_hyphens=False)
    return "".join(f"{lead}{line}\n" for line in lines)


def _edited(text: str, edits: Iterable[Edit]) -> str:
    for edit in sorted(edits, reverse=True):
        text = text[: edit.start] + edit.text + text[edit.end :]
    return text
