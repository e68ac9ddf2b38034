# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""ament's linters: `colcon test` and `make lint` run them."""

from __future__ import annotations

import pytest
from ament_flake8.main import main_with_errors
from ament_pep257.main import main as pep257

from .support import ROOT

# Not D104: an empty __init__.py needs no docstring. D105, D107: the class's docstring covers its operators and
# __init__. D401: ament_pep257 wants the imperative of properties too; ruff exempts them. D402 takes `torque (4,)`, a
# shape, for the signature of torque().
IN_CODE = ("D104", "D105", "D107", "D401", "D402")
IN_TESTS = ("D100", "D101", "D102", "D103", "D104", "D105", "D107", "D401")  # a test's name is its sentence
FOLDERS = {
    "exo_gravity": IN_CODE, "bench": IN_CODE, "docs": IN_CODE, "examples": IN_CODE, "launch": IN_CODE, "test": IN_TESTS
}  # fmt: skip


@pytest.mark.timeout(300)
def test_flake8() -> None:
    code, errors = main_with_errors(["--config", str(ROOT / "setup.cfg"), str(ROOT)])
    assert code == 0, "\n".join(errors)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("folder", FOLDERS)
def test_pep257(folder: str) -> None:
    files = sorted(str(path) for path in (ROOT / folder).rglob("*.py"))
    assert pep257(["--convention", "pep257", "--add-ignore", *FOLDERS[folder], "--", *files]) == 0
