# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`colcon test` leaves out the test files whose packages are missing, and no others."""

from collections import Counter

import pytest

from . import conftest
from .support import ROOT, selection


@pytest.mark.parametrize(
    ("path", "is_left_out"),
    [
        ("test/sim/test_arm.py", True),  # imports MuJoCo
        ("test/nodes/test_stack.py", True),  # starts a node that imports it
        ("test/hardware", True),  # its conftest.py imports it
        ("test/core/test_motors.py", None),
    ],
)
def test_a_file_that_needs_a_missing_package_is_left_out_under_colcon_alone(monkeypatch, path, is_left_out) -> None:
    monkeypatch.setattr(selection, "find_spec", lambda name: None if name == "mujoco" else name)
    monkeypatch.setattr(conftest, "left_out", Counter())
    for cached in (selection.is_missing, selection.direct_needs):
        cached.cache_clear()
    for under_colcon, expected in ((True, is_left_out), (False, None)):
        monkeypatch.setattr(conftest, "UNDER_COLCON", under_colcon)
        assert conftest.pytest_ignore_collect(ROOT / path) is expected
    assert conftest.left_out["mujoco"] == bool(is_left_out)
