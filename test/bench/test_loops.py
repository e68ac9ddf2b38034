# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How often the benchmark repeats a run, what it says of one that was disturbed."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from bench import loop, loops
from bench.loop import LoopRun
from bench.table import show
from bench.timing import LoopTiming

pytestmark = pytest.mark.thorough

TIMING = LoopTiming(np.full(100, 1e-3), np.full(100, 2e-3), 100, 0, 0, 0, 0)


def run(stolen: float = 0.0, others: float = 0.0) -> LoopRun:
    return LoopRun([TIMING], {}, stolen, others, 2.0)


@pytest.fixture
def play(monkeypatch):
    """Let `results` be those of the runs in turn; return the run that is kept, and how many were made."""

    def play(*results):
        waiting = list(results)

        def next_run(*_):
            result = waiting.pop(0)
            if isinstance(result, Exception):
                raise result
            return result

        monkeypatch.setattr(loops, "run_loop", next_run)
        kept = loops.quietest_run("nodes", 500, loop.ONE_ARM, 5.0, lambda _: None)
        return kept, len(results) - len(waiting)

    return play


def test_a_disturbed_run_is_repeated_once_and_the_less_disturbed_one_is_kept(play):
    quiet, worse, bad = run(0.009, 0.09), run(0.5), run(0.0, 0.3)
    assert play(quiet, bad, bad) == (quiet, 1)
    assert play(bad, quiet, bad) == (quiet, 2)
    assert play(bad, worse, quiet) == (bad, 2)


def test_a_rate_at_which_no_run_carries_the_arm_ends_too(play):
    error = RuntimeError("the arm was let down")
    assert play(error, error, run()) == (None, 2)


@pytest.mark.parametrize(
    ("ours", "python", "marked"),
    [(run(), run(), (False, False)), (run(), run(0.02), (False, True)), (run(0.0, 0.2), run(), (True, True))],
)
def test_a_figure_says_that_it_or_its_peer_was_disturbed(ours, python, marked):
    rows = {row.name: row for row in loops.rows_of("loop", 500, {"nodes": ours, "python": python}, "nodes")}
    compared = rows["loop, p99: one period"], rows["loop, p99: Python without ROS"]
    assert tuple(row.disturbed for row in compared) == marked
    console = Console(width=150, file=io.StringIO())
    show(compared, console)
    assert console.file.getvalue().count("disturbed") == sum(marked)
