# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The page in a real browser, with arms that the test plays: what its operator can do, and by which means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

pytest.importorskip("playwright", reason="no browser driver: install the extra test")

from playwright.sync_api import Page

from exo_gravity.panel import control

from ..support import waiting
from ..support.panel_browser import IN_BROWSER, PATIENCE, enable, of_arm, wait_for_state
from ..support.panel_stage import LEAVES, WEARER_FILE

pytestmark = IN_BROWSER
BOTH_DOWN = [("let_down", "right"), ("let_down", "left")]


def wait_until(page: Page, condition: Callable[[], bool]) -> None:
    """Wait until `condition()` holds, while the page goes on."""
    waiting.wait_until(condition, lambda: page.wait_for_timeout(100))


def confirm(page: Page, words: str = "") -> None:
    """Say yes to the question that is asked, with these words in it."""
    page.wait_for_selector("#ask:visible")
    assert words in page.inner_text("#ask-text")
    page.click("#ask-yes")


@pytest.fixture
def active(stage):
    """The stage with both arms carried."""
    stage.arms.states = {"right": "active", "left": "active"}
    return stage


def test_enable_asks_once_and_says_what_will_happen_also_beyond_rated_torque(page, stage):
    page.click(of_arm(".enable"))
    assert stage.arms.calls == []
    assert "takes its weight" in page.inner_text("#ask-text")
    assert "exoskeleton alone" in page.inner_text("#ask-text")
    page.keyboard.press("Escape")
    assert not page.is_visible("#ask")
    enable(page)
    wait_for_state(page, "active")
    assert stage.arms.calls == [("enable", "right")]
    stage.arms.settings["left"].update({"mode": "zero_g", "support": 0.5})
    page.wait_for_selector(of_arm(".mark:not([hidden])", "left"), state="attached")
    page.click(of_arm(".enable", "left"))
    confirm(page, "More than rated torque")


def test_an_arm_whose_bridge_waits_for_its_operator_is_activated_with_the_button_and_question_of_enable(visit, stage):
    stage.arms.states["right"] = "inactive"
    page = visit()
    wait_for_state(page, "inactive")
    page.wait_for_selector(of_arm(".remedy:has-text('press Enable')"))
    page.click(of_arm(".enable"))
    confirm(page, "takes its weight")
    wait_for_state(page, "active")
    assert stage.arms.calls == [("activate", "right")]


def test_a_question_is_about_the_settings_at_the_press_and_is_asked_again_where_they_change_meanwhile(visit, stage):
    page, settings = visit(), stage.arms.settings["right"]
    page.wait_for_selector(of_arm(".mark:not([hidden])"), state="attached")
    stage.arms.shown["right"] = dict(settings)  # the page does not learn of what is changed now
    settings.update({"mode": "zero_g", "support": 0.5})
    page.click(of_arm(".enable"))
    page.wait_for_selector("#ask:visible")
    assert "50.0 % of the wearer's arm" in page.inner_text("#ask-text")
    settings["support"] = 0.02
    page.click("#ask-yes")
    page.wait_for_selector("#ask-text:has-text('2.0 % of the wearer')")
    assert stage.arms.calls == []
    page.click("#ask-yes")
    wait_for_state(page, "active")
    assert stage.arms.calls == [("enable", "right")]


def test_let_down_ends_an_enable_whose_settings_are_still_being_read(page, stage):
    page.click(of_arm(".enable"))
    page.wait_for_selector("#ask:visible")
    stage.arms.delay, reads = 1.0, stage.arms.reads
    page.click("#ask-yes")
    page.keyboard.press("Space")
    wait_until(page, lambda: stage.arms.reads > reads)
    page.evaluate("fetch('/strings').then((answer) => answer.text())")  # what the page sends at once has arrived then
    assert stage.arms.calls == BOTH_DOWN and not page.is_visible("#ask")


def test_an_arm_whose_settings_cannot_be_read_is_not_enabled(page, stage):
    stage.arms.problem = "the compensator does not answer"
    page.click(of_arm(".enable"))
    page.wait_for_selector("#message:has-text('the compensator does not answer')")
    assert stage.arms.calls == [] and not page.is_visible("#ask")


