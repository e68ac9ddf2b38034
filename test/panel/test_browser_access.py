# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The page for everyone: in German, by the keyboard alone, on a tablet, enlarged, and checked by axe."""

from __future__ import annotations

import re

import pytest

from ..support.panel_stage import Stage

pytest.importorskip("playwright", reason="no browser driver: install the extra test")

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from ..support.panel_browser import IN_BROWSER, of_arm, wait_for_state

pytestmark = IN_BROWSER


def serious(page: Page) -> list[str]:
    """Return the serious findings of axe."""
    findings = Axe().run(page).response["violations"]
    return [
        f"{finding['id']}: {[node['html'][:120] for node in finding['nodes']]}"
        for finding in findings
        if finding["impact"] in ("serious", "critical")
    ]


def test_the_page_is_german_when_its_user_wants_it(page, stage):
    page.select_option("#language", "de")
    assert page.inner_text("#let-down") == "Absenken"
    assert page.get_attribute("html", "lang") == "de"
    texts = page.inner_text("body")
    assert not re.search(r"\b(Let down|Enable|Clear fault|Wearer|Recording)\b", texts)
    assert "Rumpf: 11,5° nach vorn, 5,7° nach links" in texts and "Rate: 250,0 Hz. Alter der Momente: 4,1 ms." in texts
    page.reload()
    page.wait_for_selector("#let-down:has-text('Absenken')")


def test_the_page_starts_in_its_browsers_language(browser, stage):
    page = browser.new_context(locale="de-AT").new_page()
    page.goto(stage.url)
    page.wait_for_selector("#let-down:has-text('Absenken')")


def test_the_keyboard_alone_reaches_everything(page, stage):
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        name = "document.activeElement.id || document.activeElement.className || document.activeElement.name"
        reached.add(page.evaluate(name))
    assert {"language", "release", "operate primary enable", "trial-start", "record", "save", "let-down"} <= reached
    assert {"body_mass", "sex", "upper_arm"} <= reached
    page.focus(of_arm(".enable"))
    page.keyboard.press("Enter")
    page.wait_for_selector("#ask:visible")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    wait_for_state(page, "active")
    page.focus(of_arm(".down"))
    page.keyboard.press("Enter")
    wait_for_state(page, "letting down")


@pytest.mark.parametrize(
    ("width", "height"), [(390, 844), (768, 1024), (640, 450), (1280, 800)], ids=["phone", "tablet", "200 %", "desk"]
)
@pytest.mark.parametrize("language", ["en", "de"])
def test_let_down_is_always_in_sight_and_nothing_is_cut_off(visit, stage, width, height, language):
    page = visit(width=width, height=height)  # 200 % of 1280 by 900 is 640 by 450
    page.select_option("#language", language)
    for position in ("0", "document.body.scrollHeight / 2", "document.body.scrollHeight"):
        page.evaluate(f"scrollTo(0, {position})")
        box = page.locator("#let-down").bounding_box()
        assert box is not None
        assert box["y"] >= 0 and box["y"] + box["height"] <= height
        assert box["height"] >= 44 and box["width"] >= 300
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("state", ["off", "carried", "fault", "dark", "moving", "asking", "german", "login"])
def test_axe_has_no_serious_findings(browser, visit, stage, state):
    if state == "login":
        locked = Stage(token="a token for this test")
        try:
            page = browser.new_page()
            page.goto(locked.url)
            assert serious(page) == []
            page.fill("input", "a token for this test")
            page.click("button")
            page.wait_for_selector(".arm .badge[data-state]")
            page.close()
        finally:
            locked.close()
        return
    page = visit()
    if state == "dark":
        page.emulate_media(color_scheme="dark")
    if state in ("fault", "dark"):
        stage.arms.fail("right", "motor_silent")
        wait_for_state(page, "fault")
    elif state == "moving":
        stage.arms.states["right"], stage.arms.sinking = "active", 0.2
        page.wait_for_selector("#chips .badge[data-moves]")
    elif state == "carried":
        stage.arms.states, stage.arms.share = {"right": "active", "left": "active"}, ("40", "10")
        page.click("#record")
        page.wait_for_selector(of_arm(".carries[data-known]"))
    elif state == "asking":
        page.click(of_arm(".enable"))
        page.wait_for_selector("#ask:visible")
    elif state == "german":
        page.select_option("#language", "de")
    assert serious(page) == []
