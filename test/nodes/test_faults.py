"""The fault matrix in short: one row of each kind, judged as `make faults` does, but for the time it takes."""

import pytest

from ..faults.rows import ROWS
from ..faults.run import Theatre

pytestmark = pytest.mark.real_time

SHORT = [row for row in ROWS if row.short]


@pytest.fixture(scope="module")
def theatre(tmp_path_factory):
    theatre = Theatre(tmp_path_factory.mktemp("faults"), punctual=False)
    yield theatre
    theatre.close()


@pytest.mark.parametrize("row", SHORT, ids=[row.name for row in SHORT])
def test_a_fault_lets_the_arm_down_gently_and_nothing_switches_it_on_again(theatre, row):
    line = theatre.play(row)
    assert line["unsafe"] == "", line
