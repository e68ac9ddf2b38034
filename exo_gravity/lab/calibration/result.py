# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibration found, the parameter file that it writes, and its page.

The new file is a copy of the old one in which everything else stays as it is, comments and order included. Each value
is replaced in the text, at the place that PyYAML's parser reports. A line above it says when it was measured, and how
exactly. The copy is read again before it is kept: it must differ in the new values only.

The page compares the torque that the fit leaves with each joint's friction. An arm whose torque is wrong by less than
that stays where it is. With more it creeps, until viscous friction balances the rest.
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
from matplotlib.figure import Figure

from exo_gravity.core.compensation.settings import joint_spring_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.calibration.identification import FrictionCurve, Identified, columns, held_offset
from exo_gravity.lab.calibration.moment_model import MomentModel
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.report import html
from exo_gravity.lab.report.html import FAINT, HOLD_COLOUR, INK, joint_colours, make_plain

PARAMETERS = "ros__parameters"
WIDTH = 118  # characters of a comment line
DPI = 130
FIGURE_WIDTH = 11.0  # inches
ROW_HEIGHT, CURVE_HEIGHT = 2.5, 4.0  # inches, of a joint's remainders, of all curves

Value = bool | int | float | str | list[int] | list[float] | list[str]


class Change(NamedTuple):
    """A new value of a parameter, or a comment alone."""

    node: str  #: '/right/compensator'
    name: str  #: dotted, 'robot.first_moment'; '' for a comment alone
    value: Value  #: in Python's own types
    note: str = ""  #: uncertainty and unit, for a comment in the file

    @property
    def text(self) -> str:
        """The change as a line."""
        return f"{self.name}: {value_text(self.value)}, {self.note}" if self.name else self.note


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The result of one subcommand of `calibrate`."""

    changes: tuple[Change, ...] = ()  #: written unless there are `refusals`
    lines: tuple[str, ...] = ()  #: what else was found, in sentences
    refusals: tuple[str, ...] = ()  #: why it is not calibrated, in sentences
    arm: ConfiguredArm | None = None  #: as configured before
    model: MomentModel | None = None  #: its moments, as configured before
    observations: tuple[Observation, ...] = ()
    identified: Identified | None = None
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

    command: 'calibrate gravity', for the comments.

    Raises ParameterError if `output` exists, if a node is not in `params`, or if a value cannot be set alone, because
    an anchor shares it with another entry.
    """
    check_output(output)
    wanted = load(params)
    text = params.read_text(encoding="utf-8")
    origin = f"{today or datetime.date.today()} {command}"
    for change in changes:
        text = _changed(text, change._replace(note=f"{origin}: {change.note}" if change.note else origin))
        if change.name:
            wanted[change.node][change.name] = change.value
    with output.open("x", encoding="utf-8") as stream:
        stream.write(text)
    if load(output) != wanted:
        output.unlink()
        names = ", ".join(f"{change.node} {change.name}" for change in changes)
        raise ParameterError("params", str(params), f"without anchors and repeated keys, to set {names} alone")


def value_text(value: Value) -> str:
    """Return a value as YAML on one line, floats always with a decimal point: ROS refuses [1, 2.5]."""
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
    mapping = entries[parent][1] if PARAMETERS in parent else None
    if not isinstance(mapping, yaml.MappingNode) or not mapping.value:
        raise ParameterError("params", f"{change.node} {change.name}", "a parameter of a node that has parameters")
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


def remainders(
    found: Identified, arm: ConfiguredArm, model: MomentModel, poses: Sequence[Observation]
) -> tuple[np.ndarray, np.ndarray]:
    """Return measured minus predicted torque (m, n) in Nm as commanded, of the old file and of the new one.

    The new file lacks the part of an offset that no spring has. Its remainders are those of a result that was found
    without that pose.
    """
    theta, direction, measured, _ = columns(poses)
    loads = np.array([model.load(pose.load_mass, pose.load_lever) for pose in poses])
    rows = model.rows(theta, direction)
    springs = joint_spring_of(arm.compensator).torques(theta)
    old = measured - np.einsum("njk,nk->nj", rows, model.moments + loads) - springs
    return old, found.held_out + found.value.offset - held_offset(found.value, found.value.scale)


