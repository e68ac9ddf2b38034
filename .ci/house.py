# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rules of this repository that no linter knows: prints what breaks them, and exits with 1 if anything does.

Links and paths of the documents exist, the safety case names each row of the fault matrix, Troubleshooting quotes
messages that exist, and no room is above its ceiling in `.ci/ceilings.txt`. `--lower` lowers these to what is there.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT)]

from exo_gravity.core.safety.command import FaultCode  # noqa: E402
from test.faults.processes import CASES  # noqa: E402
from test.faults.virtual_cases import ROWS  # noqa: E402
from test.support.document_commands import DOCUMENTS  # noqa: E402

FOLDERS = "bench|config|docs|examples|exo_gravity|launch|test|core|hardware|sim|lab|panel|nodes|tools|.ci|.github"
CEILINGS = ROOT / ".ci" / "ceilings.txt"
# What decides a torque, below exo_gravity.
PATH = ("core", "hardware", "nodes/can_bridge", "nodes/compensator", "nodes/imu*", "nodes/ros")
ROOMS = {
    "package": ("exo_gravity",),
    "path": tuple(f"exo_gravity/{part}" for part in PATH),
    "test": ("test",),
    "bench": ("bench",),
}


def text_of(path: str | Path) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def first_column(document: str, heading: str) -> list[str]:
    """Return what is in backticks in the first column of the tables with this heading."""
    found = re.findall(rf"\| {heading} \|.*\n\|[-|]+\n((?:\|.*\n)+)", document)
    rows = [line.split("|")[1] for table in found for line in table.splitlines()]
    return [code for row in rows for code in re.findall("`([^`]+)`", row)]


def anchors(document: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub forms them."""
    headings = re.findall(r"^#+ (.*)$", document, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links_and_paths() -> Iterator[str]:
    """Yield each link, and each path in backticks, that leads nowhere."""
    for path in DOCUMENTS:
        document, name = text_of(path), path.relative_to(ROOT)
        for link in re.findall(r"\]\((?!https?:)([^)]+)\)", document):
            file, _, anchor = link.partition("#")
            target = path.parent / file if file else path
            if not target.exists() or (anchor and anchor not in anchors(text_of(target))):
                yield f"{name}: the link {link} leads nowhere"
        for text in re.findall(rf"`((?:{FOLDERS})/[\w./]*)`", document):
            if not (ROOT / text).exists() and not (ROOT / "exo_gravity" / text).exists():
                yield f"{name}: `{text}` does not exist"


def safety_case() -> Iterator[str]:
    """Yield each row of the fault matrix that the safety case does not name once, and each name that is no row's.

    An asterisk in a name stands for any text.
    """
    found = re.findall(r"\| cause.*?\| rows \|\n\|[-|]+\n((?:\|.*\n)+)", text_of("docs/safety_case.md"))
    cells = (line.split(" | ")[-1] for table in found for line in table.splitlines())
    names = [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]
    rows = [case.name for case in (*CASES, *ROWS)]
    for row in rows:
        if (times := sum(fnmatchcase(row, name) for name in names)) != 1:
            yield f"docs/safety_case.md must name the row {row} once, not {times} times"
    for name in names:
        if not any(fnmatchcase(row, name) for row in rows):
            yield f"docs/safety_case.md: no row is called {name}"


def quoted_messages() -> Iterator[str]:
    """Yield each message and fault code that Troubleshooting quotes and the code does not have."""
    document = text_of("docs/troubleshooting.md")
    # Adjacent string literals, as the formatter splits long messages, become one.
    paths = sorted((ROOT / "exo_gravity").rglob("*.py"))
    source = "\n".join(re.sub(r'"\s*\n\s*f?"', "", text_of(path)) for path in paths)
    codes = {str(code) for code in FaultCode}
    for message in first_column(document, "message"):
        if message not in source and message not in codes:
            yield f"docs/troubleshooting.md: no message of ours is {message!r}"
    for code in first_column(document, "fault"):
        if code not in codes:
            yield f"docs/troubleshooting.md: no fault is {code!r}"


def constants(tree: ast.Module) -> int:
    """Return how many names in capitals a module assigns."""
    assigned = (node for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign))
    targets = chain.from_iterable(node.targets if isinstance(node, ast.Assign) else [node.target] for node in assigned)
    walked = chain.from_iterable(map(ast.walk, targets))
    names = [node.id for node in walked if isinstance(node, ast.Name)]
    return sum(bool(re.fullmatch("_?[A-Z][A-Z0-9_]*", name)) for name in names)


def counted() -> dict[tuple[str, str], int]:
    """Return the size of each room, by room and measure, as in the table of ceilings."""
    sizes = {("documents", "words"): sum(len(text_of(path).split()) for path in DOCUMENTS)}
    for room, patterns in ROOMS.items():
        entries = chain.from_iterable(ROOT.glob(pattern) for pattern in patterns)
        files = list(chain.from_iterable(entry.rglob("*.py") if entry.is_dir() else [entry] for entry in entries))
        trees = [ast.parse(text_of(file)) for file in files]
        sizes[room, "statements"] = sum(isinstance(node, ast.stmt) for tree in trees for node in ast.walk(tree))
        sizes[room, "files"] = len(files)
        sizes[room, "constants"] = sum(map(constants, trees))
    return sizes


def ceilings() -> dict[tuple[str, str], int]:
    """Return the table of ceilings."""
    rows = (line.split() for line in text_of(CEILINGS).splitlines() if line and not line.startswith("#"))
    return {(room, measure): int(figure) for room, measure, figure in rows}


def above_ceilings() -> Iterator[str]:
    """Yield each room that is larger than its ceiling."""
    sizes = counted()
    for (room, measure), most in ceilings().items():
        if (size := sizes[room, measure]) > most:
            yield f"{room}: {size} {measure}; at most {most} ({CEILINGS.relative_to(ROOT)})"


def lower() -> None:
    """Lower each ceiling to what is there; none rises."""
    sizes = counted()
    head = [line for line in text_of(CEILINGS).splitlines() if line.startswith("#")]
    least = {key: min(most, sizes[key]) for key, most in ceilings().items()}
    rows = [f"{room:10}{measure:12}{figure:>6}" for (room, measure), figure in least.items()]
    CEILINGS.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")


RULES = (links_and_paths, safety_case, quoted_messages, above_ceilings)

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Check the rules of this repository.")
    parser.add_argument("--lower", action="store_true", help="first lower the ceilings to what is there")
    if parser.parse_args().lower:
        lower()
    problems = [problem for rule in RULES for problem in rule()]
    print(*problems, sep="\n", end="\n" if problems else "")
    raise SystemExit(1 if problems else 0)
