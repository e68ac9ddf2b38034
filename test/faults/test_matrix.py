# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The fault matrix in virtual time: every row is safe, by the arm's true motion."""

from __future__ import annotations

import pytest

from ..support.thorough import quick
from .virtual import play
from .virtual_cases import PAPERS, ROWS

BY_NAME = {case.name: case for case in ROWS}


@pytest.mark.parametrize("name", quick([case.name for case in PAPERS], BY_NAME))
def test_the_arm_is_safe(name: str) -> None:
    played = play(BY_NAME[name])
    assert not played.unsafe, played
