# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Draws docs/panel.png and panel_phone.png: the page with two played arms, in a headless browser.

`python -m test.panel.picture`; needs chromium and the extras panel and test.
"""

from playwright.sync_api import Browser

from ..support import ROOT
from ..support.panel_browser import chromium, open_page, wait_for_state
from ..support.panel_stage import Stage


def main() -> None:
    stage = Stage()
    stage.arms.pose = (0.0, 0.4, 0.5, 0.8)
    stage.arms.states.update(right="active", left="active")
    for settings in stage.arms.settings.values():
        settings["mode"] = "zero_g"
    stage.arms.wearer |= {"share of the wearer (%)": "40", "share band (%)": "10"}
    stage.files.content["recording"] = {
        "on": True,
        "foreign": False,
        "folder": "recordings/P01/2026-03-14/recording",
        "seconds": 84,
    }
    try:
        with chromium() as browser:
            _shoot(browser, stage, "panel", 1280, 800)
            stage.arms.fail("right", "over_temperature")
            stage.arms.fail("left", "command_stale")
            stage.arms.states["right"] = "letting down"
            _shoot(browser, stage, "panel_phone", 390, 844)
    finally:
        stage.close()


def _shoot(browser: Browser, stage: Stage, name: str, width: int, height: int) -> None:
    """Write the picture of the page, once it shows both arms and has drawn them."""
    page = open_page(browser, stage.url, width, height, folded=True)
    wait_for_state(page, stage.arms.states["left"], "left")
    page.wait_for_selector("[data-arm=right] .mark:not([hidden])", state="attached")
    page.wait_for_timeout(8000)
    page.screenshot(path=ROOT / "docs" / f"{name}.png")
    page.context.close()
    stage.control.holder = None  # the next page holds control


if __name__ == "__main__":
    main()
