"""Each test run has its own ROS domain, and its nodes communicate on this machine only."""

from __future__ import annotations

import os

import pytest

from exo_gravity.hardware.clock import favour

from .support.ports import own_domain

os.environ["ROS_DOMAIN_ID"] = str(own_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


@pytest.fixture(scope="session")
def machine() -> None:
    """The machine for one test of running nodes at a time: nodes let the arm down when they get no processor."""
    if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
        pytest.fail("tests marked real_time run alone: use `-m real_time` without -n")
    favour(5)  # what a test receives is in time


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("real_time"):
            item.fixturenames.insert(0, "machine")
