"""Fixtures for the tests of devices: simulated arms on buses, and a folder for the locks of buses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from exo_gravity.hardware.ownership import owned_bus

from .simulated_rig import NoWatchdog, SimulatedRig


@pytest.fixture
def lock_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the lock files of buses, for this test and the processes that it starts."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    return tmp_path


@pytest.fixture
def make_rig(lock_folder: Path) -> Iterator[Callable[..., SimulatedRig]]:
    """A function that makes simulated arms."""
    rigs: list[SimulatedRig] = []

    def make_rig(**options: Any) -> SimulatedRig:
        rigs.append(SimulatedRig(**options))
        return rigs[-1]

    yield make_rig
    for rig in rigs:
        rig.close()
