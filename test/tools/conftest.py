# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Pages without pictures."""

from __future__ import annotations

import pytest

from exo_gravity.lab.report import html


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures take longest: leave them empty in tests that do not look at them."""
    monkeypatch.setattr(html, "png_of", lambda *_: b"")