def page_of(result: CalibrationResult, command: str, params: str, today: datetime.date | None = None) -> str:
    """Return the page of a result; command: 'gravity'. params: the old file, for the line below the title."""
    arm = f", {result.arm.name} arm" if result.arm else ""
    when = f"{today or datetime.date.today()}, from {params}"
    return html.document(f"calibrate {command}{arm}", when, _sections(result))


def _sections(result: CalibrationResult) -> Iterator[str]:
    refused = "Not calibrated; no file was written."
    yield html.verdict(refused if result.refusals else "Calibrated.", result.refusals, good=not result.refusals)
    found = result.identified
    unknown = found.unknown if found else ()
    notes = [change.note for change in result.changes if not change.name]
    yield html.bullets("Result", [*notes, *(line for line in result.lines if line not in unknown)])
    rows = [(c.node, c.name, value_text(c.value), c.note) for c in result.changes if c.name]
    if rows and not result.refusals:
        yield html.heading("New values")
        yield html.table(("node", "parameter", "value", "note"), [((), rows)])
    if found and result.arm and result.model:
        of = result.arm, result.model, result.observations
        caption = "Measured less predicted torque: inside the band, friction holds the arm; outside, it creeps."
        yield html.picture(html.png_of(torque_figure(found, *of), DPI), caption)
        yield html.bullets("What these poses do not show", unknown)
    if result.curves and result.arm:
        caption = "Friction over speed, half the difference between both directions."
        yield html.picture(html.png_of(friction_figure(result.curves, result.arm.joint_names), DPI), caption)


def torque_figure(found: Identified, arm: ConfiguredArm, model: MomentModel, poses: Sequence[Observation]) -> Figure:
    """Return a row per joint: what remains of the measured torque in each pose, with the friction."""
    count, numbers = len(arm.joint_names), np.arange(1, len(poses) + 1)
    figure = Figure(figsize=(FIGURE_WIDTH, ROW_HEIGHT * count), layout="constrained")
    theta, _, _, spread = columns(poses)
    old, new = remainders(found, arm, model, poses)
    axes, colours = figure.subplots(count, 1, squeeze=False)[:, 0], joint_colours(count)
    for joint, (axis, colour, name) in enumerate(zip(axes, colours, arm.joint_names, strict=True)):
        friction = found.friction[joint]
        axis.axhspan(-friction, friction, color=HOLD_COLOUR, lw=0, zorder=0, label="friction holds")
        axis.axhline(0.0, color=FAINT, lw=0.6, zorder=0)
        axis.plot(numbers - 0.12, old[:, joint], "o", ms=5, mfc="none", color=INK, label="old file")
        axis.errorbar(
            numbers + 0.12, new[:, joint], 2.0 * spread[:, joint], fmt="o", ms=4.5, lw=1.2, color=colour,
            label="new file, this pose held out, ± 2 standard errors",
        )  # fmt: skip
        axis.set(xlim=(0.4, len(numbers) + 0.6), ylabel="Remainder (Nm)")
        axis.set_xticks(numbers, [])
        axis.set_title(name, fontsize=10, color=colour, loc="left", weight="bold")
        make_plain(axis)
    rows = [[str(n), *(f"{angle:.0f}" for angle in pose)] for n, pose in zip(numbers, np.degrees(theta), strict=True)]
    axis.set_xticks(numbers, map("\n".join, rows), fontsize=8)
    axis.set_xlabel("Pose, with its angles in degrees")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return figure


def friction_figure(curves: Sequence[FrictionCurve], labels: Sequence[str]) -> Figure:
    """Return the friction of all joints over their speed, measured and fitted, less what grows with the torque."""
    figure = Figure(figsize=(FIGURE_WIDTH, CURVE_HEIGHT), layout="constrained")
    axis = figure.subplots()
    for curve, label, colour in zip(curves, labels, joint_colours(len(curves)), strict=True):
        order, of_load = np.argsort(curve.speed), curve.load * curve.carried
        axis.plot(curve.speed, curve.torque - of_load, "o", ms=4.5, color=colour)
        axis.plot(curve.speed[order], (curve.fitted - of_load)[order], color=colour, lw=1.0, label=label)
    axis.set(xlabel="Speed (rad/s)", ylabel="Friction (Nm)", ylim=(0.0, None))
    axis.legend(frameon=False, fontsize=8)
    make_plain(axis)
    return figure
