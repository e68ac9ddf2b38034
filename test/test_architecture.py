"""Which package may import which, and the rules for every file."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "exo_gravity"
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
MAY_IMPORT = {
    "core": {"core"},
    "hardware": {"core", "hardware"},
    "sim": {"core", "hardware", "sim"},
    "lab": {"core", "hardware", "sim", "lab"},
    "panel": {"core", "sim", "lab", "panel"},
    "nodes": {"core", "hardware", "sim", "lab", "panel", "nodes"},
    "tools": {"core", "hardware", "sim", "lab", "tools"},
}
# `doctor` asks whom the nodes' settings let in.
EXCEPTIONS = {
    "exo_gravity/tools/doctor.py": {"nodes"},
    "exo_gravity/lab/calibration/imu.py": {"tools"},
    "exo_gravity/lab/calibration/live.py": {"tools"},
    "exo_gravity/lab/report/video.py": {"tools"},
    "exo_gravity/lab/trial/run.py": {"tools"},
}
# The path of a torque: what a torque depends on. It imports nothing that looks at arms from outside.
PATH_NODES = ("can_bridge", "compensator", "imu", "ros")
# The rooms of core from the bottom up: each imports only those before it, and itself.
FLOORS = ("errors", "numbers", "params", "motors", "arm", "trunk", "safety", "compensation")
MOST_ENTRIES = 12  # on core's first floor


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def package(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def room(path: Path) -> str:
    """Return the part of core that a file belongs to."""
    return path.relative_to(PACKAGE / "core").parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    """Return the modules that a file imports, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def ours(path: Path, depth: int) -> set[str]:
    """Return the parts of the package, at `depth` of the dotted name, that a file imports."""
    parts = (module.split(".") for module in imported(path) if module.startswith("exo_gravity."))
    return {part[depth] for part in parts if len(part) > depth}


def breaches(
    rule: Callable[[Path], set[str]], where: Callable[[Path], bool] = lambda path: True
) -> dict[str, set[str]]:
    """Return the files that break a rule, each with what breaks it."""
    found = {name(path): rule(path) for path in TREES if where(path)}
    return {path: problem for path, problem in found.items() if problem}


def test_a_module_imports_only_what_its_package_may() -> None:
    def forbidden(path: Path) -> set[str]:
        return ours(path, 1) - MAY_IMPORT[package(path)] - EXCEPTIONS.get(name(path), set())

    assert not breaches(forbidden, lambda path: package(path) in MAY_IMPORT)


def test_core_imports_only_numpy_and_the_standard_library() -> None:
    def forbidden(path: Path) -> set[str]:
        roots = {module.split(".")[0] for module in imported(path)}
        others = roots - {"exo_gravity", "numpy"} - sys.stdlib_module_names
        return others | (roots & {"time", "socket", "subprocess", "threading"})

    assert not breaches(forbidden, lambda path: package(path) == "core")


def test_no_arrow_in_core_leads_upward() -> None:
    def upward(path: Path) -> set[str]:
        core = {module.split(".")[2] for module in imported(path) if module.startswith("exo_gravity.core.")}
        return core & set(FLOORS[FLOORS.index(room(path)) + 1 :])

    assert not breaches(upward, lambda path: package(path) == "core" and room(path) != "__init__")


def test_the_first_floor_of_core_has_at_most_twelve_entries() -> None:
    entries = {path.name for path in (PACKAGE / "core").iterdir() if path.name[0] != "_" and path.name != "py.typed"}
    assert entries <= {*FLOORS, *(f"{floor}.py" for floor in FLOORS)} and len(entries) <= MOST_ENTRIES


def test_no_module_imports_itself_by_a_circle() -> None:
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in TREES}
    below = {module: {m for m in imported(path) if m in modules and m != module} for module, path in modules.items()}
    while leaves := {module for module, needs in below.items() if not needs & below.keys()}:
        below = {module: needs for module, needs in below.items() if module not in leaves}
    assert not below


def test_only_nodes_import_rclpy() -> None:
    def rclpy(path: Path) -> set[str]:
        return {module.split(".")[0] for module in imported(path)} & {"rclpy"}

    assert not breaches(rclpy, lambda path: package(path) != "nodes")


def test_only_tools_print() -> None:
    def prints(path: Path) -> set[str]:
        calls = (node.func for node in ast.walk(TREES[path]) if isinstance(node, ast.Call))
        return {call.id for call in calls if isinstance(call, ast.Name)} & {"print"}

    assert not breaches(prints, lambda path: package(path) != "tools")


def test_every_module_has_a_docstring() -> None:
    assert not [name(path) for path, tree in TREES.items() if tree.body and not ast.get_docstring(tree)]


def test_no_class_name_is_used_twice() -> None:
    where: dict[str, list[str]] = {}
    for path, tree in TREES.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where.setdefault(node.name, []).append(name(path))
    assert not {found: paths for found, paths in where.items() if len(paths) > 1}


@pytest.mark.parametrize(
    ("module", "names"),
    [
        ("core", "ArmModel Tilt Wearer gravity_torque paper_mobile_torque paper_static_torque"),
        ("core.motors", "MOTORS pack_command pack_reply unpack_command unpack_reply"),
        ("hardware", "ImuSample TrunkEstimator"),
    ],
)
def test_the_library_has_the_names_that_others_import(module: str, names: str) -> None:
    library = importlib.import_module(f"exo_gravity.{module}")
    assert not [missing for missing in names.split() if not hasattr(library, missing)]
