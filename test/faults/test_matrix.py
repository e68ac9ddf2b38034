# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The fault matrix in virtual time: every row is safe, by the arm's true motion, and deliberate defects are seen."""

from contextlib import suppress

import pytest

from ..support.thorough import quick
from .defects import DEFECTS, Defect, find
from .virtual import play
from .virtual_cases import PAPERS, ROWS

BY_NAME = {case.name: case for case in ROWS}


@pytest.mark.parametrize("name", quick([case.name for case in PAPERS], BY_NAME))
def test_the_arm_is_safe(name: str) -> None:
    played = play(BY_NAME[name])
    assert not played.unsafe, f"{played.unsafe}: {played}"


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.name)
def test_a_defect_replaces_what_exists_and_has_rows_that_are_meant_to_see_it(defect: Defect) -> None:
    assert BY_NAME.keys() >= set(defect.rows)
    with defect.here():
        assert all(find(target) for target in defect.patches)


@pytest.mark.thorough
@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.name)
def test_a_row_sees_the_defect(defect: Defect) -> None:
    unsafe = []
    with defect.here():
        for name in defect.rows:
            with suppress(RuntimeError):  # the arm is not carried: that shows nothing
                unsafe.append(play(BY_NAME[name], is_fresh=True).unsafe)
    assert any(unsafe)