@pytest.mark.parametrize("means", ["click", "space", "touch while asking", "space in a field", "space on enable"])
def test_one_press_lets_both_arms_down(active, page, means):
    wait_for_state(page, "active")
    if means == "touch while asking":
        page.click(of_arm('[data-mode="zero_g"]'))
    if means in ("click", "touch while asking"):
        page.click("#let-down")
        assert not page.is_visible("#ask")
    else:
        field = {"space in a field": "input[name=body_mass]", "space on enable": of_arm(".down")}.get(means)
        if field:
            page.focus(field)
        page.keyboard.press("Space")
    wait_for_state(page, "letting down", "right")
    wait_for_state(page, "letting down", "left")
    assert active.arms.calls == BOTH_DOWN


def test_one_arm_alone_can_be_let_down_and_what_is_not_confirmed_is_an_alarm(active, page):
    page.click(of_arm(".down", "left"))
    wait_for_state(page, "letting down", "left")
    assert active.arms.calls == [("let_down", "left")]
    active.arms.problem = "can_bridge does not answer"
    page.keyboard.press("Space")
    page.wait_for_selector("#alarm:has-text('NOT confirmed')")
    assert "can_bridge does not answer" in page.inner_text("#alarm")


@pytest.mark.parametrize("width", [390, 768, 1280])
def test_no_state_moves_the_buttons(visit, stage, width):
    for arm in ("right", "left"):
        stage.arms.settings[arm].update(mode="zero_g", support=1.0)
    page = visit(width=width)
    page.select_option("#language", "de")
    places = set()
    for state in ("disabled", "checking", "active", "letting down"):
        stage.arms.states = {"right": state, "left": state}
        wait_for_state(page, state)
        wait_for_state(page, state, "left")
        places.add(str([page.locator(of_arm(part)).bounding_box() for part in (".down", ".support input", ".weigh")]))
    assert len(places) == 1


@pytest.mark.parametrize("width", [390, 768, 1280])
@pytest.mark.parametrize("language", ["en", "de"])
def test_no_text_of_a_fault_is_longer_than_its_place(visit, stage, width, language):
    page = visit(width=width)
    page.select_option("#language", language)
    tallest = page.evaluate(
        """async (column) => {
            const { texts } = await (await fetch("/strings")).json();
            const [why, todo] = [".sentence", ".remedy"].map((part) => document.querySelector(`.arm ${part}`));
            const place = document.querySelector(".arm .tell"), least = parseFloat(getComputedStyle(place).minHeight);
            todo.hidden = false;
            const height = (code) => {
                why.textContent = `${texts[`fault.${code}`][column]} ${texts["sentence.letting down"][column]}`;
                todo.textContent = `${texts[`do.${code}`][column]} ${texts["then.clear"][column]}`;
                return place.getBoundingClientRect().height;
            };
            const codes = Object.keys(texts).filter((key) => key.startsWith("fault.")).map((key) => key.slice(6));
            return Math.max(...codes.map(height)) - least;
        }""",
        ["en", "de"].index(language),
    )
    assert tallest == 0.0


def test_a_fault_shows_its_remedy_moves_no_button_and_is_cleared_or_resumed(page, stage):
    buttons = [page.locator(of_arm(name)) for name in (".enable", '[data-mode="zero_g"]')]
    before = [button.bounding_box() for button in buttons]
    stage.arms.fail("right", "over_temperature")
    wait_for_state(page, "fault")
    assert [button.bounding_box() for button in buttons] == before
    assert "Wait until it has cooled" in page.inner_text(of_arm(".remedy"))
    assert "Then press Clear fault." in page.inner_text(of_arm(".remedy"))
    assert page.is_disabled(of_arm(".enable")) and not page.is_visible(of_arm(".resume"))
    page.click(of_arm(".clear"))
    wait_for_state(page, "disabled")
    assert "cooled" not in page.inner_text(of_arm(".tell"))
    stage.arms.fail("right", "command_stale")  # it leaves nothing to repair
    page.wait_for_selector(of_arm(".remedy:has-text('Then press Carry again.')"))
    page.click(of_arm(".resume"))
    wait_for_state(page, "active")
    assert stage.arms.calls[-1] == ("resume", "right")
    assert not page.is_visible(of_arm(".resume"))


