"""Who may do what: requests are checked, one page holds control, and letting down always works."""

from __future__ import annotations

import asyncio
from typing import NamedTuple

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.lease import LEASE_TIME
from exo_gravity.panel.control import (
    BURST,
    GONE,
    MAX_PAGES,
    REFILL,
    Control,
    Page,
    parse,
    sentence,
)

from ..support.panel_stage import PlayedArms, PlayedFiles


class Reply(NamedTuple):
    """The answer to a request."""

    status: int
    text: str


DOWN = [("let_down", "right"), ("let_down", "left")]


class Panel(Control):
    """Two pages, of which the first holds control, and what the arms were asked for."""

    def __init__(self) -> None:
        self.now = 100.0
        self.arms, self.files, self.notes = PlayedArms(), PlayedFiles(), list[str]()
        self.note_error: Exception | None = None
        super().__init__(self.arms, self.files, self.write, lambda: self.now)
        self.first, self.second = (self.opened(f"10.0.0.{n}") for n in (1, 2))

    def write(self, text: str) -> None:
        if self.note_error:
            raise self.note_error
        self.notes.append(text)

    def opened(self, address: str = "10.0.0.3", secret: str = "") -> Page:
        page = self.open(secret, address)
        assert page is not None
        page.connection = "open"
        return page

    def ask(self, page: Page | str, **body: object) -> Reply:
        secret = page if isinstance(page, str) else page.secret
        return Reply(*asyncio.run(self.perform(body, secret, "10.0.0.9")))


@pytest.fixture
def panel() -> Panel:
    """A panel with two pages."""
    return Panel()


# Requests


@pytest.mark.parametrize(
    "body",
    [
        {"do": "let_down"},
        {"do": "let_down", "arm": "left"},
        {"do": "enable", "arm": "right"},
        {"do": "set", "arm": "right", "values": {"support": 1}},
        {"do": "trial", "name": "demo"},
        {"do": "take"},
    ],
)
def test_a_right_request_is_understood(body):
    assert parse(body, ("right", "left"), ("demo",)) == body


def test_a_whole_number_is_sent_as_the_parameters_type():
    body = {"do": "set", "arm": "right", "values": {"support": 1}}
    assert isinstance(parse(body, ("right",), ())["values"]["support"], float)


@pytest.mark.parametrize(
    "body",
    [
        None,
        [],
        "let_down",
        {},
        {"do": "set_zero", "arm": "right"},
        {"do": ["enable"]},
        {"do": "enable"},
        {"do": "enable", "arm": "middle"},
        {"do": "enable", "arm": ["right"]},
        {"do": "enable", "arm": "right", "force": True},
        {"do": "let_down", "arm": None},
        {"do": "take", "arm": "right"},
        {"do": "trial", "name": "../../etc/passwd"},
        {"do": "trial"},
        {"do": "set", "arm": "right"},
        {"do": "set", "arm": "right", "values": {}},
        {"do": "set", "arm": "right", "values": [["support", 1]]},
        {"do": "set", "arm": "right", "values": {"max_effort": [40.0] * 4}},
        {"do": "set", "arm": "right", "values": {"robot.mass": [0.1] * 4}},
        {"do": "set", "arm": "right", "values": {"support": 1.01}},
        {"do": "set", "arm": "right", "values": {"support": -0.01}},
        {"do": "set", "arm": "right", "values": {"support": float("nan")}},
        {"do": "set", "arm": "right", "values": {"support": True}},
        {"do": "set", "arm": "right", "values": {"support": "1"}},
        {"do": "set", "arm": "right", "values": {"mode": "two_g"}},
        {"do": "set", "arm": "right", "values": {"wearer.body_mass": 301.0}},
        {"do": "set", "arm": "right", "values": {"wearer.segment_length": [0.3, 0.3]}},
        {"do": "set", "arm": "right", "values": {"support": 0.5, "law": "exact"}},
    ],
)
def test_a_wrong_request_is_refused(body):
    with pytest.raises(ParameterError):
        parse(body, ("right", "left"), ("demo",))


