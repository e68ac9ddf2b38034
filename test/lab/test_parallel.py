# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Work on many items in processes: an outcome for each, also where one of them ends its process."""

from __future__ import annotations

import os

from exo_gravity.lab.parallel import ENDED, Outcome, in_processes

ENDS_ITS_PROCESS, RAISES = 3, 4


def work(item: int) -> int:
    """Return the square of most numbers."""
    if item == ENDS_ITS_PROCESS:
        os._exit(1)
    if item == RAISES:
        raise RuntimeError("not this one")
    return item * item


def test_every_item_has_one_outcome_also_when_a_process_dies():
    outcomes = sorted(in_processes(work, range(8), workers=2), key=lambda outcome: outcome.item)
    expected = [Outcome(item, item * item) for item in range(8)]
    expected[ENDS_ITS_PROCESS] = Outcome(ENDS_ITS_PROCESS, None, ENDED)
    expected[RAISES] = Outcome(RAISES, None, "RuntimeError: not this one")
    assert outcomes == expected
