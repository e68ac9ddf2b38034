"""Some cases of the fault matrix, judged as `make faults` does, apart from the reaction time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ..faults.cases import CASES
from ..faults.fault_case import FaultCase
from ..faults.runner import RigPool

pytestmark = pytest.mark.real_time

CHOSEN = [case for case in CASES if case.in_tests]


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RigPool]:
    with RigPool(tmp_path_factory.mktemp("faults"), shipped_timeouts=False) as pool:
        yield pool


@pytest.mark.parametrize("case", CHOSEN, ids=[case.name for case in CHOSEN])
def test_after_a_fault_the_arm_is_let_down_gently_and_stays_off(pool: RigPool, case: FaultCase) -> None:
    result = pool.run(case)
    assert result["unsafe"] == "", result
