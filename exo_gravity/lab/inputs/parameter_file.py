# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parameter file that drives everything: ROS 2's own YAML form, keyed by fully qualified node names.

    /imu: {ros__parameters: {...}}
    /right/can_bridge: {ros__parameters: {can: {interface: socketcan}, ...}}

The tools read it to find out which nodes to start and which arms they have; the nodes read it through ROS. Both read
the same.
"""

import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import yaml

from exo_gravity import packaged
from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.errors import DataError, ParameterError, named
from exo_gravity.core.motors.joint_motor import OPTIONS, buses_of
from exo_gravity.core.params import joint_count

MAX_LIST = 100  # entries; the longest list of any parameter has 4, and rcl's parser takes minutes for 200,000
PARAMETERS = "ros__parameters"
FORM = "/namespace/executable: {ros__parameters: {...}}"
# libyaml, which rcl uses, too, is ten times faster; PyYAML is sometimes built without it.
EventLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

TRUE = ("Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON")
FALSE = ("N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF")
NOT_FINITE = re.compile(r"\.(?:nan|NaN|NAN)|[+-]?\.(?:inf|Inf|INF)")
INTEGER = re.compile(r"([+-]?)(?:0[xX]([0-9a-fA-F]+)|(0[0-7]*)|([1-9][0-9]*))")
DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
HEXADECIMAL = re.compile(r"[+-]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][+-]?[0-9]+)?")
C_NOT_FINITE = re.compile(r"[+-]?(?:inf|infinity|nan(?:\(\w*\))?)", re.IGNORECASE)
OCTAL = re.compile(r"[+-]?0+[1-7][0-7]+")  # of 8 or more: not the number that its digits show
LARGEST_INTEGER = 2**63 - 1
NODE = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")  # rmw's rule for the names of nodes and namespaces

STRING = "tag:yaml.org,2002:str"  # !!str, the one tag that rcl minds

Nodes = dict[str, dict[str, Any]]  # node name -> dotted parameter name -> value


def scalar(text: str) -> bool | int | float | str:
    """Return the value that a plain scalar has for rcl."""
    if text in TRUE or text in FALSE:
        return text in TRUE
    if whole := INTEGER.fullmatch(text):
        sign, hexadecimal, octal, decimal = whole.groups()
        number = int(hexadecimal, 16) if hexadecimal else int(octal, 8) if octal else int(decimal)
        number = -number if sign == "-" else number
        if -LARGEST_INTEGER - 1 <= number <= LARGEST_INTEGER:
            return number
    if NOT_FINITE.fullmatch(text) or C_NOT_FINITE.fullmatch(text):
        return math.nan if "nan" in text.lower() else math.copysign(math.inf, -1.0 if text[0] == "-" else 1.0)
    if DECIMAL.fullmatch(text) or HEXADECIMAL.fullmatch(text):
        return _number(text)
    return text


def _number(text: str) -> float | str:
    """Return a number in C's notation, or its text where it is too large or too small for a normal double."""
    is_hexadecimal = "x" in text.lower()
    try:
        number = float.fromhex(text) if is_hexadecimal else float(text)
    except OverflowError:
        return text
    mantissa = re.split("[pP]" if is_hexadecimal else "[eE]", text)[0]
    is_zero = not mantissa.lstrip("+-").lower().removeprefix("0x").strip("0.")
    is_normal = math.isfinite(number) and abs(number) >= sys.float_info.min
    return number if is_normal or is_zero else text


class _Loader(EventLoader):  # type: ignore[misc, valid-type]  # one of two classes
    """Gives the tag of a text to those scalars only that are written in quotes, or with that tag."""


_Loader.add_implicit_resolver("!plain", re.compile(""), None)


