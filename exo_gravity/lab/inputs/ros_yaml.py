# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""ROS 2's parameter YAML, read and written as rcl's own parser reads it: nodes and tools see the same values.

YAML libraries decide by other rules what a plain scalar is: `5e-1` is a string for PyYAML and a number for rcl, `y` a
string and a truth value, `1:30` a number and a string. The rules here are those of rcl_yaml_param_parser (Jazzy), which
takes C's `strtol` with base 0, then `strtod`. test/nodes/test_parameter_file.py compares both on a real node.

What rcl reads in a way that nobody means is refused, with its line: a key that is given twice (rcl merges), anchors and
aliases (rcl ends at an alias), wildcards in a node's name (rcl applies them, no tool does), names that no node can
have, whole numbers that a leading 0 makes octal (`010` is 8), values and lists that are empty, lists in lists. An empty
mapping, at which rcl ends, is no parameter: the launcher hands nodes a copy without it.
"""

import math
import re
import sys
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import yaml

from exo_gravity.core.errors import ParameterError

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


class _Reader:
    """One document's events. Raises ParameterError that names the file and the line."""

    def __init__(self, text: str, source: str) -> None:
        self._source = source
        self._events: Iterator[Any] = yaml.parse(text, EventLoader)
        self._next: Any = None  # the event that is next
        self._advance()

    def nodes(self) -> Nodes:
        """Return the parameters of each node."""
        nodes, lines = Nodes(), dict[str, int]()
        if not isinstance(self._next, yaml.MappingStartEvent):
            raise ParameterError("params", self._source, f"a mapping of {FORM}")
        for key in self._mapping("", lines):
            if not NODE.fullmatch(key):
                expected = f"the full name of one node, of letters A-Z, digits and _, as in {FORM} (line {lines[key]})"
                raise ParameterError("node name", key, expected)
            nodes[key] = self._parameters(key)
        if not nodes:
            raise ParameterError("params", self._source, f"a mapping of {FORM}")
        if not self._is(yaml.DocumentEndEvent) or not self._is(yaml.StreamEndEvent):
            self._refuse("a second document", "one document, without '---' inside")
        return nodes

    def _parameters(self, node: str) -> dict[str, Any]:
        """Return the parameters of one node by their dotted names."""
        keys, parameters = dict[str, int](), dict[str, Any]()
        for key in self._mapping(node, keys):
            if key != PARAMETERS:
                raise ParameterError(node, key, f"of the form {FORM} (line {keys[key]})")
            parameters = dict(self._flat(node, "", {}))
        if not keys:
            raise ParameterError(node, {}, f"of the form {FORM}")
        return parameters

    def _flat(self, node: str, prefix: str, lines: dict[str, int]) -> Iterator[tuple[str, Any]]:
        """Yield the dotted name and the value of each parameter. lines: those of the names so far."""
        own = dict[str, int]()
        for key in self._mapping(f"{node} {prefix}".strip(), own):
            name, line = f"{prefix}.{key}" if prefix else key, own[key]
            if isinstance(self._next, yaml.MappingStartEvent):
                yield from self._flat(node, name, lines)
                continue
            if name in lines:
                self._refuse_twice(f"{node} {name}", line, lines[name])
            lines[name] = line
            yield name, self._value(f"{node} {name}", line)

    def _mapping(self, what: str, lines: dict[str, int]) -> Iterator[str]:
        """Yield the keys of the mapping that begins here; the caller reads each value. lines: receives their lines."""
        if not self._is(yaml.MappingStartEvent):
            self._refuse(what, f"a mapping, as in {FORM}")
        while not self._is(yaml.MappingEndEvent):
            if not isinstance(self._next, yaml.ScalarEvent) or not self._next.value:
                self._refuse(what, "a mapping whose keys are names")
            key, line = self._next.value, self._line
            if key in lines:
                self._refuse_twice(f"{what} {key}".strip(), line, lines[key])
            lines[key] = line
            self._advance()
            yield key

    def _value(self, name: str, line: int) -> Any:
        """Return a scalar or a list of scalars of one type."""
        if self._is(yaml.SequenceStartEvent):
            items: list[Any] = []
            while not self._is(yaml.SequenceEndEvent):
                if not isinstance(self._next, yaml.ScalarEvent):
                    raise ParameterError(name, "a list in a list", f"a list of values (line {self._line})")
                items.append(self._scalar(name))
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
        return self._scalar(name)

    def _scalar(self, name: str) -> bool | int | float | str:
        text, is_quoted = self._next.value, self._next.style in ("'", '"') or self._next.tag == STRING
        if not text and not is_quoted:
            raise ParameterError(name, None, f"given a value, or left out (line {self._line})")
        if not is_quoted and OCTAL.fullmatch(text):
            number = text.lstrip("+-0")
            self._refuse(f"{name} {text}", f"{number} or {int(number, 8)}: with a leading 0, ROS reads it as octal")
        self._advance()
        return text if is_quoted else scalar(text)

    def _advance(self) -> None:
        """Go to the next event that holds content."""
        self._next = next(self._events)
        while isinstance(self._next, yaml.StreamStartEvent | yaml.DocumentStartEvent):
            self._next = next(self._events)
        if getattr(self._next, "anchor", None):
            sign = "*" if isinstance(self._next, yaml.AliasEvent) else "&"
            self._refuse(f"{sign}{self._next.anchor}", "written out: ROS reads no anchors and aliases")

    def _is(self, kind: type) -> bool:
        """Return whether the next event is of this kind, and pass over it if it is."""
        if not isinstance(self._next, kind):
            return False
        if kind is not yaml.StreamEndEvent:
            self._advance()
        return True

    @property
    def _line(self) -> int:
        return int(self._next.start_mark.line) + 1

    def _refuse(self, what: str, expected: str, line: int = 0) -> NoReturn:
        raise ParameterError(f"{self._source}, line {line or self._line}", what, expected)

    def _refuse_twice(self, what: str, line: int, first: int) -> NoReturn:
        self._refuse(what, f"given once: line {first} has it, too", line)


def read(text: str, source: str) -> Nodes:
    """Return {node name: {dotted parameter name: value}} of parameter YAML, as nodes read it.

    source: of the text, for messages.

    Raises ParameterError with the line of what is refused, yaml.YAMLError for what is not YAML.
    """
    return _Reader(text, source).nodes()


class _Text(str):
    """A string that is a value, and is written in quotes: rcl decides by its own rules what a plain one is."""


class _Dumper(yaml.SafeDumper):
    """Writes lists on one line. It writes no aliases, which rcl does not read: `dumped` copies every list."""


_Dumper.add_representer(_Text, lambda dumper, text: dumper.represent_scalar(STRING, text, style='"'))
_Dumper.add_representer(
    list, lambda dumper, items: dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=True)
)


def dumped(content: Mapping[str, Any]) -> str:
    """Return YAML from which PyYAML and rcl read the same strings, numbers and truth values."""

    def quoted(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: quoted(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [quoted(item) for item in value]
        return _Text(value) if isinstance(value, str) else value

    return str(yaml.dump(quoted(content), Dumper=_Dumper, sort_keys=False, width=math.inf, allow_unicode=True))


def text_of(nodes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return parameter YAML from which nodes and `read` read these values. nodes: as `read` returns them."""
    return dumped({node: {PARAMETERS: dict(values)} for node, values in nodes.items()})
