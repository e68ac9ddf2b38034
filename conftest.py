"""Which tests `colcon test` runs: those whose packages are installed, without the ones that need a quiet machine.

A ROS host has what package.xml names; MuJoCo, Pinocchio and others come from PyPI alone. Under colcon, which sets
COLCON=1, a test file that needs a missing package is therefore left out, and the end of the run lists those packages.
Elsewhere (`make test`) a missing package is an error.
"""

from __future__ import annotations

import ast
import os
import re
from collections import Counter
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parent
UNDER_COLCON = "COLCON" in os.environ
# What a file starts as a process or by its path needs its packages too.
STARTS = {
    "test/support/launched_nodes.py": ("exo_gravity.nodes.simulator", "exo_gravity.nodes.imu"),
    "test/test_docs.py": ("docs.tables",),
    "test/test_examples.py": ("examples.simulated_loop", "examples.emg_assistance", "examples.teach_and_repeat"),
}
left_out: Counter[str] = Counter()


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
    missing, files, todo = set(), {path}, [path]
    while todo:
        more, absent = direct_needs(todo.pop())
        missing |= absent
        todo += more - files
        files |= more
    return missing


def pytest_configure(config: pytest.Config) -> None:
    """Leave out the tests that need a quiet machine, unless `-m` selects others."""
    if UNDER_COLCON and not config.option.markexpr:
        config.option.markexpr = "not real_time"


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out a test file, or a folder's conftest.py with the folder, that needs a missing package."""
    file = collection_path / "conftest.py" if collection_path.is_dir() else collection_path
    if not UNDER_COLCON or file == Path(__file__) or file.suffix != ".py" or not file.is_file():
        return None
    missing = missing_packages(file)
    left_out.update(missing)
    return True if missing else None


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the packages whose absence left tests out."""
    for package, files in sorted(left_out.items()):
        terminalreporter.write_line(f"not installed: {package}, which {files} test files or folders need")