def test_a_start_from_unknown_angles_asks_beside_the_picture_whether_the_arm_hangs_so(page, stage):
    stage.arms.states["right"], stage.arms.asked["right"] = "checking", "0, -2, 1, 23"
    wait_for_state(page, "checking")
    question = page.locator('.pose[data-arm="right"]')
    question.wait_for()
    assert "Elbow flexion 23°" in question.inner_text()
    assert not page.is_visible('.pose[data-arm="left"]')
    page.evaluate("scrollTo(0, 0)")
    page.click(of_arm(".look"))
    assert page.locator("#picture").evaluate("picture => picture.getBoundingClientRect().top < innerHeight / 2")
    question.get_by_role("button").click()
    question.wait_for(state="hidden")
    assert stage.arms.calls[-1] == ("confirm_pose", "right")


def test_the_support_slides_shows_the_motors_limit_and_asks_beyond_it(visit, stage):
    stage.arms.states["right"] = "active"
    stage.arms.settings["right"]["mode"] = "zero_g"
    page, slider = visit(), of_arm(".support input")
    page.wait_for_selector(of_arm(".mark:not([hidden])"), state="attached")
    mark = page.eval_on_selector(of_arm(".mark"), "mark => parseFloat(mark.style.left)")
    assert 5.0 < mark < 9.0  # %, as docs/parameters.md computes it for 75 kg
    assert "rated torque allows" in page.inner_text(of_arm(".limit"))
    page.wait_for_selector(f"{slider}:enabled")
    assert page.input_value(slider) == "5"
    page.focus(slider)
    page.keyboard.press("ArrowRight")
    wait_until(page, lambda: ("set", "right", "{'support': 0.055}") in stage.arms.calls)
    page.keyboard.press("End")  # a slip
    page.wait_for_selector("#ask:visible")
    page.click("#ask-no")
    wait_until(page, lambda: page.input_value(slider) == "5.5")
    page.fill(slider, "15")  # in one move: the page asks 0.3 s after the last one
    confirm(page, "More than rated torque")
    wait_until(page, lambda: stage.arms.settings["right"]["support"] == pytest.approx(0.15))
    assert "More than rated torque" in page.inner_text(of_arm(".limit"))
    assert len(stage.arms.calls) == 2


def test_zero_g_and_one_g_of_an_arm_that_is_carried_ask_first_and_the_support_starts_at_0(visit, stage):
    page, settings = visit(), stage.arms.settings["right"]
    for mode, words in (("zero_g", ""), ("one_g", "it sinks slowly")):
        page.click(of_arm(f'[data-mode="{mode}"]'))
        assert settings["mode"] != mode
        confirm(page, words)
        page.wait_for_selector(of_arm(f'[data-mode="{mode}"][aria-pressed="true"]'))
        if mode == "zero_g":
            assert (settings["mode"], settings["support"]) == ("zero_g", 0.0)
        stage.arms.states["right"] = "active"
        wait_for_state(page, "active")


def test_the_first_wearers_data_of_a_carried_arm_ask_first_and_set_the_support_to_0(visit, stage):
    stage.arms.states["right"] = "active"
    stage.arms.settings["right"].update({"mode": "zero_g", "support": 1.0, "wearer.body_mass": 0.0})
    stage.arms.settings["right"]["wearer.first_moment"] = [0.2, 0.4, 0.8, 0.3]  # of the last wearer
    page = visit()
    wait_for_state(page, "active")
    page.fill("input[name=body_mass]", "62")
    page.click("#wearer button")
    assert stage.arms.calls == []
    confirm(page, "may move slowly")
    wait_until(page, lambda: len(stage.arms.calls) == 2)
    right, left = (stage.arms.settings[arm] for arm in ("right", "left"))
    assert (right["wearer.body_mass"], right["support"], left["support"]) == (62.0, 0.0, 0.05)
    assert right["wearer.first_moment"] == [0.0] * 4


