"""Real nodes in processes of their own, and a real node beside them that watches, asks and sets parameters."""

import pytest

from ..faults.stage import Stack, Watcher


@pytest.fixture
def watcher():
    watcher = Watcher()
    yield watcher
    watcher.close()


@pytest.fixture
def make(tmp_path):
    """Write the parameter files of stacks, without starting them."""
    return lambda **changes: Stack(tmp_path, **changes)


@pytest.fixture
def start(make):
    """Start stacks that end with the test."""
    stacks = []

    def start(**changes):
        stacks.append(make(**changes).start())
        return stacks[-1]

    yield start
    for stack in stacks:
        stack.stop()
        print("\n".join(stack.log))  # which pytest shows where a test failed
