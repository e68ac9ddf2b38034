# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters of a test of which `make test` plays only some."""

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def quick(some: Sequence[Any], cases: Iterable[Any]) -> list[Any]:
    """Return `cases` as parameters of a test, all but `some` marked as thorough. A tuple has a value per parameter."""
    cases = list(cases)
    assert all(case in cases for case in some), "a case that is to be quick does not exist"
    return [
        case
        if case in some
        else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.thorough)
        for case in cases
    ]
