"""Locks of buses and folders of their notes that no other test run shares."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from exo_gravity.hardware.ownership import bus_lock, owned_bus

from .simulated_rig import NoWatchdog


@pytest.fixture
def lock_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the notes of this test's buses, whose locks have names of their own."""
    monkeypatch.setattr(bus_lock, "NAME", f"\0exo_gravity test {os.getpid()}/")
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    return tmp_path
