# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A headless Chromium that drives the panel's page.

Debian's chromium is used, because Playwright's own browsers come from elsewhere. Without it the tests are skipped.
"""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
IN_BROWSER = [
    pytest.mark.browser,
    pytest.mark.skipif(not CHROMIUM, reason="no browser: install chromium (apt-get install chromium)"),
    pytest.mark.timeout(300),
]
PATIENCE = 60_000.0  # ms; a busy machine draws slowly


@contextmanager
def chromium(gives_way: bool = False) -> Iterator[Browser]:
    """Run the browser.

    gives_way: whether it only uses the processor time that others leave. Drawing without a graphics card can stall the
    simulated device on two processors. A nice value does not help: as root, Chromium gives itself higher priorities.
    """
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        program = Path(folder, "chromium")
        program.write_text(f'#!/bin/sh\nexec {"chrt --idle 0 " if gives_way else ""}{CHROMIUM} "$@"\n')
        program.chmod(0o755)
        browser = playwright.chromium.launch(
            executable_path=program,
            args=["--no-sandbox", "--enable-unsafe-swiftshader", "--force-color-profile=srgb"],
            timeout=PATIENCE,
        )
        yield browser
        browser.close()


def unfold(page: Page) -> None:
    """Open all that is folded, once the page shows an arm."""
    page.wait_for_selector(".arm .badge[data-state]")
    page.eval_on_selector_all("details", "all => all.forEach((one) => (one.open = true))")


def open_page(browser: Browser, url: str, width: int = 1100, height: int = 900, folded: bool = False) -> Page:
    """Open the panel in a new window, and wait until it shows an arm. folded: as its user finds it."""
    page = browser.new_context(viewport={"width": width, "height": height}).new_page()
    page.set_default_timeout(PATIENCE)
    page.goto(url)
    page.wait_for_selector(".arm .badge[data-state]")
    if not folded:
        unfold(page)
    return page


def of_arm(name: str, arm: str = "right") -> str:
    """Return the selector of what the page shows of this arm."""
    return f'.arm[data-arm="{arm}"] {name}'


def wait_for_state(page: Page, state: str, arm: str = "right") -> None:
    page.wait_for_selector(of_arm(f'.badge[data-state="{state}"]', arm))


def enable(page: Page, state: str = "disabled") -> None:
    """Enable the right arm, which is in this state, as its operator does."""
    wait_for_state(page, state)
    page.click(of_arm(".enable"))
    page.click("#ask-yes")
