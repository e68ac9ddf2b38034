"""Each test run has its own ROS domain, and its nodes communicate on this machine only.

Nodes let the arm down when the machine stands still for longer than their time-outs, as they must. A test of running
nodes (marker `real_time`) then shows nothing about them. A stall clock therefore runs beside these tests: a test that
fails while the clock stood still, or in which nodes were late, fails with `Stalled` and runs again, at most twice.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from .support.launched_nodes import LaunchedNodes, prefer
from .support.stall_clock import StallClock

MOST_WORKERS = 2  # which the nodes of a test leave to others on two processors
STALL = 0.03  # s between two wake-ups of the clock

os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 100 + 1)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


class Stalled(AssertionError):
    """A test failed while the machine stood still."""


@pytest.fixture(scope="session")
def stall_clock() -> Iterator[StallClock]:
    """The clock that measures how long the machine stands still."""
    if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > MOST_WORKERS:
        pytest.fail(
            f"at most {MOST_WORKERS} tests marked real_time may run at once: use `-m real_time -n {MOST_WORKERS}`"
        )
    prefer(os.getpid())  # to nodes that start
    clock = StallClock()
    yield clock
    clock.close()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("real_time"):
            item.fixturenames.append("stall_clock")
            item.add_marker(pytest.mark.flaky(reruns=2, only_rerun="Stalled"))


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[None]:
    clock = pyfuncitem.funcargs.get("stall_clock")
    if not isinstance(clock, StallClock):
        return (yield)
    clock.longest_gap()
    LaunchedNodes.late.clear()
    try:
        return (yield)
    except Exception as error:
        gap = clock.longest_gap()
        if gap > STALL:
            raise Stalled(f"the machine stood still for {gap:.3f} s: {error}") from error
        if LaunchedNodes.late:
            raise Stalled(f"{LaunchedNodes.late[0]}: {error}") from error
        raise