def test_the_log_shows_the_support_but_not_the_wearers_data():
    values = {"support": 0.3, "wearer.body_mass": 81.5, "wearer.sex": "female"}
    text = sentence({"do": "set", "arm": "right", "values": values})
    assert text == "set right support = 0.3, wearer.body_mass, wearer.sex"


def test_a_refusal_keeps_the_wearers_data_out_of_the_log(panel):
    for values in ({"wearer.body_mass": 81.5, "law": "exact"}, {"wearer.body_mass": 815.0}):
        assert panel.ask(panel.first, do="set", arm="right", values=values).status == 400
        assert "wearer.body_mass" in panel.notes[-1] and "81" not in panel.notes[-1]


# What is done


def test_the_operator_enables_an_arm_and_it_is_noted_with_the_client(panel):
    assert panel.ask(panel.first, do="enable", arm="right") == (200, "")
    assert panel.arms.calls == [("enable", "right")]
    assert panel.notes == ["10.0.0.1 page 1: enable right: done"]


@pytest.mark.parametrize("kind", ["enable", "clear_fault", "resume"])
def test_a_page_that_watches_moves_nothing(panel, kind):
    for page in (panel.second, "", "guessed"):
        assert panel.ask(page, do=kind, arm="right").status == 403
    assert panel.arms.calls == []


def test_every_page_may_let_down_even_an_unknown_one(panel):
    for page in (panel.first, panel.second, "", "guessed"):
        panel.arms.calls.clear()
        assert panel.ask(page, do="let_down").status == 200
        assert panel.arms.calls == DOWN
    assert panel.ask("", do="let_down", arm="left").status == 200
    assert panel.arms.calls[-1] == ("let_down", "left")


def test_letting_down_has_no_rate_limit_and_everything_else_has(panel):
    def statuses(count: int) -> list[int]:
        return [panel.ask(panel.first, do="clear_fault", arm="right").status for _ in range(count)]

    assert statuses(int(BURST) + 1) == [200] * int(BURST) + [429]
    panel.now += 1.0
    assert statuses(int(REFILL) + 1) == [200] * int(REFILL) + [429]
    assert [panel.ask(panel.first, do="let_down").status for _ in range(50)] == [200] * 50


def test_a_flood_of_wrong_requests_does_not_fill_the_log(panel):
    for _ in range(500):
        panel.ask(panel.first, do="nonsense")
    assert len(panel.notes) <= BURST


def test_a_refusal_of_the_device_reaches_the_page_and_the_log(panel):
    panel.arms.problem = "refused: the arm is active"
    assert panel.ask(panel.first, do="enable", arm="right") == (409, "refused: the arm is active")
    assert panel.notes[-1].endswith("enable right: refused: the arm is active")
    assert panel.ask(panel.first, do="let_down").text == (
        "right: refused: the arm is active; left: refused: the arm is active"
    )


def test_an_arm_that_raises_does_not_keep_the_other_one_up(panel):
    panel.arms.errors["right"] = RuntimeError("the client is gone")
    assert panel.ask(panel.first, do="let_down") == (409, "right: RuntimeError: the client is gone")
    assert panel.arms.calls == DOWN


def test_without_an_arm_letting_down_fails_visibly(panel):
    panel.arms.names = ()
    assert panel.ask(panel.first, do="let_down").status == 409


def test_only_the_operator_uses_recordings_trials_and_files(panel):
    for kind in ("record", "stop_recording", "save", "stop_trial"):
        assert panel.ask(panel.second, do=kind).status == 403
        assert panel.ask(panel.first, do=kind).status == 200
    assert panel.ask(panel.first, do="trial", name="demo").status == 200
    assert panel.files.calls == ["record", "stop_recording", "save", "stop_trial", "trial demo"]


# Who holds control


