# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tests of the studies are long: `.ci/test-long` runs them."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the studies' tests: they run with the other long ones."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker("thorough")
