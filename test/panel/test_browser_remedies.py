# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the page tells its operator to do, in a real browser: what a check waits for, what caused a fault."""

from __future__ import annotations

import pytest

pytest.importorskip("playwright", reason="no browser driver: install the extra test")

from ..support.panel_browser import IN_BROWSER, of_arm, wait_for_state

pytestmark = IN_BROWSER


def test_a_check_that_waits_says_in_degrees_which_joint_to_turn_and_a_simulated_arm_is_put_back(visit, stage):
    astray = {"joints outside limits": "right_elbow_flexion", "turn back (deg)": "-0.1"}
    stage.arms.states["right"], stage.arms.reports["right"] = "checking", {"waiting for": "joint_limits", **astray}
    page = visit()
    sentence = of_arm(".sentence")
    page.wait_for_selector(f"{sentence}:has-text('Elbow flexion: turn it back by 0.1°.')")
    page.select_option("#language", "de")
    page.wait_for_selector(f"{sentence}:has-text('Ellenbogen Beugung: um 0,1° zurückdrehen.')")
    page.select_option("#language", "en")
    page.click(of_arm(".home"))
    stage.arms.states["right"], stage.arms.reports["right"] = "disabled", {"refusal": "joint_limits", **astray}
    page.wait_for_selector(f"{sentence}:has-text('The motors stayed off. Elbow flexion')")
    stage.arms.reports["right"] = {"refusal": "motor_on"}
    page.wait_for_selector(f"{sentence}:has-text('The motors stayed off. A motor was on already.')")
    stage.arms.reports.clear()
    stage.arms.states["right"] = "active"
    wait_for_state(page, "active")
    assert stage.arms.calls == [("bring_home", "right")]
    assert page.is_disabled(of_arm(".home"))


def test_a_fault_after_a_change_of_load_names_the_change_also_after_a_reload(visit, stage):
    stage.arms.states["right"] = "active"
    stage.arms.settings["right"].update({"mode": "zero_g", "support": 0.05})
    page = visit()
    wait_for_state(page, "active")
    for support in (0.3, 0.65):  # a slider on its way
        stage.arms.settings["right"]["support"] = support
        page.wait_for_timeout(300)
    stage.arms.fail("right", "over_speed")
    told = of_arm(".tell")
    named = f"{told}:has-text('the support was changed from 5.0 % to 65.0 %'):has-text('Set it back')"
    page.wait_for_selector(named)
    assert "A joint moved too fast" in page.inner_text(told)
    page.reload()
    page.wait_for_selector(named)
    stage.arms.fail("right", "over_temperature")
    page.wait_for_selector(f"{told}:has-text('too hot')")
    assert "changed" not in page.inner_text(told)


def test_a_silent_motor_of_a_simulated_arm_is_the_computers_fault(page, stage):
    remedy = of_arm(".tell")
    stage.arms.fail("right", "motor_silent")
    page.wait_for_selector(f"{remedy}:has-text('CAN cable')")
    stage.arms.simulator = {"longest stall (ms)": "8", "longest silence (ms)": "212", "disconnected": "no"}
    page.wait_for_selector(f"{remedy}:has-text('This computer was too busy')")
    assert "212 ms" in page.inner_text(remedy) and "CAN cable" not in page.inner_text(remedy)
    stage.arms.fail("right", "wrong_sign")
    page.wait_for_selector(f"{remedy}:has-text('212 ms'):has-text('wrong way')")
    stage.arms.fail("right", "motor_silent")
    stage.arms.simulator = {**stage.arms.simulator, "disconnected": "yes"}  # a fault that is simulated
    page.wait_for_selector(f"{remedy}:has-text('CAN cable')")
    stage.arms.simulator = None
    page.wait_for_selector(f"{remedy}:has-text('The simulator does not report')")


def test_an_engineer_is_called_before_the_arm_is_carried_again_and_a_motor_out_of_reach_is_cut_off(page, stage):
    told = of_arm(".tell")
    stage.arms.fail("right", "wrong_sign")
    page.wait_for_selector(f"{told}:has-text('Call the engineer')")
    assert "Then press" not in page.inner_text(told)
    stage.arms.reports["right"] = {"motors": "unreached"}
    page.wait_for_selector(f"{told}:has-text('A motor may still be powered.')")
    assert page.inner_text(of_arm(".remedy")).startswith("Hold the arm and cut the motors' supply.")


def test_the_reason_of_a_compensator_that_withdrew_is_told_in_the_pages_language(page, stage):
    stage.arms.compensator = {"state": "withdrawn", "reason": "late_tilt"}
    stage.arms.fail("right", "command_withdrawn")
    page.wait_for_selector(of_arm(".sentence:has-text('The compensator stopped.'):has-text('tilt is late')"))
    page.select_option("#language", "de")
    page.wait_for_selector(of_arm(".sentence:has-text('Die Neigung des Rumpfs kommt zu spät')"))