def test_a_heavier_wearers_data_lower_the_support_to_what_rated_torque_allows(page, stage):
    page.wait_for_selector(of_arm(".mark:not([hidden])"), state="attached")  # at 6.8 %
    page.fill("input[name=body_mass]", "60")
    page.click("#wearer button")
    page.wait_for_selector("#message:has-text('Applied')")
    assert "raise it" not in page.inner_text("#message")
    page.fill("input[name=body_mass]", "100")  # the stage's limit stays that of 60 kg: 4.08 %
    page.click("#wearer button")
    page.wait_for_selector("#message:has-text('The support of the right arm is now 4.0 %')")
    assert [stage.arms.settings[arm]["support"] for arm in ("right", "left")] == [0.04, 0.04]


def test_an_arm_that_moves_is_not_called_carried(visit, stage):
    stage.arms.states["right"] = "active"
    stage.arms.changing, stage.arms.sinking = "right_elbow_flexion", 0.2
    page, state = visit(), of_arm(".state")
    page.wait_for_selector(f"{state}:has-text('Sinking')")
    stage.arms.sinking = -0.2
    page.wait_for_selector(f"{state}:has-text('Moving')")
    assert "The load is changing" in page.inner_text(of_arm(".sentence"))
    stage.arms.changing = "none"
    page.wait_for_selector(of_arm(".remedy:has-text('If the wearer does not move it')"))
    stage.arms.sinking = 0.2
    page.wait_for_selector("#chips .badge[data-moves]:has-text('Right arm: Sinking')")
    stage.arms.sinking = 0.0
    page.wait_for_selector(f"{state}:has-text('Carrying')")
    assert "The arm is carried." in page.inner_text(of_arm(".sentence"))


def test_the_bar_says_in_sight_what_the_arms_do_and_let_down_is_grey_while_the_motors_are_off(page, stage):
    wait_for_state(page, "disabled")
    assert page.locator("#let-down[data-off]").count() == 1
    assert "motors of all arms are off" in page.inner_text("#let-down-hint")
    stage.arms.states["right"] = "active"
    page.wait_for_selector("#chips .badge[data-state=active]:has-text('Right arm: Carrying')")
    assert page.locator("#let-down[data-off]").count() == 0
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    box = page.locator("#chips").bounding_box()
    assert box is not None and 0 <= box["y"] < 60
    assert not page.is_visible("#light")
    page.click("#record")
    page.wait_for_selector("#light:visible")
    assert page.inner_text("#source") == "SIMULATED" and page.inner_text("#connection") == "Connected"


@pytest.mark.parametrize("width", [390, 768])
@pytest.mark.parametrize("language", ["en", "de"])
def test_while_recording_nothing_is_cut_off_and_source_and_connection_stay_in_sight(visit, stage, width, language):
    stage.arms.settings["right"].update(mode="zero_g", support=1.0)
    stage.arms.states["right"] = "ramping in"  # the longest name of a state
    stage.arms.fail("left", "implausible_zero")
    recording = {"on": True, "foreign": False, "folder": f"/home/clinic/recordings/{'P' * 60}", "seconds": 3600}
    stage.files.content["recording"] = recording
    page = visit(width=width, height=844)
    page.select_option("#language", language)
    page.wait_for_selector("#light:visible")
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    for part in ("#source", "#connection", "#light", "#chips .badge >> nth=0"):
        box = page.locator(part).bounding_box()
        assert box is not None and 0 <= box["y"] < 120 and box["x"] + box["width"] <= width
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    temperature = page.locator(of_arm("tbody tr:first-child td:last-child")).bounding_box()
    card = page.locator(".arm[data-arm=right]").bounding_box()
    assert temperature["x"] + temperature["width"] <= card["x"] + card["width"]


