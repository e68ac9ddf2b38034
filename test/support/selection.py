# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which packages a test file needs: what it imports, what that imports, and what it starts as a process."""

from __future__ import annotations

import ast
import os
import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from . import ROOT

UNDER_COLCON = "COLCON" in os.environ  # on a ROS host, which has what package.xml names

# What a file starts as a process or by its path needs its packages too.
STARTS = {
    "test/support/launched_nodes.py": ("exo_gravity.nodes.simulator", "exo_gravity.nodes.imu"),
    "test/test_examples.py": ("examples.simulated_loop", "examples.emg_assistance", "examples.teach_and_repeat"),
}


def imports(path: Path) -> tuple[str, ...]:
    """Return the modules that a file imports, also inside functions; `from a import b` gives a and a.b."""
    package = path.relative_to(ROOT).parent.parts
    found: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *filter(None, [node.module])))
            found += [module, *(f"{module}.{alias.name}" for alias in node.names)]
    return tuple(found)


@cache
def file_of(module: str) -> Path | None:
    """Return the file of a module, None if the module is not in this repository."""
    path = ROOT.joinpath(*module.split("."))
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((candidate for candidate in candidates if candidate.is_file()), None)


@cache
def is_missing(package: str) -> bool:
    """Return whether a package is neither in this repository nor installed."""
    return not (ROOT / package).is_dir() and not find_spec(package)


@cache
def direct_needs(path: Path) -> tuple[frozenset[Path], frozenset[str]]:
    """Return the files of this repository that a file imports, and the packages that it needs and that are missing."""
    names = {*imports(path), *STARTS.get(str(path.relative_to(ROOT)), ())}
    # A module's packages are imported before it.
    prefixes = {name[:end] for name in names for end in (*(dot.start() for dot in re.finditer(r"\.", name)), len(name))}
    roots = {name.partition(".")[0] for name in names}
    return frozenset(filter(None, map(file_of, prefixes))), frozenset(filter(is_missing, roots))


def missing_packages(path: Path) -> set[str]:
    """Return the packages that a file needs, through what it imports too, and that are not installed."""
    missing: set[str] = set()
    files, todo = {path}, [path]
    while todo:
        more, absent = direct_needs(todo.pop())
        missing |= absent
        todo += more - files
        files |= more
    return missing
