"""The safety case names the rows of the fault matrix, all of them and no others."""

import re
from pathlib import Path

from .faults.cases import CASES

TEXT = (Path(__file__).parents[1] / "docs" / "safety.md").read_text(encoding="utf-8")


def rows_named() -> list[str]:
    """Return the names in the last column of the tables headed `rows`."""
    named = []
    for table in re.findall(r"\| cause \|.*?\| rows \|\n\|[-|]+\n((?:\|.*\n)+)", TEXT):
        for line in table.splitlines():
            named += re.findall(r"`([^`]+)`", line.split(" | ")[-1])
    return named


def test_every_row_of_the_fault_matrix_is_in_the_safety_case_once_and_under_its_own_name() -> None:
    assert sorted(rows_named()) == sorted(case.name for case in CASES)
