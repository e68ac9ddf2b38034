# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`colcon test` leaves out the test files whose packages are missing, and no others."""

from collections import Counter

import pytest

from . import conftest
from .support import ROOT, selection


@pytest.fixture(autouse=True)
def without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under colcon, on a computer that has every package but MuJoCo."""
    monkeypatch.setattr(selection, "find_spec", lambda name: None if name == "mujoco" else name)
    monkeypatch.setattr(conftest, "UNDER_COLCON", True)
    monkeypatch.setattr(conftest, "left_out", Counter())
    selection.is_missing.cache_clear()
    selection.direct_needs.cache_clear()


@pytest.mark.parametrize(
    "path",
    [
        "test/sim/test_arm.py",  # imports it
        "test/nodes/test_stack.py",  # starts a node that imports it
        "test/hardware",  # its conftest.py imports it
    ],
)
def test_a_file_that_needs_a_missing_package_is_left_out(path: str) -> None:
    assert conftest.pytest_ignore_collect(ROOT / path) is True
    assert conftest.left_out["mujoco"] == 1


def test_a_file_that_does_not_need_it_is_kept() -> None:
    assert conftest.pytest_ignore_collect(ROOT / "test/core/test_motors.py") is None


def test_outside_of_colcon_nothing_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conftest, "UNDER_COLCON", False)
    assert conftest.pytest_ignore_collect(ROOT / "test/sim/test_arm.py") is None
