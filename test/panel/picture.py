"""Draws docs/panel.png, panel_session.png and panel_de.png: the page with two played arms, in a headless browser.

`python -m test.panel.picture`; needs chromium and the extras panel and test.
"""

from __future__ import annotations

from playwright.sync_api import Browser, FloatRect, Page

from ..support import ROOT
from ..support.panel_browser import chromium, open_page, wait_for_state
from ..support.panel_stage import Stage

DOCS = ROOT / "docs"
PAST = (
    ("2026-03-14 10:42:07", "P01", "two_poses"),
    ("2026-03-14 10:31:50", "P01", "demo"),
    ("2026-03-11 09:15:22", "P02", "demo"),
)


def main() -> None:
    """Draw all pictures."""
    stage = Stage()
    stage.arms.pose = (0.0, 0.4, 0.5, 0.8)
    stage.arms.states["right"] = "active"
    stage.arms.fail("left", "over_temperature")
    stage.arms.share = ("96", "7")
    wearer = stage.files.wearers["P01"] = {"wearer.body_mass": 75.0}
    session = {
        "subject": "P01",
        "protocol": "reaching, second week",
        "note": "sleeve size M",
        "folder": "recordings/P01",
    }
    stage.files.content["session"] = {**session, "wearer": wearer}
    folder = "recordings/P01/2026-03-14/recording"
    stage.files.content["recording"] = {"on": True, "foreign": False, "folder": folder, "seconds": 84}
    for when, subject, trial in PAST:
        report = f"{subject}/{when[:10]}/{trial}"
        stage.files.recorded.append({"when": when, "subject": subject, "trial": trial, "report": report})
    try:
        with chromium() as browser:
            _shoot(_page(browser, stage, "en", 1100, 1000), "panel")
            page = _page(browser, stage, "de", 768, 1024)
            page.locator("#picture").scroll_into_view_if_needed()
            _shoot(page, "panel_de")
            page = _page(browser, stage, "en", 1280, 800)
            stage.arms.faults.clear()
            stage.arms.states.update(right="disabled", left="disabled")  # texts are written while the motors are off
            wait_for_state(page, "disabled", "left")
            page.fill("#markers [name=marker_text]", "third reach begins")
            page.click("#session summary")
            page.locator("#session").evaluate("section => section.scrollIntoView()")
            _shoot(page, "panel_session", {"x": 0, "y": 0, "width": 850, "height": 660})
    finally:
        stage.close()


def _page(browser: Browser, stage: Stage, language: str, width: int, height: int) -> Page:
    """Open the page, and wait until it shows both arms."""
    page = open_page(browser, stage.url, width, height)
    page.select_option("#language", language)
    wait_for_state(page, "fault", "left")
    page.wait_for_selector("[data-arm=right] .mark:not([hidden])", state="attached")
    return page


def _shoot(page: Page, name: str, clip: FloatRect | None = None) -> None:
    """Write the picture of the page, or of this part of it, once its arms are drawn and its plots have curves."""
    page.wait_for_timeout(8000)
    page.screenshot(path=DOCS / f"{name}.png", clip=clip)
    page.context.close()


if __name__ == "__main__":
    main()
