# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Fixtures for the tests in a browser. They import its driver late: other tests run without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from ..support.panel_stage import Stage

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    from ..support.panel_browser import chromium

    with chromium() as browser:
        yield browser


@pytest.fixture
def stage() -> Iterator[Stage]:
    """A panel with two arms that are off."""
    stage = Stage()
    yield stage
    stage.close()


@pytest.fixture
def locked() -> Iterator[Stage]:
    """A panel that asks for a token."""
    stage = Stage(token="a token for this test")
    yield stage
    stage.close()


@pytest.fixture
def visit(browser: Browser, stage: Stage) -> Iterator[Callable[..., Page]]:
    """A function that opens the page; an error in a script fails the test."""
    from ..support.panel_browser import open_page

    pages: list[Page] = []
    errors: list[str] = []

    def visit(**options: Any) -> Page:
        page = open_page(browser, stage.url, **options)
        page.on("pageerror", lambda error: errors.append(str(error)))
        pages.append(page)
        return page

    yield visit
    for page in pages:
        page.context.close()
    assert errors == []


@pytest.fixture
def page(visit: Callable[..., Page]) -> Page:
    return visit()