@dataclass(frozen=True)
class _Reader:
    """What is in one document. Raises ParameterError that names the file and the line.

    ROS 2's parameter YAML, read and written as rcl's own parser reads it: nodes and tools see the same values.

    YAML libraries decide by other rules what a plain scalar is: `5e-1` is a string for PyYAML and a number for rcl, `y`
    a string and a truth value, `1:30` a number and a string. The rules here are those of rcl_yaml_param_parser (Jazzy),
    which takes C's `strtol` with base 0, then `strtod`. test/nodes/test_parameter_file.py compares both on a real node.

    What rcl reads otherwise than its author means is refused, with its line: a key given twice (rcl merges), anchors
    and aliases (rcl ends at an alias), wildcards in a node's name (rcl applies them, no tool does), names that no node
    can have, whole numbers that a leading 0 makes octal (`010` is 8), values and lists that are empty, lists in lists.
    An empty mapping, at which rcl ends, is no parameter: the launcher hands nodes a copy without it.
    """

    source: str

    def nodes(self, root: yaml.Node) -> Nodes:
        """Return the parameters of each node."""
        nodes: Nodes = {}
        for key, line, value in self._entries("", root):
            if not NODE.fullmatch(key):
                expected = f"the full name of one node, of letters A-Z, digits and _, as in {FORM} (line {line})"
                raise ParameterError("node name", key, expected)
            nodes[key] = self._parameters(key, value)
        return nodes

    def _parameters(self, node: str, root: yaml.Node) -> dict[str, Any]:
        """Return the parameters of one node by their dotted names."""
        found = {key: (line, value) for key, line, value in self._entries(node, root)}
        for key in found.keys() - {PARAMETERS}:
            raise ParameterError(node, key, f"of the form {FORM} (line {found[key][0]})")
        if not found:
            raise ParameterError(node, {}, f"of the form {FORM}")
        return dict(self._flat(node, "", found[PARAMETERS][1], {}))

    def _flat(self, node: str, prefix: str, root: yaml.Node, lines: dict[str, int]) -> Iterator[tuple[str, Any]]:
        """Yield the dotted name and the value of each parameter. lines: those of the names so far."""
        for key, line, value in self._entries(f"{node} {prefix}".strip(), root):
            name = f"{prefix}.{key}" if prefix else key
            if isinstance(value, yaml.MappingNode):
                yield from self._flat(node, name, value, lines)
                continue
            if name in lines:
                self.refuse(line, f"{node} {name}", f"given once: line {lines[name]} has it, too")
            lines[name] = line
            yield name, self._value(f"{node} {name}", line, value)

    def _entries(self, what: str, root: yaml.Node) -> Iterator[tuple[str, int, yaml.Node]]:
        """Yield each key of a mapping with its line and its value."""
        if not isinstance(root, yaml.MappingNode):
            self.refuse(line_of(root), what, f"a mapping, as in {FORM}")
        lines: dict[str, int] = {}
        for key, value in root.value:
            if not isinstance(key, yaml.ScalarNode) or not key.value:
                self.refuse(line_of(key), what, "a mapping whose keys are names")
            name = key.value
            if name in lines:
                self.refuse(line_of(key), f"{what} {name}".strip(), f"given once: line {lines[name]} has it, too")
            lines[name] = line_of(key)
            yield name, lines[name], value

    def _value(self, name: str, line: int, node: yaml.Node) -> Any:
        """Return a scalar or a list of scalars of one type."""
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(name, node)
        if inner := next((item for item in node.value if not isinstance(item, yaml.ScalarNode)), None):
            raise ParameterError(name, "a list in a list", f"a list of values (line {line_of(inner)})")
        items = [self._scalar(name, item) for item in node.value]
        if not items:
            raise ParameterError(name, [], f"given a value, or left out (line {line})")
        if len(items) > MAX_LIST:
            raise ParameterError(name, items, f"at most {MAX_LIST} entries; it has {len(items):,}")
        if len({type(item) for item in items}) > 1:
            # ROS's own parser refuses such a list without naming it.
            text = next((item for item in items if isinstance(item, str)), "")
            if text and {int, float} & {type(item) for item in items}:
                raise ParameterError(name, text, f"a number, like the others: it is a text (line {line})")
            raise ParameterError(name, items, f"a list of one type: 1.0, not 1, next to 2.5 (line {line})")
        return items

    def _scalar(self, name: str, node: yaml.ScalarNode) -> bool | int | float | str:
        text: str = node.value
        if node.style in ("'", '"') or (node.tag == STRING and not node.style):  # a block is read as what is plain
            return text
        if not text:
            raise ParameterError(name, None, f"given a value, or left out (line {line_of(node)})")
        if OCTAL.fullmatch(text):
            number = text.lstrip("+-0")
            expected = f"{number} or {int(number, 8)}: with a leading 0, ROS reads it as octal"
            self.refuse(line_of(node), f"{name} {text}", expected)
        return scalar(text)

    def refuse(self, line: int, what: str, expected: str) -> NoReturn:
        raise ParameterError(f"{self.source}, line {line}", what, expected)


def line_of(part: Any) -> int:
    """Return the line in which a part of a document begins, from 1 on."""
    return int(part.start_mark.line) + 1