def test_the_page_says_which_arm_is_simulated_as_the_devices_say(visit, stage):
    stage.arms.simulator = None
    stage.arms.reports = {"right": {"source": "real"}, "left": {"source": "unknown"}}
    page = visit()
    page.wait_for_selector("#source:has-text('Right arm: Real arm, Left arm: Source unknown')")
    assert not page.is_visible(of_arm(".home"))
    stage.arms.reports["left"] = {"source": "real"}
    wait_until(page, lambda: page.inner_text("#source") == "Real arm")


def test_a_reload_in_the_middle_keeps_control_and_shows_the_state(page, stage):
    enable(page)
    wait_for_state(page, "active")
    page.reload()
    wait_for_state(page, "active")
    page.wait_for_selector("#release:visible")
    page.keyboard.press("Space")
    wait_for_state(page, "letting down")


def test_the_second_page_watches_lets_down_and_takes_control(visit, stage, monkeypatch):
    monkeypatch.setattr(
        control, "LIMITS", replace(control.LIMITS, gone=PATIENCE / 1000)
    )  # a busy machine silences a page for seconds
    first = visit()
    first.wait_for_selector("#release:visible")
    second = visit()
    second.wait_for_selector("#take:visible")
    assert second.is_disabled(of_arm(".enable"))
    enable(first)
    wait_for_state(second, "active")
    second.keyboard.press("Space")
    wait_for_state(first, "letting down")
    stage.arms.states["right"] = "disabled"
    second.click("#take")
    second.click("#ask-yes")
    enable(second)
    wait_for_state(second, "active")
    first.wait_for_selector("#take:visible")
    assert first.is_disabled(of_arm(".clear"))


def test_without_a_connection_the_page_shows_no_old_state(active, page):
    wait_for_state(page, "active")
    active.server.stop()
    wait_for_state(page, "unseen")
    assert "cannot see the arms" in page.inner_text("#alarm")
    assert "cannot see the arm" in page.inner_text(of_arm(".sentence"))
    assert page.locator(of_arm("tbody tr")).count() == 0
    page.keyboard.press("Space")
    page.wait_for_selector("#alarm:has-text('NOT confirmed')")


def test_recording_trial_wearer_and_parameters_are_asked_for(page, stage):
    page.click("#record")
    page.click("#record-stop:enabled")
    page.select_option("#trials", "two_poses")
    page.click("#trial-start")
    page.click("#save")
    wait_until(page, lambda: "save" in stage.files.calls)
    page.fill("input[name=body_mass]", "62")
    page.select_option("select[name=sex]", "female")
    page.click("#wearer button")
    page.wait_for_selector("#message:has-text('Applied')")
    assert stage.files.calls == ["record", "stop_recording", "trial two_poses", "save"]
    assert [stage.arms.settings[arm]["wearer.body_mass"] for arm in ("right", "left")] == [62.0, 62.0]
    assert not any("62" in note for note in stage.notes)


def test_a_subject_is_chosen_with_its_wearer_and_the_past_sessions_have_their_reports(visit, stage, tmp_path):
    report = tmp_path / "report.html"
    report.write_text("<h1>demo of P01</h1>")
    name = "P01/2026-03-14/demo_20260314_120000"
    entry = {"subject": "P01", "trial": "demo", "when": "2026-03-14 12:00:00", "report": name}
    stage.files.recorded, stage.files.reports, stage.files.wearers = [entry], {name: report}, {"P01": WEARER_FILE}
    page = visit()
    page.click("#session summary")
    assert page.inner_text("#past tr").split("\t")[:3] == ["2026-03-14 12:00:00", "P01", "demo"]
    with page.context.expect_page() as opened:
        page.click("#past a")
    assert opened.value.inner_text("h1") == "demo of P01"

    page.fill("#session [name=subject]", "Anna Meier")
    page.click("#session button:not([type])")
    assert stage.files.calls == []  # the browser refuses what is no code
    page.fill("#session [name=subject]", "P01")
    page.click("#session [name=note]")
    page.keyboard.type("second visit")  # a space while all motors are off
    page.keyboard.press("Enter")
    page.wait_for_selector("#session-text:has-text('P01')")
    assert stage.files.calls == ["session P01, , second visit"] and stage.arms.calls == []
    assert "delete that folder" in page.inner_text("#session-text")
    assert page.input_value("#wearer [name=body_mass]") == "61.5"
    page.click("#wearer button")
    wait_until(page, lambda: len(stage.arms.calls) == 2)
    for arm, settings in stage.arms.settings.items():
        assert {key: settings[key] for key in WEARER_FILE} == WEARER_FILE, arm


