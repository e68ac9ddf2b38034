# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The walls: which part of the package may import which.

The path of a torque is what a torque depends on: core, hardware, and the nodes can_bridge, compensator and imu. It
imports nothing that looks at arms from outside.
"""

import ast
import functools
import importlib
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from .support.waiting import PATIENCE

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "exo_gravity"
TORQUE_NODES = ("nodes.can_bridge", "nodes.compensator", "nodes.imu", "nodes.ros")
PATH = ("core", "hardware", *TORQUE_NODES)
# Each part by the beginnings of the module names that it may import; the longest part that fits a module counts.
MAY_IMPORT: dict[str, Iterable[str]] = {
    "core": ("core",),
    "hardware": ("core", "hardware"),
    **dict.fromkeys(TORQUE_NODES, PATH),
    "sim": ("core", "hardware", "sim"),
    "lab": ("core", "hardware", "sim", "lab"),
    "panel": ("core", "sim", "lab", "panel"),
    "nodes": ("core", "hardware", "sim", "lab", "panel", "nodes"),
    "tools": ("core", "hardware", "sim", "lab", "tools"),
}
# From the bottom up: a room imports only those before it, and itself.
ROOMS = {
    "core": ("vocabulary", "errors", "numbers", "params", "motors", "arm", "trunk", "safety", "compensation"),
    "hardware": (
        "clock",
        "network",
        "model_file",
        "can_port",
        "request_age",
        "motor_bus",
        "control_loop",
        "bus_lock",
        "owned_bus",
        "watchdog",
        "trunk_estimator",
        "imu_source",
        "urdf_checks",
        "urdf_model",
        "urdf_arm",
    ),
}


def module_of(path: Path) -> str:
    """Return the name of a module within the package: 'core.arm.tilt', 'nodes.imu', '' for the package itself."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").rstrip(".")


MODULES = {module_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def is_in(module: str, part: str) -> bool:
    return module == part or module.startswith(f"{part}.")


@functools.cache
def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


@functools.cache
def imported(module: str) -> set[str]:
    """Return the modules that a module imports, also inside functions; ours without the package's name."""
    names: set[str] = set()
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            # `from a import b`: a.b, where b is a module
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name for name in inner if name.removeprefix("exo_gravity.") in MODULES} or {node.module or ""}
    return {name.removeprefix("exo_gravity.") for name in names}


def ours(module: str) -> set[str]:
    """Return those of them that are ours."""
    return {name for name in imported(module) if name in MODULES}


def breaches(rule: Callable[[str], set[str]], part: str = "") -> dict[str, set[str]]:
    """Return the modules of a part that break a rule, each with what breaks it."""
    found = {module: rule(module) for module in MODULES if not part or is_in(module, part)}
    return {module: problem for module, problem in found.items() if problem}


def test_a_module_imports_only_what_its_part_may() -> None:
    def forbidden(module: str) -> set[str]:
        parts = [part for part in MAY_IMPORT if is_in(module, part)]
        allowed = MAY_IMPORT[max(parts, key=len)] if parts else ()
        return {name for name in ours(module) if not any(is_in(name, part) for part in allowed)}

    assert not breaches(forbidden)


@pytest.mark.parametrize("part", ROOMS)
def test_no_import_leads_upward_within(part: str) -> None:
    rooms = ROOMS[part]

    def room(module: str) -> str:
        return module.removeprefix(f"{part}.").partition(".")[0]

    def upward(module: str) -> set[str]:
        inside = {room(name) for name in ours(module) if name.startswith(f"{part}.")}
        return set() if module == part else inside & set(rooms[rooms.index(room(module)) + 1 :])

    assert not breaches(upward, part)


def test_core_imports_only_numpy_and_the_standard_library_without_clock_and_processes_and_nodes_alone_rclpy() -> None:
    def roots_of(module: str) -> set[str]:
        return {name.partition(".")[0] for name in imported(module) - ours(module)}

    def forbidden(module: str) -> set[str]:
        roots = roots_of(module)
        return roots - {"numpy", *sys.stdlib_module_names} | roots & {"time", "socket", "subprocess", "threading"}

    assert not breaches(forbidden, "core")
    assert all(is_in(module, "nodes") for module in breaches(lambda module: roots_of(module) & {"rclpy"}))


def test_no_module_imports_itself_by_a_circle() -> None:
    below = {module: ours(module) - {module} for module in MODULES}
    while leaves := {module for module, needs in below.items() if not needs & below.keys()}:
        below = {module: needs for module, needs in below.items() if module not in leaves}
    assert not below


def test_only_tools_print() -> None:
    def prints(module: str) -> set[str]:
        calls = (node.func for node in ast.walk(tree(module)) if isinstance(node, ast.Call))
        return {call.id for call in calls if isinstance(call, ast.Name)} & {"print"}

    assert not [module for module in breaches(prints) if not is_in(module, "tools")]


def test_studies_and_drawings_import_no_test() -> None:
    def of_test(path: Path) -> bool:
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        modules = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
        return any(is_in(module, "test") for module in modules)

    paths = (path for folder in ("bench", "docs", "examples") for path in (ROOT / folder).rglob("*.py"))
    assert not [path for path in paths if of_test(path)]


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


@pytest.mark.parametrize(
    ("modules", "missing"),
    [
        # What serves real arms needs no simulator.
        (("tools.trial", "tools.report", "lab.trial.analysis", "nodes.panel.node"), "mujoco"),
        # A start does not wait for what is only used later.
        (("core.compensation.compensator", "core.safety.machine", "hardware.urdf_arm"), "importlib.metadata"),
        (("tools.report", "lab.report.cohort", "lab.report.trial_report"), "matplotlib"),
    ],
)
def test_a_module_is_imported_without_what_it_may_not_need(modules: tuple[str, ...], missing: str) -> None:
    imports = "; ".join(f"import exo_gravity.{module}" for module in modules)
    program = f"import sys; sys.modules[{missing!r}] = None; {imports}"
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, timeout=PATIENCE)


def test_the_fits_of_calibrate_take_one_core() -> None:
    program = (
        "import os; os.environ.pop('OPENBLAS_NUM_THREADS', None); import exo_gravity.tools.calibrate; "
        "from threadpoolctl import threadpool_info; assert {pool['num_threads'] for pool in threadpool_info()} == {1}"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, timeout=PATIENCE)
