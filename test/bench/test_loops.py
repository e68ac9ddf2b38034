# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How often the benchmark repeats a run, what it says of one that was disturbed, and on which cores it runs."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from rich.console import Console

from bench import loop, loops
from bench.direct_arm import Starting
from bench.loop import LoopRun
from bench.table import show
from bench.timing import LoopTiming
from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.safety.drive import Drive, Send
from exo_gravity.hardware.can.motor_bus import MotorBus

from ..hardware.rig import CYCLE, VirtualRig

TIMING = LoopTiming(np.full(100, 1e-3), np.full(100, 2e-3), 100, 0, 0, 0, 0)


def run(stolen: float = 0.0, others: float = 0.0) -> LoopRun:
    return LoopRun([TIMING], {}, stolen, others, 2.0, [])


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


def test_nodes_that_did_not_run_are_excused_where_their_peers_were_disturbed():
    for peer in (run(), run(0.0, 0.2)):
        (row,) = loops.rows_of("loop", 500, {"python": peer}, "nodes")
        assert row.ours == 100.0 and row.disturbed is peer.is_disturbed


def test_what_is_started_while_pinned_runs_on_at_most_two_of_the_permitted_cores():
    permitted = os.sched_getaffinity(0)
    with loop.pinned():
        code = "import os; print(sorted(os.sched_getaffinity(0)))"
        printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        assert printed.strip() == str(sorted(os.sched_getaffinity(0)))
        assert len(os.sched_getaffinity(0)) == min(loop.CORES, len(permitted))
    assert os.sched_getaffinity(0) == permitted


def test_the_time_of_a_child_is_our_own_and_not_that_of_other_programs():
    before = loop.own_time()
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        end = time.monotonic() + 30.0
        while loop.cpu_time(busy.pid) < 0.2 and time.monotonic() < end:
            time.sleep(0.05)
        assert loop.own_time() - before >= 0.2
    finally:
        busy.kill()
        busy.wait()


def test_a_peer_switches_a_motor_on_whose_first_enter_is_lost():
    rig = VirtualRig(pose=NO_TORQUE, carried=False)
    bus = MotorBus(rig.arm.ports(rig.clock), rig.motors, clock=rig.clock)
    starting, motor, enters = Starting(bus.replies), rig.device.motors[1], 0
    for _ in range(100):
        enters += starting.send[1] is Send.ENTER
        motor.unplugged = enters == 1
        begin = rig.clock.monotonic()
        starting.note(bus.exchange(Drive(NO_TORQUE, NO_TORQUE, starting.send, True), begin + CYCLE))
        rig.clock.sleep(max(0.0, begin + CYCLE - rig.clock.monotonic()))
    assert enters > 1 and rig.motors_on == [True] * 4
