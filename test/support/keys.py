# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What docs/keys.md promises to programs: the keys of each node, and the values that each may have."""

import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

from exo_gravity.core.safety.command import FaultCode
from exo_gravity.core.vocabulary import NONE, TEXT, UNKNOWN

from . import ROOT

DOCUMENT = (ROOT / "docs" / "keys.md").read_text(encoding="utf-8")
CODE = re.compile("`([^`]+)`")
LINK = re.compile(r"\[below\]\(#([\w-]+)\)")
# What a cell says of values that are no words.
NUMBER = re.compile(r"\b(numbers?|counts?|version|weighings)\b|0\.\.1")
NAME = re.compile(r"\b(name|joints?|topic|terms that|parameters' words|KIND|LIMIT)\b")


class Row(NamedTuple):
    """What the page says of one key."""

    words: frozenset[str]
    cell: str

    def allows(self, part: str) -> bool:
        """Whether the key may have this value, or have it among several."""
        is_number = bool(NUMBER.search(self.cell)) and _is_number(part)
        return part in (*self.words, NONE, UNKNOWN) or is_number or bool(NAME.search(self.cell))


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+(\.\d*)?([eE][-+]?\d+)?|nan|inf)", text) is not None


def sections() -> dict[str, str]:
    """Return the text of each section by the anchor of its heading, as GitHub forms it; without its subsections."""
    parts = re.split(r"^#+ (.*)$", DOCUMENT, flags=re.MULTILINE)[1:]
    heads = [re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in parts[0::2]]
    return dict(zip(heads, parts[1::2], strict=True))


def items(section: str) -> list[tuple[str, str]]:
    """Return the items of a section's list: what is in backticks before the first colon, and what follows it."""
    joined = re.sub(r"\n  +", " ", section)
    return re.findall(r"^- (`[^:]*`): (.*)$", joined, re.MULTILINE)


@lru_cache
def documented() -> Mapping[str, Mapping[str, Row]]:
    """Return what the page says, by executable and key; '' has what it says of every node."""
    found: dict[str, dict[str, Row]] = {"": {}}
    for anchor, section in sections().items():
        owner = "" if anchor == "every-node" else anchor
        found.setdefault(owner, {}).update(pair for keys, cell in items(section) for pair in _of_row(keys, cell))
    return found


def _of_row(keys: str, cell: str) -> Iterator[tuple[str, Row]]:
    for key in CODE.findall(keys):
        words = set(CODE.findall(cell)) | set(_below(key, cell)) | ({*map(str, FaultCode)} if key == "fault" else set())
        yield key, Row(frozenset(words), cell)
    for key in (text for text in CODE.findall(cell) if text.endswith(TEXT)):
        yield key, Row(frozenset(), "")


def _below(key: str, cell: str) -> Iterable[str]:
    """Return the words in the list to which a cell leads: those of the key, or else its items."""
    if (link := LINK.search(cell)) is None:
        return []
    rows = items(sections()[link[1]])
    own = [cell for keys, cell in rows if keys == f"`{key}`"]
    return CODE.findall(own[0]) if own else [word for words, _ in rows for word in CODE.findall(words)]


def row_of(node: str, key: str) -> Row | None:
    """Return what the page says of a node's key, None if it has no such key. `JOINT` stands for any joint."""
    leaf = node.rpartition("/")[2]
    rows = {**documented()[""], **documented().get(leaf, {})}
    ends = [own for own in rows if own.startswith("JOINT ") and key.endswith(own.removeprefix("JOINT"))]
    return rows.get(key) or rows.get(max(ends, key=len, default=""))


def broken(node: str, values: Mapping[str, str]) -> list[str]:
    """Return what the values of a node's status break of the page, a sentence each."""
    found = [f"{node}: {key} is missing" for key in ("interface", "state") if key not in values]
    for key, value in values.items():
        row = row_of(node, key)
        if row is None:
            found.append(f"{node}: {key} is not in docs/keys.md")
        elif key.endswith(")"):
            found += [f"{node}: {key}: {part}" for part in value.split(", ") if not _is_figure(part)]
        elif not key.endswith(TEXT):
            found += [f"{node}: {key}: {part}" for part in value.split(", ") if not row.allows(part)]
    return found


def _is_figure(part: str) -> bool:
    return part in (NONE, UNKNOWN) or _is_number(part)
