# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The page in a real browser, with arms that the test plays: eight journeys of its operator.

The last one is the page for everyone: in German, by the keyboard alone, on a phone and a tablet, enlarged, and checked
by axe. What requests are allowed, and what becomes of them, the tests of control, server and node show.
"""

import math
import re
from collections.abc import Callable
from typing import Any

import pytest

from ..support.panel_stage import WEARER_FILE

pytest.importorskip("playwright", reason="no browser driver: install the extra test")

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, Route

from exo_gravity.panel import control, server

from ..support import waiting
from ..support.panel_browser import IN_BROWSER, PATIENCE, enable, of_arm, unfold, wait_for_state

pytestmark = IN_BROWSER
BOTH_DOWN = [("let_down", "right"), ("let_down", "left")]
BOTH_ACTIVE = {"right": "active", "left": "active"}
MARK = of_arm(".mark:not([hidden])")
# What the page sent before has arrived then, and the answers that had come are shown.
HANDLED = "fetch('/strings').then((answer) => answer.text())"


def wait_until(page: Page, condition: Callable[[], bool]) -> None:
    waiting.wait_until(condition, lambda: page.wait_for_timeout(100))


def wait_for_text(page: Page, selector: str, *texts: str) -> None:
    page.wait_for_selector(selector + "".join(f':has-text("{text}")' for text in texts))


def confirm(page: Page, *words: str) -> None:
    """Say yes to the question that is asked, with these words in it."""
    wait_for_text(page, "#ask-text:visible", *words)
    page.click("#ask-yes")


def places(page: Page, *selectors: str) -> list[tuple[float, float]]:
    """Return where the elements are on the page, however far it is scrolled: a click scrolls to its button."""
    boxes, scrolled = [page.locator(each).bounding_box() for each in selectors], page.evaluate("scrollY")
    return [(box["x"], box["y"] + scrolled) for box in boxes]


# 1. Enable


def test_an_arm_is_enabled_or_activated_after_one_question_about_the_settings_in_force(page, stage):
    settings = stage.arms.settings["right"]
    page.wait_for_selector(MARK, state="attached")
    page.click(of_arm(".enable"))
    wait_for_text(page, "#ask-text", "takes its weight", "exoskeleton alone")
    page.keyboard.press("Escape")
    assert not page.is_visible("#ask")
    stage.arms.problem = "the compensator does not answer"
    page.click(of_arm(".enable"))
    wait_for_text(page, "#message", stage.arms.problem)
    assert stage.arms.calls == [] and not page.is_visible("#ask")
    # Of what changes meanwhile the page does not learn before it asks.
    stage.arms.problem, stage.arms.shown["right"] = "", dict(settings)
    settings.update({"mode": "zero_g", "support": 0.5})
    page.click(of_arm(".enable"))
    wait_for_text(page, "#ask-text", "50.0 % of the wearer's arm", "More than rated torque")
    settings["support"] = 0.02
    page.click("#ask-yes")
    wait_for_text(page, "#ask-text", "2.0 % of the wearer")
    assert stage.arms.calls == []
    # Let down ends an enable whose settings are still being read.
    stage.arms.holds, reads = True, stage.arms.reads
    page.click("#ask-yes")
    page.keyboard.press("Space")
    wait_until(page, lambda: stage.arms.calls == BOTH_DOWN)
    stage.arms.holds = False
    wait_until(page, lambda: stage.arms.reads > reads)
    page.evaluate(HANDLED)
    assert stage.arms.calls == BOTH_DOWN and not page.is_visible("#ask")
    for state, does in (("disabled", "enable"), ("inactive", "activate")):
        stage.arms.states["right"] = state
        wait_for_text(page, of_arm(".remedy"), "press Enable")
        enable(page, state=state)
        wait_for_state(page, "active")
        assert stage.arms.calls[-1] == (does, "right")


def test_a_start_asks_whether_the_arm_hangs_as_it_is_drawn(page, stage):
    stage.arms.states["right"], stage.arms.asked["right"] = "checking", "0, -2, 1, 23"
    question = page.locator('.pose[data-arm="right"]')
    question.wait_for()
    assert "Elbow flexion 23°" in question.inner_text() and not page.is_visible('.pose[data-arm="left"]')
    page.click(of_arm(".home"))  # of a simulated arm
    page.evaluate("scrollTo(0, 0)")
    page.click(of_arm(".look"))
    assert page.locator("#picture").evaluate("picture => picture.getBoundingClientRect().top < innerHeight / 2")
    question.get_by_role("button").click()
    question.wait_for(state="hidden")
    stage.arms.states["right"] = "active"
    wait_for_state(page, "active")
    assert page.is_disabled(of_arm(".home"))
    assert stage.arms.calls == [("bring_home", "right"), ("confirm_pose", "right")]


# 2. Let down


def test_one_press_lets_both_arms_down(page, stage):
    for focus in ("", "body", "input[name=body_mass]", of_arm(".down"), "#session [name=note]"):
        stage.arms.states = dict.fromkeys(BOTH_ACTIVE, "disabled")
        page.wait_for_selector("#session [name=note]:enabled")
        if "note" in focus:  # it takes no space from now on
            page.focus(focus)
        stage.arms.states = dict(BOTH_ACTIVE)
        wait_for_state(page, "active")
        page.wait_for_selector("#session [name=note]:disabled")
        if focus:
            page.focus(focus)
            page.keyboard.press("Space")
        else:
            page.click(of_arm('[data-mode="zero_g"]'))
            page.click("#let-down")  # while a question is asked
        for arm in BOTH_ACTIVE:
            wait_for_state(page, "letting down", arm)
        assert stage.arms.calls == BOTH_DOWN and not page.is_visible("#ask"), focus
        stage.arms.calls.clear()


# The right arm's state, what else its bridge reports, and whether Let down can act: then it is red.
UNREACHED = {"right": {"motors": "unreached"}}
RED = [
    ("disabled", {}, False),
    ("checking", {}, True),
    ("letting down", {}, False),
    ("fault", UNREACHED, True),
    ("fault", {}, False),
    ("active", {}, True),
]


def test_one_arm_alone_can_be_let_down_and_what_is_not_confirmed_is_an_alarm(page, stage):
    for stage.arms.states["right"], stage.arms.reports, is_red in RED:
        wait_for_state(page, stage.arms.states["right"])
        page.wait_for_selector(f"#let-down{':not([data-off])' if is_red else '[data-off]'}")
    stage.arms.states = dict(BOTH_ACTIVE)
    wait_for_text(page, "#chips .badge[data-state=active]", "Right arm: Carrying")
    page.click(of_arm(".down", "left"))
    wait_for_state(page, "letting down", "left")
    assert stage.arms.calls == [("let_down", "left")]
    stage.arms.problem = "can_bridge does not answer"
    page.keyboard.press("Space")
    wait_for_text(page, "#alarm", "NOT confirmed", stage.arms.problem)


# 3. A fault

ELBOW, ABDUCTION = "right_elbow_flexion", "right_shoulder_abduction"
FINE = {"longest stall (ms)": "3", "longest silence (ms)": "14", "disconnected": "no"}
BUSY = {**FINE, "longest silence (ms)": "212"}
ASTRAY = {"joints outside limits": ELBOW, "turn back (deg)": "-0.1"}
OUTSIDE = {"reports": {"right": {"waiting for": "joint_limits", **ASTRAY}}}
STAYED = "The motors stayed off."


def moving(joint: str, speed: float) -> dict[str, Any]:
    """Return how an arm sinks by `speed` rad/s while the load of a joint changes."""
    return {"compensator": {"changing load": joint}, "sinking": speed}


# The right arm's state or fault, what else the devices say, what its operator is told, and what not.
TOLD: list[tuple[str, dict[str, Any], tuple[str, ...], str]] = [
    ("checking", OUTSIDE, ("Elbow flexion: turn it back by 0.1°.",), STAYED),
    ("disabled", {"reports": {"right": {"refusal": "joint_limits", **ASTRAY}}}, (STAYED, "Elbow flexion"), "already"),
    ("disabled", {"reports": {"right": {"refusal": "motor_on"}}}, (STAYED, "A motor was on already."), "flexion"),
    (
        "over_temperature", {"reports": {"right": {"fault joint": ELBOW}}},
        ("Elbow flexion: A motor is too hot", "Wait until it has cooled", "Then press Clear fault."), "changed",
    ),
    ("motor_silent", {}, ("CAN cable",), "busy"),
    ("motor_silent", {"simulator": BUSY}, ("This computer was too busy", "212 ms"), "CAN cable"),
    ("wrong_sign", {"simulator": BUSY}, ("212 ms", "wrong way"), "CAN cable"),
    ("motor_silent", {"simulator": {**BUSY, "disconnected": "yes"}}, ("CAN cable",), "busy"),
    ("motor_silent", {"simulator": None}, ("The simulator does not report",), "busy"),
    ("wrong_sign", {}, ("Call the engineer",), "Then press"),
    ("wrong_sign", {"reports": UNREACHED}, ("A motor may still be powered.", "press the emergency stop."), "Then"),
    ("command_stale", {}, ("Then press Carry again.",), "engineer"),
    (
        "command_withdrawn", {"compensator": {"state": "withdrawn", "reason": "late_tilt"}},
        ("The compensator stopped.", "tilt is late", "launcher's window"), "engineer",
    ),
    ("active", {}, ("Carrying", "The arm is carried."), "stopped"),
    ("active", moving(ELBOW, 0.2), ("Sinking", "The load is changing"), "The arm is carried."),
    ("active", moving(ELBOW, -0.2), ("Moving", "The load is changing"), "The arm is carried."),
    ("active", moving("none", -0.2), ("Moving", "If the wearer does not move it"), "The arm is carried."),
]  # fmt: skip


def test_each_state_and_fault_says_what_happens_and_what_to_do(page, stage):
    usual = {"reports": {}, "compensator": {}, "simulator": FINE, "sinking": 0.0}
    for state, devices, told, untold in TOLD:
        for name, value in {**usual, **devices}.items():
            setattr(stage.arms, name, value)
        stage.arms.fail("right", state)
        if state in ("checking", "disabled", "active"):
            stage.arms.states["right"], stage.arms.faults = state, {}
        wait_for_text(page, of_arm(".lead"), *told)
        assert untold not in page.inner_text(of_arm(".lead")), state


def test_a_fault_moves_no_button_names_the_change_of_load_before_it_and_is_cleared_or_resumed(visit, stage):
    stage.arms.settings["right"].update({"mode": "zero_g", "support": 0.05})
    stage.arms.states["right"] = "active"
    page = visit()
    buttons = of_arm(".enable"), of_arm('[data-mode="zero_g"]')
    wait_for_state(page, "active")
    before = places(page, *buttons)
    stage.arms.fail("right", "over_temperature")
    wait_for_state(page, "fault")
    assert page.is_disabled(of_arm(".enable")) and not page.is_visible(of_arm(".resume"))
    page.click(of_arm(".clear"))
    wait_for_state(page, "disabled")
    assert "hot" not in page.inner_text(of_arm(".tell"))
    for support in (0.3, 0.65):  # a slider on its way
        stage.arms.settings["right"]["support"] = support
        page.wait_for_timeout(300)
    stage.arms.fail("right", "over_speed")
    change = "the support was changed from 5.0 % to 65.0 %"
    wait_for_text(page, of_arm(".tell"), "A joint moved too fast", change, "Set it back")
    assert places(page, *buttons) == before
    page.reload()
    wait_for_text(page, of_arm(".tell"), change)
    stage.arms.fail("right", "command_stale")  # it leaves nothing to repair
    page.click(of_arm(".resume"))
    wait_for_state(page, "active")
    assert stage.arms.calls[-1] == ("resume", "right") and not page.is_visible(of_arm(".resume"))


# 4. Support, wearer and load


def change_mode(page: Page, mode: str, *words: str) -> None:
    page.click(of_arm(f'[data-mode="{mode}"]'))
    confirm(page, *words)
    page.wait_for_selector(of_arm(f'[data-mode="{mode}"][aria-pressed="true"]'))


def test_zero_g_asks_and_starts_at_0_the_support_slides_shows_the_motors_limit_and_asks_beyond_it(page, stage):
    slider, settings = of_arm(".support input"), stage.arms.settings["right"]
    page.wait_for_selector(MARK, state="attached")
    assert page.input_value(slider) == "0" and page.is_disabled(slider)  # One-G carries nothing of the wearer's arm
    change_mode(page, "zero_g")
    assert (settings["mode"], settings["support"]) == ("zero_g", 0.0)
    stage.arms.states["right"], settings["support"] = "active", 0.05
    mark = page.eval_on_selector(of_arm(".mark"), "mark => parseFloat(mark.style.left)")
    assert 5.0 < mark < 9.0  # %, as docs/parameters.md computes it for 75 kg
    page.wait_for_selector(f"{slider}:enabled")
    wait_until(page, lambda: page.input_value(slider) == "5")
    page.focus(slider)
    page.keyboard.press("ArrowRight")
    wait_until(page, lambda: ("set", "right", "{'support': 0.055}") in stage.arms.calls)
    page.keyboard.press("End")  # a slip
    page.wait_for_selector("#ask:visible")
    page.click("#ask-no")
    wait_until(page, lambda: page.input_value(slider) == "5.5")
    page.fill(slider, "15")  # in one move: the page asks 0.3 s after the last one
    confirm(page, "More than rated torque")
    wait_until(page, lambda: settings["support"] == pytest.approx(0.15))
    wait_for_text(page, of_arm(".limit"), "More than rated torque")
    assert len(stage.arms.calls) == 3
    stage.arms.wearer |= {"support adapts": "on", "support asked for": "0.52"}
    wait_for_text(page, of_arm(".limit"), "support adapts: 15 -> 52 %")
    change_mode(page, "one_g", "it sinks slowly")


def give_wearer(page: Page, mass: str) -> None:
    page.fill("input[name=body_mass]", mass)
    page.click("#wearer button")


def test_a_wearers_data_ask_first_while_an_arm_is_carried_and_lower_the_support_to_what_is_safe(visit, stage):
    right, left = (stage.arms.settings[arm] for arm in ("right", "left"))
    right["support"] = left["support"] = 0.06
    page = visit()
    page.wait_for_selector(MARK, state="attached")  # at 6.8 %, for 75 kg
    give_wearer(page, "0")  # the browser refuses it
    give_wearer(page, "100")
    wait_for_text(page, "#message", "The support of the right arm is now 5.0 %", "raise it")
    give_wearer(page, "200")  # at once: the limit is still that of 75 kg
    wait_until(page, lambda: (left["wearer.body_mass"], left["support"]) == (200.0, 0.025))
    held: list[Route] = []
    page.route("**/action", lambda route: route.continue_() if held else held.append(route))
    give_wearer(page, "61")
    wait_until(page, lambda: held)
    give_wearer(page, "60")  # of the first one not even one arm is told yet
    page.evaluate(HANDLED)
    held[0].continue_()
    page.unroute("**/action")
    wait_until(page, lambda: left["wearer.body_mass"] == 60.0 and page.inner_text("#message") == "Applied.")
    assert [call for call in stage.arms.calls if "60.0" in call[2]] == stage.arms.calls[-2:]
    assert (right["support"], left["support"]) == (0.025, 0.025)
    # The first wearer of a carried arm; its compensator has the moments of the last one.
    stage.arms.calls.clear()
    stage.arms.states["right"] = "active"
    right.update({"mode": "zero_g", "support": 1.0, "wearer.body_mass": 0.0, "wearer.first_moment": [0.2] * 4})
    wait_for_text(page, "#chips .badge", "Zero-G, 0 %")  # no wearer is entered
    give_wearer(page, "62")
    assert stage.arms.calls == []
    confirm(page, "may move slowly")
    wait_until(page, lambda: len(stage.arms.calls) == 2)
    assert (right["wearer.body_mass"], right["support"], left["support"]) == (62.0, 0.0, 0.025)
    assert right["wearer.first_moment"] == [0.0] * 4


def test_a_load_is_weighed_after_a_question_and_carried_after_another(page, stage):
    weigh, carry = of_arm(".weigh"), of_arm(".carry")
    assert page.is_disabled(weigh) and not page.is_visible(carry)
    stage.arms.states["right"] = "active"
    page.click(weigh)
    confirm(page, "relax within 4 s")
    wait_until(page, lambda: ("weigh", "right") in stage.arms.calls)
    stage.arms.compensator = {"weigh refused": "support"}
    wait_for_text(page, of_arm(".weighing"), "Not weighed: a wearer can relax only in Zero-G")
    stage.arms.compensator = {"weighing": "sweeping", "weighing time (s)": "9"}
    wait_for_text(page, of_arm(".weighing"), "Do not help it (9 s)")
    weighed = {"weighed mass (kg)": "1.050", "weighed band (kg)": "0.080"}
    weighed |= {"weighed payload (kg)": "0.990", "weighed payload band (kg)": "0.052"}
    stage.arms.compensator = {"weighing": "done", **weighed}
    stage.arms.wearer |= {"contacts": "1", "contact joint": "right_elbow_flexion"}
    stage.arms.wearer |= {"contact torque (Nm)": "4.0", "contact age (s)": "1"}
    wait_for_text(page, carry, "Carry 0.99 kg (±0.05)")
    wait_for_text(page, of_arm(".contact"), "Elbow flexion +4.0 Nm")
    page.click(carry)
    confirm(page, "0.99 kg in the hand instead of 0.00 kg")
    wait_until(page, lambda: stage.arms.settings["right"]["payload.mass"] == 0.99)
    page.wait_for_selector(carry, state="hidden")
    assert "0.99 kg is carried" in page.inner_text(of_arm(".payload"))


# 5. What the arms do

SHARE, BAND = "share of the wearer (%)", "share band (%)"
# The share that is reported with its band, and the text of the bar, its part and its band as shares of the bar.
SHARES = [("111", "9", "111 %", 1.0, None), ("40", "10", "40 %", 0.4, 0.2), ("-30", "10", "-30 %", 0.0, None)]


def test_the_share_that_the_wearer_carries_is_shown_with_its_band_while_it_means_something(page, stage):
    wearer, words, figure = stage.arms.wearer, of_arm(".carries .width"), of_arm(".carries strong")
    wearer[SHARE], wearer[BAND] = SHARES[0][:2]
    wait_for_text(page, words, "while the arm is carried")
    assert page.inner_text(figure) == "–"
    stage.arms.states["right"] = "active"
    for wearer[SHARE], wearer[BAND], shown, part, band in SHARES:
        wait_until(page, lambda shown=shown: page.inner_text(figure) == shown)
        bar, filled, spread = (page.locator(of_arm(f".{name}")).bounding_box() for name in ("bar", "part", "band"))
        assert abs(filled["width"] / bar["width"] - part) < 0.04  # the bar has a border
        if band:
            assert abs(spread["width"] / bar["width"] - band) < 0.02
            assert abs((spread["x"] - bar["x"]) / bar["width"] - (part - band / 2)) < 0.02
    wearer |= {f"{ELBOW} share (%)": "100", f"{ELBOW} share band (%)": "14", SHARE: "40", BAND: "60"}
    wearer |= {f"{ABDUCTION} share (%)": "3", f"{ABDUCTION} share band (%)": "60"}
    wait_for_text(page, words, "Too uncertain")
    wait_for_text(page, of_arm(".shares"), "Elbow flexion 100 % (±14)", "abduction too uncertain")
    assert "rotation" not in page.inner_text(of_arm(".shares"))
    wearer |= {BAND: "9", "largest support": "none"}
    stage.arms.settings["right"].update({"wearer.body_mass": 0.0, "mode": "zero_g", "support": 0.6})
    wait_for_text(page, words, "Enter the wearer's data")
    wait_for_text(page, of_arm(".limit"), "No wearer has been entered")
    assert page.inner_text(figure) == "–" and page.is_disabled(of_arm(".support input"))


def test_the_page_says_which_arm_is_simulated_as_the_devices_say(page, stage):
    wait_for_text(page, "#source", "SIMULATED")
    stage.arms.simulator, stage.arms.reports["right"] = None, {"source": "real"}
    stage.arms.reports["left"] = {"source": "unknown"}
    page.reload()  # until then it stays simulated
    unfold(page)
    wait_for_text(page, "#source", "Right arm: Real arm, Left arm: Source unknown")
    assert not page.is_visible(of_arm(".home"))
    stage.server.stop()
    wait_for_text(page, of_arm(".remedy"), "Hold the arm", "launcher's window")


# 6. Control and connection


def test_a_second_page_watches_lets_down_and_takes_control_and_no_page_shows_an_old_state(visit, stage, monkeypatch):
    # A busy machine silences a page for seconds.
    monkeypatch.setattr(control, "GONE", PATIENCE / 1000)
    first, second = visit(), visit()
    second.wait_for_selector("#take:visible")
    assert second.is_disabled(of_arm(".enable"))
    stage.arms.states["right"] = "active"
    first.reload()
    wait_for_state(first, "active")
    first.wait_for_selector("#release:visible")
    second.keyboard.press("Space")
    wait_for_state(first, "letting down")
    stage.arms.states["right"] = "disabled"
    second.click("#take")
    second.click("#ask-yes")
    enable(second)
    wait_for_state(second, "active")
    first.wait_for_selector("#take:visible")
    stage.server.stop()
    wait_for_state(second, "unseen")
    wait_for_text(second, "#alarm", "cannot see the arms")
    wait_for_text(second, of_arm(".sentence"), "cannot see the arm", "Its last report, at ", ": Carrying.")
    wait_for_text(second, of_arm(".remedy"), "starts again within two minutes")
    assert second.locator(of_arm("tbody tr")).count() == 0
    second.keyboard.press("Space")
    wait_for_text(second, "#alarm", "NOT confirmed")


# 7. Sessions, recordings and markers


def test_a_subject_is_chosen_with_its_wearer_and_the_past_sessions_have_their_reports(
    visit, stage, tmp_path, monkeypatch
):
    report, name = tmp_path / "report.html", "P01/2026-03-14/demo_20260314_120000"
    report.write_text("<h1>demo of P01</h1>")
    entry = {"subject": "P01", "trial": "demo", "when": "2026-03-14 12:00:00", "report": name, "folder": name}
    entry |= {"protocol": "reaching", "seconds": 61.5, "verdict": "It held."}
    other = {**entry, "subject": "P02", "report": "", "folder": "", "seconds": None, "verdict": ""}
    stage.files.recorded, stage.files.reports, stage.files.wearers = (
        [entry, other],
        {name: report},
        {"P01": WEARER_FILE},
    )
    monkeypatch.setattr(server, "programs", lambda: {"PlotJuggler": ["plotjuggler"]})
    page = visit()
    shown = ["2026-03-14 12:00:00", "P01", "demo", "reaching", "62 s", "It held."]
    assert page.inner_text("#past tr").split("\t")[:6] == shown
    page.click("#past button:text('Open in PlotJuggler')")
    wait_until(page, lambda: stage.files.calls == [f"open {name} PlotJuggler"])
    assert page.locator("#past tr").count() == 2
    page.fill("#past-filter", "p01 reach")
    assert page.locator("#past tr:visible").count() == 1
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag.mcap").write_bytes(b"MCAP")
    with page.expect_download() as download:
        page.click("#past a:text('MCAP')")
    assert download.value.suggested_filename == "demo_20260314_120000.mcap"
    with page.context.expect_page() as opened:
        page.click("#past a")
    assert opened.value.inner_text("h1") == "demo of P01"
    for subject in ("Anna Meier", "P01"):  # the browser refuses what is no code
        assert len(stage.files.calls) == 1
        page.fill("#session [name=subject]", subject)
        page.click("#session button:not([type])")
        page.click("#session [name=note]")
    wait_for_text(page, "#session-text", "P01", "delete that folder")
    page.keyboard.type("second visit")  # a space while all motors are off
    page.keyboard.press("Enter")
    wait_until(page, lambda: stage.files.calls[-1] == "session P01, , second visit")
    assert stage.arms.calls == [] and page.input_value("#wearer [name=body_mass]") == "61.5"
    page.click("#wearer button")
    wait_until(page, lambda: len(stage.arms.calls) == 2)
    for arm, settings in stage.arms.settings.items():
        assert {key: settings[key] for key in WEARER_FILE} == WEARER_FILE, arm


def test_recording_trial_and_parameters_are_asked_for_and_markers_set_by_button_key_and_digit(page, stage):
    page.fill("#markers [name=marker_text]", "cramp at 3")
    stage.arms.states = dict(BOTH_ACTIVE)
    wait_for_state(page, "active")
    page.wait_for_selector("[name=marker_text]:disabled")
    assert page.is_disabled("#presets button")
    page.keyboard.press("m")  # nothing is recorded yet
    page.click("#record")
    page.click("#presets button:has-text('Task begins')")
    held: list[Route] = []
    page.route("**/action", lambda route: held.append(route) if "end" in route.request.post_data else route.continue_())
    page.keyboard.press("2")
    page.keyboard.press("m")
    wait_for_text(page, "#message", "cramp at 3")
    with page.expect_response("**/action"):  # the answer to an earlier press comes last
        held[0].continue_()
    page.unroute("**/action")
    page.evaluate(HANDLED)
    assert "cramp at 3" in page.inner_text("#message")
    page.click('#presets button:has-text("a text of one\'s own")')
    page.click("#record-stop:enabled")
    page.select_option("#trials", "two_poses")
    page.click("#trial-start")
    steps = [{"action": "move", "value": [0.0, 0.5, 0.6, 0.5]}]
    stage.files.content["trial"] = {"phase": "running", "name": "reach", "steps": steps, "step": 0, "left": 2.0}
    wait_for_text(page, "#trial-step", "Shoulder flexion 34°, Elbow flexion 29°")
    stage.files.content["recording"] = {"on": False, "foreign": False, "problem": "the recorder ended"}
    wait_for_text(page, "#recording-text", "The recording has ended early: the recorder ended")
    page.click("#show")
    wait_for_text(page, "#parameters", "depth.far: .inf")
    page.click("#save")
    wait_until(page, lambda: "save" in stage.files.calls)
    assert stage.files.calls == [
        "record",
        *(f"marker {text}" for text in ("begin", "cramp at 3", "end", "a text of one's own")),
        *("stop_recording", "trial two_poses", "save"),
    ]


# 8. The page for everyone

TALLEST = """async (column) => {
    const CAUSED = ["over_speed", "torque_not_delivered", "outside_limits", "unexplained_torque"];
    const { texts } = await (await fetch("/strings")).json();
    const [why, todo] = [".sentence", ".remedy"].map((part) => document.querySelector(`.arm ${part}`));
    const place = document.querySelector(".arm .tell");
    todo.hidden = false;
    const text = (key) => texts[key]?.[column] ?? "";
    const height = (code) => {
        const cause = CAUSED.includes(code) ? text("cause.support").replace(/{.}/g, "99.9") : "";
        why.textContent = `${text("joint.shoulder_abduction")}: ${text(`fault.${code}`)} ${cause}`;
        todo.textContent = `${text(cause ? "do.cause" : `do.${code}`)} ${text("then.clear")}`;
        return place.scrollHeight - place.clientHeight;
    };
    const codes = Object.keys(texts).filter((key) => key.startsWith("fault.")).map((key) => key.slice(6));
    return Math.max(...codes.map(height));
}"""
SIZES = {"phone": (390, 844), "tablet": (768, 1024), "200 %": (640, 450), "desk": (1280, 800)}  # 200 % of 1280 by 900


@pytest.mark.parametrize(("width", "height"), SIZES.values(), ids=SIZES)
def test_on_every_screen_let_down_stays_in_sight_nothing_is_cut_off_and_no_state_moves_the_buttons(
    visit, stage, width, height
):
    for settings in stage.arms.settings.values():
        settings.update(mode="zero_g", support=1.0)
    page = visit(width=width, height=height)
    page.select_option("#language", "de")  # its words are the longest
    seen = set()
    for state in ("disabled", "checking", "active", "letting down"):
        stage.arms.states = dict.fromkeys(BOTH_ACTIVE, state)
        for arm in BOTH_ACTIVE:
            wait_for_state(page, state, arm)
        seen.add(tuple(places(page, *map(of_arm, (".down", ".support input", ".weigh")))))
    assert len(seen) == 1
    stage.arms.states["right"] = "ramping in"  # the longest name of a state
    stage.arms.fail("left", "implausible_zero")
    stage.files.content["recording"] = {
        "on": True,
        "foreign": False,
        "folder": f"/home/clinic/recordings/{'P' * 60}",
        "seconds": 3600,
    }
    page.wait_for_selector("#light:visible")
    for position in ("0", "document.body.scrollHeight / 2", "document.body.scrollHeight"):
        page.evaluate(f"scrollTo(0, {position})")
        box = page.locator("#let-down").bounding_box()
        assert box["y"] >= 0 and box["y"] + box["height"] <= height
        assert box["height"] >= 44 and box["width"] >= 300
    for part in ("#source", "#connection", "#light", "#chips .badge >> nth=0"):
        box = page.locator(part).bounding_box()
        assert 0 <= box["y"] < 120 and box["x"] + box["width"] <= width
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    cells = (of_arm("tbody tr:first-child td:last-child"), ".arm[data-arm=right]")
    temperature, card = (page.locator(cell).bounding_box() for cell in cells)
    assert temperature["x"] + temperature["width"] <= card["x"] + card["width"]
    stage.arms.pose = (math.nan, 0.0, 0.0, 0.0)  # of a joint whose angle is not known
    wait_for_text(page, of_arm("tbody tr:first-child"), "–°")
    for column in (0, 1):
        assert page.evaluate(TALLEST, column) == 0.0  # no text of a fault is longer than its place


def test_the_page_is_german_when_its_user_or_their_browser_wants_it(page, browser, stage):
    stage.arms.states["right"], stage.arms.reports = "checking", OUTSIDE["reports"]
    stage.arms.problem = "refused: the bus is gone"
    page.select_option("#language", "de")
    wait_for_text(page, of_arm(".sentence"), "Ellenbogen Beugung: um 0,1° zurückdrehen.")
    page.click(of_arm(".home"))
    wait_for_text(page, "#message", "Das Gerät sagt auf Englisch: „refused: the bus is gone“")
    stage.files.content["trial"] = {
        "phase": "done",
        "name": "reach",
        "problem": "stopped by the operator",
        "stopped": True,
    }
    wait_for_text(page, "#trial-text", "reach wurde abgebrochen.")
    texts = page.inner_text("body")
    assert not re.search(r"\b(Let down|Enable|Clear fault|Wearer|Recording)\b", texts)
    assert "Rumpf: 11,5° nach vorn, 5,7° nach links" in texts and "4,1 ms. Gedämpft durch: still joint (elbow)" in texts
    page.reload()
    own = browser.new_context(locale="de-AT").new_page()
    own.goto(stage.url)
    for each in (page, own):
        wait_for_text(each, "#let-down", "Absenken")


def test_the_keyboard_alone_reaches_everything(page, stage):
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("[document.activeElement].map(one => one.id || one.className || one.name)[0]"))
    assert {
        "language",
        "release",
        "operate primary enable",
        "record",
        "save",
        "let-down",
        "body_mass",
        "sex",
    } <= reached
    for button, state in ((".enable", "active"), (".down", "letting down")):
        page.focus(of_arm(button))
        page.keyboard.press("Enter")
        if button == ".enable":
            page.wait_for_selector("#ask:visible")
            page.keyboard.press("Tab")
            page.keyboard.press("Enter")
        wait_for_state(page, state)


def serious(page: Page) -> list[str]:
    findings = Axe().run(page).response["violations"]
    severe = [finding for finding in findings if finding["impact"] in ("serious", "critical")]
    return [f"{finding['id']}: {[node['html'][:120] for node in finding['nodes']]}" for finding in severe]


def test_axe_has_no_serious_findings_of_the_page_and_of_that_which_asks_for_the_token(page, stage, locked):
    page.click(of_arm(".enable"))
    page.wait_for_selector("#ask:visible")
    assert serious(page) == []
    page.keyboard.press("Escape")
    stage.arms.states, stage.arms.sinking = dict(BOTH_ACTIVE), 0.2
    stage.arms.wearer |= {SHARE: "40", BAND: "10"}
    page.click("#record")
    for shown in (of_arm(".carries[data-known]"), "#chips .badge[data-moves]"):
        page.wait_for_selector(shown)
    assert serious(page) == []
    stage.arms.fail("right", "motor_silent")
    wait_for_state(page, "fault")
    for scheme, language in (("light", "de"), ("dark", "en")):
        page.emulate_media(color_scheme=scheme)
        page.select_option("#language", language)
        assert serious(page) == [], scheme
    page.goto(locked.url)
    assert serious(page) == []
    page.fill("input", locked.token)
    page.click("button")
    page.wait_for_selector(".arm .badge[data-state]")
