# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A folder for the notes of buses."""

from pathlib import Path

import pytest

from exo_gravity.hardware import bus_lock, owned_bus

from .arms import NoWatchdog


@pytest.fixture
def lock_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the notes of this test's buses. Their names must differ from those of another test run."""
    monkeypatch.setattr(bus_lock, "FOLDERS", (tmp_path,))
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    return tmp_path
