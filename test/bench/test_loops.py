# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How the benchmark compares loops that take turns, and what it says of one that carries no arm."""

from __future__ import annotations

import numpy as np
import pytest

from bench import loops
from bench.loop import ONE_ARM, LoopRun
from bench.timing import LoopTiming

pytestmark = pytest.mark.thorough


def run(latency: float) -> LoopRun:
    timing = LoopTiming(np.full(100, latency), np.full(100, 2e-3), 100, 0, 0, 0, 0)
    return LoopRun([timing], {"right/can_bridge": 0.2}, 2.0)


def test_a_loop_that_does_not_carry_the_arm_is_left_out_of_its_turn(monkeypatch):
    def play(kind, *_):
        if kind == "rclpy":
            raise RuntimeError("the arm was let down")
        return run(1e-3)

    monkeypatch.setattr(loops, "run_loop", play)
    said: list[str] = []
    assert set(loops.run_turn(500, ONE_ARM, 5.0, said.append)) == {"nodes", "one process", "python"}
    assert said == ["  rclpy: the arm was let down"]
    (row,) = loops.rows_of("loop", 500, [{"python": run(1e-3)}], "nodes")
    assert (row.name, row.ours) == ("loop, missed (it did not run): limit", 100.0)


def test_runs_are_compared_turn_by_turn():
    turns = [
        {"nodes": run(2e-3), "python": run(1e-3)},
        {"nodes": run(6e-3), "python": run(2e-3)},
        {"nodes": run(3e-3)},
    ]
    rows = {row.name: row for row in loops.rows_of("loop", 500, turns, "nodes")}
    compared, limited = rows["loop, p99: Python without ROS"], rows["loop, p99: one period"]
    assert (compared.ours, compared.peer, compared.spread) == (4.0, 1.5, "2 to 6, x2 to 3")
    assert (limited.ours, limited.peer) == (3.0, 2.0)