def read(text: str, source: str) -> Nodes:
    """Return {node name: {dotted parameter name: value}} of parameter YAML, as nodes read it.

    source: of the text, for messages.

    Raises ParameterError with the line of what is refused, yaml.YAMLError for what is not YAML.
    """
    reader = _Reader(source)
    depth = 0
    for event in yaml.parse(text, EventLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > 50:  # no parameter has 10; some 25,000 would end the process, in libyaml
            reader.refuse(line_of(event), "brackets in brackets", "at most 50 within each other")
        if anchor := getattr(event, "anchor", None):
            sign = "*" if isinstance(event, yaml.AliasEvent) else "&"
            reader.refuse(line_of(event), f"{sign}{anchor}", "written out: ROS reads no anchors and aliases")
    documents = [*yaml.compose_all(text, _Loader)]
    if not documents or not isinstance(documents[0], yaml.MappingNode) or not documents[0].value:
        raise ParameterError("params", source, f"a mapping of {FORM}")
    if len(documents) > 1:
        reader.refuse(line_of(documents[1]), "a second document", "one document, without '---' inside")
    return reader.nodes(documents[0])


class _Dumper(yaml.SafeDumper):
    """Writes lists on one line, and no aliases, which rcl does not read; in quotes also what rcl takes for no text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    str, lambda dumper, text: dumper.represent_scalar(STRING, text, style="" if scalar(text) == text else '"')
)
for sequence in (list, tuple):
    _Dumper.add_representer(
        sequence, lambda dumper, items: dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=True)
    )


def dumped(content: Mapping[str, Any]) -> str:
    """Return YAML from which PyYAML and rcl read the same strings, numbers and truth values."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=math.inf, allow_unicode=True))


def text_of(nodes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return parameter YAML from which nodes and `read` read these values. nodes: as `read` returns them."""
    return dumped({node: {PARAMETERS: dict(values)} for node, values in nodes.items()})


def packaged_config(name: str) -> Path:
    """Return the path of a file of `config/`. Raises ParameterError if it is not installed."""
    if (path := packaged(name)) is None:
        raise ParameterError("config", name, "a file that the package installs: reinstall the package")
    return path


def load(path: str | Path) -> Nodes:
    """Return {node name: {dotted parameter name: value}} of a parameter file, as the nodes read it.

    Raises ParameterError, which names the file, the line or the entry, if the file is missing, not YAML, or of another
    form, if ROS would read it in a way that nobody means, or if its nodes contradict each other.
    """
    try:
        nodes = read(Path(path).read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise ParameterError("params", str(path), f"a readable file ({error.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ParameterError("params", str(path), f"YAML without tabs ({' '.join(str(error).split())})") from None
    _check_together(nodes)
    return nodes


@lru_cache(32)  # more than a recording has nodes whose parameters are used
def recorded_parameters(text: str, node: str) -> Mapping[str, Any]:
    """Return the parameters of `node` by name, from the text that the recorder wrote. Raises DataError."""
    try:
        # In libyaml's loader some 25,000 brackets in brackets would end the process; PyYAML's own one raises.
        loader = EventLoader if len(text) < 10_000 else yaml.SafeLoader
        given = yaml.load(text, loader)[node]["ros__parameters"]
        if {*map(type, given.keys())} <= {str}:
            return MappingProxyType(given)
    except (yaml.YAMLError, AttributeError, LookupError, TypeError, ValueError, RecursionError):
        pass
    raise DataError(f"{node}: the recording has no parameters of it that can be read")


def node_of(arm: str, executable: str) -> str:
    """Return the full name of a node of an arm: '/right/can_bridge'; an arm without a namespace is called 'arm'."""
    return f"/{executable}" if arm == "arm" else f"/{arm}/{executable}"


def can_options(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options for python-can in the parameters of a node."""
    prefix = f"{OPTIONS}."
    return {name.removeprefix(prefix): value for name, value in given.items() if name.startswith(prefix)}


def stages(nodes: Iterable[str]) -> tuple[list[str], list[str], list[str]]:
    """Return the full names `nodes` in the order in which they stop: bridges, others, recorders."""
    found: tuple[list[str], list[str], list[str]] = [], [], []
    for node in nodes:
        found[0 if node.endswith("/can_bridge") else 2 if node.endswith("/recorder") else 1].append(node)
    return found


def _check_together(nodes: Nodes) -> None:
    """Raise ParameterError for nodes that contradict each other: buses, names of joints, sides, a second IMU."""
    owner: dict[tuple[tuple[str, str], ...], str] = {}
    for node in stages(nodes)[0]:
        given = nodes[node]
        with named(f"{node} "):
            buses = buses_of(str(given.get("can.channel", node)), can_options(given), joint_count(given))
        for name, (_, own) in buses.items():
            options = {f"{OPTIONS}.{option}": value for option, value in own.items()}
            what = {"can.channel": name, "can.interface": given.get("can.interface"), **options}
            bus = tuple(sorted((key, str(value)) for key, value in what.items()))
            other = owner.setdefault(bus, node)
            if other != node:
                raise ParameterError(f"{node} can", dict(bus), f"different from the bus of {other}: one arm per bus")
        # Efforts are looked up by name: the motors of two exchanged names would each get the torque of the other.
        for executable in ("compensator", "simulator"):
            other = f"{node.rpartition('/')[0]}/{executable}"
            names, others = (one.get("joint_names") for one in (given, nodes.get(other, {})))
            if names and others and list(names) != list(others):
                raise ParameterError(f"{node} joint_names", list(names), f"those of {other}, {list(others)}")
    for node, given in nodes.items():
        of_namespace, side = node.split("/")[-2], given.get("side")
        if side in SIDES and of_namespace in SIDES and side != of_namespace:
            raise ParameterError(f"{node} side", side, f"{of_namespace}, as its namespace says")
    imus = [node for node in nodes if node.endswith("/imu")]
    if len(imus) > 1:
        raise ParameterError("params", imus, "a file with one imu, which serves both arms: all publish /imu/pitch_yaw")