def test_control_is_taken_and_given_up(panel):
    assert panel.ask(panel.second, do="take").status == 200
    assert panel.ask(panel.second, do="enable", arm="left").status == 200
    assert panel.ask(panel.first, do="enable", arm="left").status == 403
    panel.ask(panel.second, do="release")
    assert panel.ask(panel.second, do="enable", arm="left").status == 403
    assert panel.ask("guessed", do="take").status == 403
    assert panel.holder is None


def test_a_reloaded_page_keeps_its_number_and_control(panel):
    panel.first.connection = None
    assert panel.opened(secret=panel.first.secret) is panel.first
    assert panel.holder is panel.first
    assert panel.first.number == 1


def test_a_secret_that_the_panel_did_not_give_is_not_accepted(panel):
    assert panel.opened(secret="my own").secret != "my own"


def test_the_operators_page_is_gone_when_it_confirms_nothing_for_two_seconds(panel):
    panel.now += GONE
    assert not panel.is_gone()
    panel.now += 0.01
    assert panel.is_gone()
    panel.confirm(panel.second)
    assert panel.is_gone()
    panel.confirm(panel.first)
    assert not panel.is_gone()


def test_a_new_page_holds_control_if_the_operators_page_is_gone(panel):
    panel.now += GONE + 0.1
    page = panel.opened()
    assert panel.holder is page


def test_the_number_of_pages_is_limited(panel):
    pages = [panel.first, panel.second, *(panel.opened() for _ in range(MAX_PAGES - 2))]
    assert panel.open("", "10.0.0.1") is None
    pages[5].connection = None
    panel.opened()
    assert panel.open(pages[5].secret, "10.0.0.1") is None
    pages[6].connection = None
    assert panel.opened(secret=pages[6].secret) is pages[6]


# The lease at the arms


def test_each_confirmation_of_the_operators_page_and_nothing_else_renews_its_lease(panel):
    panel.arms.leases.clear()
    panel.confirm(panel.second)
    panel.ask(panel.first, do="let_down")
    panel.open(panel.second.secret, "10.0.0.2")
    assert panel.arms.leases == []
    panel.confirm(panel.first)
    panel.open(panel.first.secret, "10.0.0.1")  # reloaded
    assert panel.arms.leases == [("10.0.0.1 page 1", "hold")] * 2


def test_an_arm_is_not_enabled_without_a_lease(panel):
    panel.arms.leases.clear()
    panel.ask(panel.first, do="enable", arm="right")
    panel.ask(panel.second, do="enable", arm="right")
    assert panel.arms.leases == [("10.0.0.1 page 1", "hold")]


def test_a_page_is_replaced_only_after_its_lease_has_ended():
    assert GONE > LEASE_TIME + 0.1  # s between two looks of the bridge


def test_taking_and_giving_up_control_reaches_the_arms(panel):
    panel.arms.leases.clear()
    panel.ask(panel.second, do="take")
    panel.confirm(panel.first)
    panel.confirm(panel.second)
    panel.ask(panel.second, do="release")
    panel.confirm(panel.second)
    assert panel.arms.leases == [("10.0.0.2 page 2", kind) for kind in ("take", "hold", "release")]


def test_an_arm_that_another_name_holds_is_only_let_down(panel):
    panel.arms.others["left"] = "anna"
    assert panel.elsewhere == "anna"
    for body in ({"do": "enable"}, {"do": "clear_fault"}, {"do": "set", "values": {"support": 0.1}}):
        assert panel.ask(panel.first, arm="left", **body).status == 403
        assert panel.notes[-1].endswith("anna holds control of this arm")
    assert panel.arms.calls == []
    assert panel.ask(panel.first, do="enable", arm="right").status == 200
    assert panel.ask(panel.first, do="let_down", arm="left").status == 200


def test_a_log_that_raises_keeps_no_arm_up(panel, caplog):
    panel.note_error = OSError("no space left")
    assert panel.ask(panel.first, do="let_down") == (200, "")
    assert panel.arms.calls == DOWN
    assert "no space left" in caplog.text and "page 1: let down: done" in caplog.text
