"""Every test run has a ROS domain of its own, and speaks to this machine alone.

A machine that stands still for longer than the nodes' patience lets the arm down, as it must, and then a test of worn
processes (`real_time`) says nothing. So a clock runs beside them: where one fails while the clock stood still, it fails
with `Stalled`, and is played again.
"""

import multiprocessing
import os
import time

import pytest

from .support.clock import beat

STALL = 0.03  # s between two beats

os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 100 + 1)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


class Stalled(AssertionError):
    """A test failed on a machine that stood still meanwhile."""


@pytest.fixture(scope="session")
def longest_beat():
    """The longest time between two beats of the clock since it was set to 0, in s."""
    spawn = multiprocessing.get_context("spawn")
    longest = spawn.Value("d", 0.0)
    clock = spawn.Process(target=beat, args=(longest,), daemon=True)
    clock.start()
    while not longest.value:
        time.sleep(0.005)
    yield longest
    clock.terminate()
    clock.join()


def pytest_configure(config):
    config.addinivalue_line("markers", "real_time: nodes run as processes, and the machine must keep up with them")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("real_time"):
            item.fixturenames.append("longest_beat")
            item.add_marker(pytest.mark.flaky(reruns=2, only_rerun="Stalled"))


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem):
    longest = pyfuncitem.funcargs.get("longest_beat")
    if longest is not None:
        longest.value = 0.0
    try:
        return (yield)
    except Exception as error:
        if longest is not None and longest.value > STALL:
            raise Stalled(f"the machine stood still for {longest.value:.3f} s: {error}") from error
        raise
