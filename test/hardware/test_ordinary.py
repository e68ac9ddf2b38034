"""The short version of `make ordinary`: ordinary equipment refuses no start and lets no arm down."""

from __future__ import annotations

import pytest

from bench.ordinary.__main__ import is_quiet
from bench.ordinary.rows import EQUIPMENT, Row

ROWS = (
    Row(EQUIPMENT[1], False, 250.0, "loop, work of 0.5 and 2 ms"),
    Row(EQUIPMENT[2], True, 100.0, "arrival, 16 ms timer of an FTDI adapter"),
)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_ordinary_equipment_carries_an_arm_without_an_alarm(row):
    result = row.play(1.0, carried=4.0)
    assert is_quiet(result), result
    assert result.starts and not result.refused_samples
    assert 0.0 < result.largest_error < 0.5