def test_the_key_m_sets_a_marker_while_it_is_recorded(visit, stage):
    page = visit()
    page.fill("#markers [name=marker_text]", "cramp at 3")
    page.click("#plots-head")
    page.keyboard.press("m")
    page.click("#record")
    page.wait_for_selector("#marker:enabled")
    page.click("#plots-head")
    page.keyboard.press("m")
    page.wait_for_selector("#message:has-text('cramp at 3')")
    page.click("#marker")
    watching = visit()
    watching.wait_for_selector("#marker:enabled")
    watching.click("#marker")
    watching.wait_for_selector("#message:has-text('marker')")
    assert stage.files.calls == ["record", "marker cramp at 3", "marker cramp at 3", "marker "]


def test_usual_markers_have_a_button_and_a_digit_and_the_space_bar_still_lets_down(active, page):
    wait_for_state(page, "active")
    assert page.is_disabled("#presets button") and page.is_disabled("[name=marker_text]")
    page.click("#record")
    page.click("#presets button:has-text('Task begins')")
    page.keyboard.press("2")
    page.click('#presets button:has-text("a text of one\'s own")')
    wait_until(page, lambda: len(active.files.calls) == 4)
    assert active.files.calls[1:] == ["marker begin", "marker end", "marker a text of one's own"]
    page.keyboard.press("Space")
    wait_for_state(page, "letting down")


def test_while_an_arm_is_carried_no_text_field_takes_the_space_bar(page, stage):
    page.focus("#session [name=note]")
    stage.arms.states["right"] = "active"
    wait_for_state(page, "active")
    page.wait_for_selector("#session [name=note]:disabled")
    page.keyboard.press("Space")
    wait_for_state(page, "letting down")
    assert stage.arms.calls == BOTH_DOWN


def test_the_share_that_the_wearer_carries_is_a_bar_with_its_band(active, page):
    for reported, shown in ((("unknown",) * 2, "–"), (("40", "10"), "40 %"), (("-30", "10"), "-30 %")):  # pressed down
        active.arms.share = reported
        wait_until(page, lambda shown=shown: page.inner_text(of_arm(".carries strong")) == shown)
        boxes = [page.locator(of_arm(f".{part}")).bounding_box() for part in ("bar", "part", "band")]
        if shown == "40 %":
            (start, whole), (_, part), (low, band) = [(box["x"], box["width"]) for box in boxes]
            assert abs(part / whole - 0.4) < 0.02 and abs(band / whole - 0.2) < 0.02
            assert abs((low - start) / whole - 0.3) < 0.02
    assert boxes[1]["width"] == 0.0


def test_the_share_of_each_joint_is_shown_with_its_band_where_it_is_known(visit, active):
    elbow, abduction = "right_elbow_flexion", "right_shoulder_abduction"
    active.arms.joint_shares = {f"{elbow} share (%)": "100", f"{elbow} share band (%)": "14"}
    active.arms.joint_shares |= {f"{abduction} share (%)": "3", f"{abduction} share band (%)": "60"}
    page = visit()
    page.wait_for_selector(f"{of_arm('.shares')}:has-text('Elbow flexion 100 % (±14)')")
    assert "abduction too uncertain" in page.inner_text(of_arm(".shares"))
    assert "rotation" not in page.inner_text(of_arm(".shares"))


