"""The desk: who may do what, what is noted, and that letting down always works."""

from __future__ import annotations

import asyncio

import pytest

from exo_gravity.panel.control import BURST, GONE, Control
from exo_gravity.panel.desk import RETRY, Desk, Outcome

from ..support.panel_stage import PlayedArms, PlayedFiles

DOWN = [("let_down", "right"), ("let_down", "left")]


class Office:
    """A desk, its arms, and two pages of which the first holds control."""

    def __init__(self, dead_man: bool = False) -> None:
        self.now = 100.0
        self.arms, self.files, self.notes = PlayedArms(), PlayedFiles(), list[str]()
        self.control = Control(lambda: self.now, dead_man)
        self.desk = Desk(self.arms, self.files, self.control, self.notes.append, lambda: self.now)
        self.first, self.second = (self.control.open("", f"10.0.0.{n}")[0] for n in (1, 2))

    def ask(self, secret: str, **body: object) -> Outcome:
        return asyncio.run(self.desk.perform(body, secret, "10.0.0.9"))

    def watch(self) -> None:
        asyncio.run(self.desk.watch())


@pytest.fixture
def office() -> Office:
    """A desk without dead man."""
    return Office()


def test_the_operator_enables_an_arm_and_it_is_noted_with_the_client(office):
    assert office.ask(office.first, do="enable", arm="right") == (200, "")
    assert office.arms.calls == [("enable", "right")]
    assert office.notes == ["10.0.0.1 page 1: enable right: done"]


@pytest.mark.parametrize("kind", ["enable", "clear_fault"])
def test_a_page_that_watches_moves_nothing(office, kind):
    assert office.ask(office.second, do=kind, arm="right").status == 403
    assert office.ask("", do=kind, arm="right").status == 403
    assert office.ask("guessed", do=kind, arm="right").status == 403
    assert office.arms.calls == []


def test_every_page_may_let_down_even_one_that_the_panel_does_not_know(office):
    for secret in (office.first, office.second, "", "guessed"):
        office.arms.calls.clear()
        assert office.ask(secret, do="let_down").status == 200
        assert office.arms.calls == DOWN
    assert office.ask("", do="let_down", arm="left").status == 200
    assert office.arms.calls[-1] == ("let_down", "left")


def test_letting_down_has_no_rate_limit_and_everything_else_has(office):
    statuses = [office.ask(office.first, do="clear_fault", arm="right").status for _ in range(int(BURST) + 5)]
    assert statuses[0] == 200
    assert statuses[-1] == 429
    assert [office.ask(office.first, do="let_down").status for _ in range(50)] == [200] * 50


def test_a_flood_of_wrong_requests_does_not_fill_the_log(office):
    for _ in range(500):
        office.ask(office.first, do="nonsense")
    assert len(office.notes) <= BURST


def test_control_is_taken_and_given_up(office):
    assert office.ask(office.second, do="take").status == 200
    assert office.ask(office.second, do="enable", arm="left").status == 200
    assert office.ask(office.first, do="enable", arm="left").status == 403
    office.ask(office.second, do="release")
    assert office.ask(office.second, do="enable", arm="left").status == 403


def test_a_refusal_of_the_device_reaches_the_page_and_the_log(office):
    office.arms.problem = "refused: the arm is active"
    assert office.ask(office.first, do="enable", arm="right") == (409, "refused: the arm is active")
    assert office.notes[-1].endswith("enable right: refused: the arm is active")
    assert office.ask(office.first, do="let_down").text == (
        "right: refused: the arm is active; left: refused: the arm is active"
    )


def test_without_an_arm_letting_down_fails_visibly(office):
    office.arms.names = ()
    assert office.ask(office.first, do="let_down").status == 409


def test_files_are_asked_for_by_the_operator_alone(office):
    for kind in ("record", "stop_recording", "save", "stop_trial"):
        assert office.ask(office.second, do=kind).status == 403
        assert office.ask(office.first, do=kind).status == 200
    assert office.ask(office.first, do="trial", name="demo").status == 200
    assert office.files.calls == ["record", "stop_recording", "save", "stop_trial", "trial demo"]


def test_the_arms_go_on_when_the_operators_page_is_gone(office):
    office.now += GONE + 0.1
    office.watch()
    assert office.arms.calls == []


def test_with_dead_man_the_arms_are_let_down_once_when_the_operators_page_is_gone():
    office = Office(dead_man=True)
    office.now += GONE
    office.watch()
    assert office.arms.calls == []
    office.now += 0.1
    office.watch()
    assert office.arms.calls == DOWN
    assert "10.0.0.1 page 1 has been gone for 2 s: let down: done" in office.notes
    office.now += 10.0
    office.watch()
    assert office.arms.calls == DOWN


def test_with_dead_man_a_page_that_opens_meanwhile_does_not_keep_the_arms_up():
    office = Office(dead_man=True)
    office.now += GONE + 0.05
    office.control.open("", "10.0.0.3")
    office.watch()
    assert office.arms.calls == DOWN


def test_with_dead_man_a_page_that_takes_control_replaces_the_one_that_is_gone():
    office = Office(dead_man=True)
    office.now += GONE - 0.1
    office.control.confirm(office.second)
    assert office.ask(office.second, do="take").status == 200
    office.now += 0.2
    office.watch()
    assert office.arms.calls == []


def test_with_dead_man_letting_down_is_repeated_until_it_works():
    office = Office(dead_man=True)
    office.arms.problem = "can_bridge does not answer"
    office.now += GONE + 0.1
    for _ in range(3):
        office.watch()
        office.now += RETRY
    assert office.arms.calls == 3 * DOWN
    office.arms.problem = ""
    office.watch()
    office.now += RETRY
    office.watch()
    assert office.arms.calls == 4 * DOWN
