"""Which package may import which, and the rules for every file."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "exo_gravity"
FILES = sorted(PACKAGE.rglob("*.py"))
MAY_IMPORT = {
    "core": {"core"},
    "hardware": {"core", "hardware"},
    "sim": {"core", "sim"},
    "nodes": {"core", "hardware", "sim", "bag", "panel", "nodes"},
    "bag": {"core", "bag"},
    "panel": {"core", "panel"},
    "tools": {"core", "bag", "tools"},
}
# `trial --offline` runs without ROS, so it starts no nodes and uses the simulated device directly. `calibrate motors`
# asks the motors before there is anything that a node could be started with.
EXCEPTIONS = {
    "exo_gravity/tools/trials/offline.py": {"sim"},
    "exo_gravity/tools/trials/simulated_effort.py": {"sim"},
    "exo_gravity/tools/trials/trunk_imu.py": {"sim", "hardware"},
    "exo_gravity/tools/calibration/motors.py": {"hardware"},
}


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def package(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", [p for p in FILES if package(p) in MAY_IMPORT], ids=name)
def test_a_module_imports_only_what_its_package_may(path):
    ours = {module.split(".")[1] for module in imported(path) if module.startswith("exo_gravity.")}
    assert ours <= MAY_IMPORT[package(path)] | EXCEPTIONS.get(name(path), set())


@pytest.mark.parametrize("path", [p for p in FILES if package(p) == "core"], ids=name)
def test_core_imports_only_numpy_and_the_standard_library(path):
    roots = {module.split(".")[0] for module in imported(path)}
    assert roots - {"exo_gravity", "numpy"} <= sys.stdlib_module_names
    assert not roots & {"time", "socket", "subprocess", "threading"}


@pytest.mark.parametrize("path", [p for p in FILES if package(p) != "nodes"], ids=name)
def test_only_nodes_import_rclpy(path):
    assert "rclpy" not in {module.split(".")[0] for module in imported(path)}


@pytest.mark.parametrize("path", [p for p in FILES if package(p) != "tools"], ids=name)
def test_only_tools_print(path):
    calls = (n.func for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call))
    assert "print" not in {call.id for call in calls if isinstance(call, ast.Name)}


@pytest.mark.parametrize("path", FILES, ids=name)
def test_every_module_has_a_docstring(path):
    text = path.read_text(encoding="utf-8")
    assert not text.strip() or ast.get_docstring(ast.parse(text))
