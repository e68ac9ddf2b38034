"""Draws docs/panel.png and docs/panel_de.png: the page with two played arms, in a headless browser.

`python -m docs.panel_picture`; needs chromium and the extras panel and test.
"""

from __future__ import annotations

from pathlib import Path

from test.support.panel_browser import chromium, open_page, wait_for_state
from test.support.panel_stage import Stage

DOCS = Path(__file__).parent


def main() -> None:
    """Draw both pictures."""
    stage = Stage()
    stage.arms.states["right"] = "active"
    stage.arms.fail("left", "over_temperature")
    try:
        with chromium() as browser:
            for name, language, size in (("panel", "en", (1100, 1000)), ("panel_de", "de", (768, 1024))):
                page = open_page(browser, stage.url, *size)
                page.select_option("#language", language)
                wait_for_state(page, "fault", "left")
                page.wait_for_selector("[data-arm=right] .mark:not([hidden])", state="attached")
                if language == "de":
                    page.locator("#picture").scroll_into_view_if_needed()
                page.wait_for_timeout(8000)  # so that the picture is drawn and the plots have curves
                page.screenshot(path=DOCS / f"{name}.png")
                page.context.close()
    finally:
        stage.close()


if __name__ == "__main__":
    main()
