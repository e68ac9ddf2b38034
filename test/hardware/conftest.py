"""A folder for the locks of buses."""

from __future__ import annotations

from pathlib import Path

import pytest

from exo_gravity.hardware.ownership import owned_bus

from .simulated_rig import NoWatchdog


@pytest.fixture
def lock_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the lock files of buses, for this test and the processes that it starts."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    return tmp_path
