"""Some cases of the fault matrix, judged as `make faults` does, apart from the reaction time."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from ..faults.cases import CASES
from ..faults.fault_case import FaultCase
from ..faults.mutations import MUTATIONS, Mutation, apply
from ..faults.runner import RigPool
from ..support import ROOT

CHOSEN = [case for case in CASES if case.in_tests]


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RigPool]:
    with RigPool(tmp_path_factory.mktemp("faults"), shipped_timeouts=False) as pool:
        yield pool


@pytest.mark.real_time
@pytest.mark.thorough
@pytest.mark.parametrize("case", CHOSEN, ids=[case.name for case in CHOSEN])
def test_after_a_fault_the_arm_is_let_down_gently_and_stays_off(pool: RigPool, case: FaultCase) -> None:
    result = pool.run(case)
    assert result["unsafe"] == "", result


@pytest.mark.parametrize("mutation", MUTATIONS, ids=[mutation.name for mutation in MUTATIONS])
def test_each_deliberate_defect_can_be_applied_and_has_rows_that_are_meant_to_see_it(
    mutation: Mutation, tmp_path: Path
) -> None:
    for edit in mutation.edits:
        (tmp_path / edit.file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / edit.file, tmp_path / edit.file)
    apply(mutation, tmp_path)
    assert set(mutation.rows) <= {case.name for case in CASES}
