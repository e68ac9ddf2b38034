# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Short versions of `make study NAME=ordinary`, where ordinary equipment lets no arm down, and of the IMU report."""

import pytest

from bench.imu_report import read_trials, report
from bench.ordinary.__main__ import is_quiet
from bench.ordinary.rows import EQUIPMENT, Row

from ..support.thorough import quick

pytestmark = pytest.mark.thorough

ROWS = (
    (Row("paper", EQUIPMENT[1], False, 100.0, "loop, work of 0.5 and 2 ms"), 0.5),
    (Row("paper", EQUIPMENT[2], True, 100.0, "arrival, 16 ms timer of an FTDI adapter"), 0.5),
    (Row("seven joints", EQUIPMENT[2], False, 100.0, ""), 1.2),  # Nm, of an arm that is twice as heavy
)


@pytest.mark.parametrize(("row", "most"), quick(ROWS[:1], ROWS), ids=lambda value: getattr(value, "name", ""))
def test_ordinary_equipment_carries_an_arm_without_an_alarm(row, most):
    result = row.play(1.0, carried=2.0)
    assert is_quiet(result) and result.starts and not result.refused_samples, result
    assert 0.0 < result.largest_error < most


def test_the_imus_report_has_a_row_for_each_trial_and_a_column_for_each_method():
    lines = report(list(read_trials())[:1]).splitlines()
    assert len(lines) == 4 and lines[0].startswith("| trial | here | published |")
    assert lines[2].startswith("| 03 undisturbed slow rotation C | 0.")