def test_the_share_is_shown_only_while_it_means_something(visit, stage):
    stage.arms.share = ("111", "9")
    page, words = visit(), of_arm(".carries .width")
    page.wait_for_selector(f"{words}:has-text('while the arm is carried')")
    assert page.inner_text(of_arm(".carries strong")) == "–"
    assert page.locator(of_arm(".part")).bounding_box()["width"] == 0.0
    stage.arms.states["right"] = "active"
    wait_until(page, lambda: page.inner_text(of_arm(".carries strong")) == "111 %")
    stage.arms.share = ("40", "60")
    page.wait_for_selector(f"{words}:has-text('Too uncertain')")
    stage.arms.share, stage.arms.limit = ("40", "9"), "none"
    stage.arms.settings["right"]["wearer.body_mass"] = 0.0
    page.wait_for_selector(f'{words}:has-text("Enter the wearer\'s data")')
    assert page.inner_text(of_arm(".carries strong")) == "–"


def test_in_one_g_the_motors_carry_nothing_of_the_wearers_arm(page, stage):
    page.wait_for_selector(of_arm(".mark:not([hidden])"), state="attached")
    assert page.input_value(of_arm(".support input")) == "0" and page.is_disabled(of_arm(".support input"))
    stage.arms.settings["right"]["mode"] = "zero_g"
    wait_until(page, lambda: page.input_value(of_arm(".support input")) == "5")


def test_a_plot_without_a_curve_says_why(visit, stage):
    stage.arms.silent = {"left"}
    nothing = {f"right_{leaf} temperature (degC)": "unknown" for leaf in LEAVES}
    stage.arms.reports["right"] = nothing
    page = visit()
    page.wait_for_selector("#plots-blank:has-text('Left arm: Blank: no angles have arrived')")
    page.wait_for_selector(".blank:has-text('report no temperature')")
    stage.arms.reports.clear()
    wait_until(page, lambda: page.locator(".blank:has-text('temperature')").count() == 0)


def test_every_plot_is_as_wide_as_its_place(visit, stage):
    stage.arms.silent = {"right", "left"}
    page = visit(width=1280)  # two plots in a row
    page.wait_for_selector("#plots-blank:visible")
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")  # all has its size
    stage.arms.silent = set()
    wait_until(page, lambda: page.locator("#plots figure").count() == 8)
    widths = "figures => figures.map(figure => [figure.clientWidth, figure.querySelector('.u-wrap').clientWidth])"
    wait_until(page, lambda: all(a == b for a, b in page.eval_on_selector_all("#plots figure", widths)))


def test_a_load_is_weighed_after_a_question_and_carried_after_another(visit, stage):
    page, weigh, carry = visit(), of_arm(".weigh"), of_arm(".carry")
    assert page.is_disabled(weigh) and not page.is_visible(carry)
    enable(page)
    wait_for_state(page, "active")
    page.click(weigh)
    confirm(page, "relax within 4 s")
    wait_until(page, lambda: ("weigh", "right") in stage.arms.calls)
    stage.arms.compensator = {"weighing": "sweeping", "weighing time (s)": "9"}
    page.wait_for_selector(of_arm(".weighing:has-text('Do not help it (9 s)')"))
    more = {"weighed mass (kg)": "1.050", "weighed band (kg)": "0.080"}
    stage.arms.compensator = {"weighing": "done", **more}
    stage.arms.compensator |= {"weighed payload (kg)": "0.990", "weighed payload band (kg)": "0.052"}
    touched = {"contacts": "1", "contact joint": "right_elbow_flexion"}
    stage.arms.contact = {**touched, "contact torque (Nm)": "4.0", "contact age (s)": "1"}
    page.wait_for_selector(carry, state="visible")
    assert page.inner_text(carry) == "Carry 0.99 kg (±0.05)"
    assert "Elbow flexion +4.0 Nm" in page.inner_text(of_arm(".contact"))
    assert "adapts" not in page.inner_text(of_arm(".limit"))
    stage.arms.adapts = {"support adapts": "on", "support asked for": "0.52"}
    wait_until(page, lambda: "support adapts: 5 -> 52 %" in page.inner_text(of_arm(".limit")))
    page.click(carry)
    confirm(page, "0.99 kg in the hand instead of 0.00 kg")
    wait_until(page, lambda: stage.arms.settings["right"]["payload.mass"] == 0.99)
    page.wait_for_selector(carry, state="hidden")
    assert "0.99 kg is carried" in page.inner_text(of_arm(".payload"))
