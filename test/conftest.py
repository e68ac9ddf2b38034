# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What holds for every test: a ROS domain of its own on this machine alone, and which tests `colcon test` runs.

A ROS host has what package.xml names; MuJoCo, Pinocchio and others come from PyPI alone. Under colcon, which sets
COLCON=1, a test file that needs a missing package is therefore left out, and the end of the run lists those packages.
Elsewhere (`make test`) a missing package is an error.
"""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from exo_gravity.hardware.clock import raise_priority

from .support.ports import own_domain
from .support.selection import UNDER_COLCON, missing_packages
from .support.stalls import Machine

LINTERS = "test_linters.py"  # elsewhere `make lint` runs it
left_out: Counter[str] = Counter()

os.environ["ROS_DOMAIN_ID"] = str(own_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


@pytest.fixture(scope="session")
def machine() -> Iterator[Machine]:
    """The machine for one test of running nodes at a time, which tells what it kept from them."""
    if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
        pytest.fail("tests marked real_time run alone: use `-m real_time` without -n")
    raise_priority(5)  # what a test receives is in time
    machine = Machine()
    yield machine
    machine.close()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--every", type=int, default=1, metavar="N", help="of the selected tests run only every Nth")


def pytest_configure(config: pytest.Config) -> None:
    """Leave out what needs a quiet machine, and the longer tests, unless `-m` selects others."""
    if UNDER_COLCON and not config.option.markexpr:
        config.option.markexpr = "not (real_time or browser or thorough)"


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out a test file, or a folder's conftest.py with the folder, that needs a missing package."""
    file = collection_path / "conftest.py" if collection_path.is_dir() else collection_path
    if file.name == LINTERS and not UNDER_COLCON:
        return True
    if not UNDER_COLCON or file == Path(__file__) or file.suffix != ".py" or not file.is_file():
        return None
    missing = missing_packages(file)
    left_out.update(missing)
    return True if missing else None


@pytest.hookimpl(trylast=True)  # once `-m` and `-k` have selected
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave all but every Nth test out (--every), and give those of running nodes the machine."""
    items[:] = items[:: config.option.every]
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("real_time"):
            item.fixturenames.insert(0, "machine")


def pytest_collection_finish() -> None:
    """Leave what was collected to no later garbage collection: each would go through it, a fifth of the time."""
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Judge what running nodes did, unless the machine stood still meanwhile: then the test warns of that instead."""
    if pyfuncitem.get_closest_marker("real_time"):
        with pyfuncitem.funcargs["machine"].keeps_up():
            yield
        return True
    return (yield)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the packages whose absence left tests out."""
    for package, files in sorted(left_out.items()):
        terminalreporter.write_line(f"not installed: {package}, which {files} test files or folders need")
