"""The deliberate defects of `make study NAME=mutations` match the source that they change."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ..faults.cases import CASES
from ..faults.mutations import MUTATIONS, Mutation, apply
from ..support import ROOT


@pytest.mark.parametrize("mutation", MUTATIONS, ids=[mutation.name for mutation in MUTATIONS])
def test_each_deliberate_defect_can_be_applied_and_has_rows_that_are_meant_to_see_it(
    mutation: Mutation, tmp_path: Path
) -> None:
    for edit in mutation.edits:
        (tmp_path / edit.file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / edit.file, tmp_path / edit.file)
    apply(mutation, tmp_path)
    assert set(mutation.rows) <= {case.name for case in CASES}
