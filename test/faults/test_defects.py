# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The deliberate defects of `make study NAME=mutations` can be injected here, and name rows of the fault matrix."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from .cases import CASES
from .injected import injected
from .injected.defects import DEFECTS, Defect, find
from .mutations import unsafe_in_virtual_time
from .virtual_cases import ROWS


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.name)
def test_each_defect_replaces_something_and_has_rows_that_are_meant_to_see_it(
    defect: Defect,
) -> None:
    before = {target: find(target)[2] for target in defect.patches}
    with defect.here():
        assert all(find(target)[2] is not original for target, original in before.items())
    assert all(find(target)[2] is original for target, original in before.items())
    names = [{case.name for case in rows} for rows in (ROWS, CASES)]
    assert any(set(defect.rows) <= of_kind for of_kind in names)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "defect",
    [defect for defect in DEFECTS if {case.name for case in ROWS}.issuperset(defect.rows)],
    ids=lambda defect: defect.name,
)
def test_a_row_in_virtual_time_sees_the_defect(defect: Defect) -> None:
    assert unsafe_in_virtual_time(defect)


def test_a_process_that_cannot_have_its_defect_does_not_start() -> None:
    with injected(EXO_TEST_DEFECT="no such defect"):
        done = subprocess.run([sys.executable, "-c", "print('runs')"], capture_output=True, text=True)
    assert done.returncode == 3 and "no defect 'no such defect'" in done.stderr and not done.stdout
    assert "EXO_TEST_DEFECT" not in os.environ
