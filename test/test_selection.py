"""`colcon test` leaves out the test files whose packages are missing, and no others."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def selection(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The repository's conftest.py on a computer without MuJoCo."""
    spec = importlib.util.spec_from_file_location("selection", ROOT / "conftest.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = importlib.util.find_spec
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == "mujoco" else found(name))
    monkeypatch.setattr(module, "UNDER_COLCON", True)
    return module


@pytest.mark.parametrize(
    "path",
    [
        "test/sim/test_arm.py",  # imports it
        "test/sim/test_truth.py",  # through a module's package
        "test/nodes/test_stack.py",  # starts a node that imports it
        "test/test_docs.py",  # runs a program that imports it
        "test/hardware",  # its conftest.py imports it
    ],
)
def test_a_file_that_needs_a_missing_package_is_left_out(selection: ModuleType, path: str) -> None:
    assert selection.pytest_ignore_collect(ROOT / path) is True
    assert selection.left_out["mujoco"] == 1


@pytest.mark.parametrize("path", ["test/core/test_motors.py", "test/core", "test/lab/bag/test_events.py"])
def test_a_file_that_does_not_need_it_is_kept(selection: ModuleType, path: str) -> None:
    assert selection.pytest_ignore_collect(ROOT / path) is None


def test_outside_of_colcon_nothing_is_left_out(selection: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "UNDER_COLCON", False)
    assert selection.pytest_ignore_collect(ROOT / "test/sim/test_arm.py") is None
