# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Who may do what: requests are checked, one page holds control, and letting down always works."""

from __future__ import annotations

import asyncio

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.lease import LEASE_TIME
from exo_gravity.panel.control import LIMITS, Control, Page, parse

from ..support.panel_stage import PlayedArms, PlayedFiles

DOWN = [("let_down", "right"), ("let_down", "left")]
OWN_LEASE = ("10.0.0.1 page 1", "hold")


class Panel(Control):
    """Two pages, of which the first holds control, and what the arms were asked for."""

    def __init__(self) -> None:
        self.now = 100.0
        self.arms, self.files, self.notes = PlayedArms(), PlayedFiles(), list[str]()
        self.note_error: Exception | None = None
        super().__init__(self.arms, self.files, self.write, lambda: self.now)
        self.first, self.second = (self.opened(f"10.0.0.{n}") for n in (1, 2))
        self.arms.leases.clear()

    def write(self, text: str) -> None:
        if self.note_error:
            raise self.note_error
        self.notes.append(text)

    def opened(self, address: str = "10.0.0.3", secret: str = "") -> Page:
        page = self.open(secret, address)
        assert page is not None
        page.connection = "open"
        return page

    def ask(self, page: Page | str, kind: str, arm: str = "", **more: object) -> tuple[int, str]:
        secret = page if isinstance(page, str) else page.secret
        body = {"do": kind, **({"arm": arm} if arm else {}), **more}
        return asyncio.run(self.perform(body, secret, "10.0.0.9"))

    def status(self, *request: object, **more: object) -> int:
        return self.ask(*request, **more)[0]


@pytest.fixture
def panel() -> Panel:
    """A panel with two pages."""
    return Panel()


RIGHT = [
    {"do": "let_down"},
    {"do": "let_down", "arm": "left"},
    {"do": "enable", "arm": "right"},
    {"do": "activate", "arm": "right"},
    {"do": "trial", "name": "demo"},
    {"do": "take"},
]
WRONG = [
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
    {"do": "trial", "name": ["demo"]},
    {"do": "set", "arm": "right"},
    *(
        {"do": "set", "arm": "right", "values": values}
        for values in (
            {},
            [["support", 1]],
            {"max_effort": [40.0] * 4},
            {"robot.mass": [0.1] * 4},
            {"support": 1.01},
            {"support": -0.01},
            {"support": float("nan")},
            {"support": 10**400},
            {"support": True},
            {"support": "1"},
            {"mode": "two_g"},
            {"wearer.body_mass": 301.0},
            {"wearer.segment_length": [0.3, 0.3]},
            {"support": 0.5, "law": "exact"},
        )
    ),
]


def test_a_right_request_is_understood_and_a_whole_number_has_the_parameters_type():
    for body in RIGHT:
        assert parse(body, ("right", "left"), ("demo",)) == body
    body = {"do": "set", "arm": "right", "values": {"support": 1}}
    assert isinstance(parse(body, ("right",), ())["values"]["support"], float)


@pytest.mark.parametrize("body", WRONG)
def test_a_wrong_request_is_refused(body):
    with pytest.raises(ParameterError):
        parse(body, ("right", "left"), {"demo"})


def test_log_and_refusals_name_the_client_and_never_the_wearers_data(panel):
    values = {"support": 0.3, "wearer.body_mass": 81.5, "wearer.sex": "female"}
    assert panel.ask(panel.first, "set", "right", values=values) == (200, "")
    assert panel.notes == ["10.0.0.1 page 1: set right support = 0.3, wearer.body_mass, wearer.sex: done"]
    for values in ({"wearer.body_mass": 81.5, "law": "exact"}, {"wearer.body_mass": 815.0}):
        assert panel.status(panel.first, "set", "right", values=values) == 400
        assert "wearer.body_mass" in panel.notes[-1] and "81" not in panel.notes[-1]


def test_every_page_lets_down_and_only_the_one_in_control_does_anything_else(panel):
    for page in (panel.first, panel.second, "", "guessed"):
        panel.arms.calls.clear()
        assert panel.ask(page, "let_down") == (200, "")
        assert panel.arms.calls == DOWN
        assert panel.status(page, "let_down", "left") == 200
        assert panel.arms.calls[-1] == ("let_down", "left")
    for kind in ("enable", "activate", "clear_fault", "resume", "confirm_pose"):
        panel.arms.calls.clear()
        assert [panel.status(page, kind, "right") for page in (panel.second, "", "guessed")] == [403] * 3
        assert panel.arms.calls == []
        assert panel.status(panel.first, kind, "right") == 200
        assert panel.arms.calls == [(kind, "right")]
    for kind, more in [(kind, {}) for kind in ("record", "stop_recording", "save", "stop_trial")] + [
        ("trial", {"name": "demo"})
    ]:
        assert panel.status(panel.second, kind, **more) == 403
        assert panel.status(panel.first, kind, **more) == 200
    assert panel.files.calls == ["record", "stop_recording", "save", "stop_trial", "trial demo"]


def test_letting_down_has_no_rate_limit_and_everything_else_has_also_in_the_log(panel):
    def statuses(count: int) -> list[int]:
        return [panel.status(panel.first, "clear_fault", "right") for _ in range(count)]

    assert statuses(int(LIMITS.burst) + 1) == [200] * int(LIMITS.burst) + [429]
    panel.now += 1.0
    assert statuses(int(LIMITS.refill) + 1) == [200] * int(LIMITS.refill) + [429]
    assert [panel.status(panel.first, "let_down") for _ in range(50)] == [200] * 50
    panel.notes.clear()
    panel.now += 10.0
    for _ in range(500):
        panel.ask(panel.first, "nonsense")
    assert len(panel.notes) <= LIMITS.burst


def test_a_refusal_of_the_device_reaches_the_page_and_the_log(panel):
    panel.arms.problem = "refused: the arm is active"
    assert panel.ask(panel.first, "enable", "right") == (409, "refused: the arm is active")
    assert panel.notes[-1].endswith("enable right: refused: the arm is active")
    assert panel.ask(panel.first, "let_down")[1] == "; ".join(f"{arm}: {panel.arms.problem}" for _, arm in DOWN)


def test_nothing_keeps_an_arm_up_neither_the_other_arm_nor_the_log(panel, caplog):
    panel.arms.errors["right"] = RuntimeError("the client is gone")
    assert panel.ask(panel.first, "let_down") == (409, "right: RuntimeError: the client is gone")
    assert panel.arms.calls == DOWN
    panel.arms.errors.clear()
    panel.arms.calls.clear()
    panel.note_error = OSError("no space left")
    assert panel.ask(panel.first, "let_down") == (200, "")
    assert panel.arms.calls == DOWN
    assert "no space left" in caplog.text and "page 1: let down: done" in caplog.text
    panel.arms.names = ()
    assert panel.status(panel.first, "let_down") == 409  # without an arm it fails visibly


def test_control_is_taken_and_given_up_here_and_at_the_arms(panel):
    assert panel.status(panel.second, "take") == 200
    assert panel.status(panel.first, "enable", "left") == 403
    panel.confirm(panel.first)
    panel.confirm(panel.second)
    panel.ask(panel.second, "release")
    panel.confirm(panel.second)
    assert panel.arms.leases == [("10.0.0.2 page 2", kind) for kind in ("take", "hold", "release")]
    assert panel.status(panel.second, "enable", "left") == panel.status("guessed", "take") == 403
    assert panel.holder is None


def test_a_reloaded_page_keeps_its_number_and_control_and_no_other_secret_is_accepted(panel):
    panel.first.connection = None
    assert panel.opened(secret=panel.first.secret) is panel.first is panel.holder
    assert panel.first.number == 1
    assert panel.opened(secret="my own").secret != "my own"


def test_the_operators_page_is_gone_when_it_confirms_nothing_for_a_while_and_a_new_page_takes_over(panel):
    assert LIMITS.gone > LEASE_TIME + 0.1  # s between two looks of the bridge: the arm has been let down by then
    panel.now += LIMITS.gone
    assert not panel.is_gone()
    panel.now += 0.01
    panel.confirm(panel.second)
    assert panel.is_gone()
    panel.confirm(panel.first)
    assert not panel.is_gone()
    panel.now += LIMITS.gone + 0.1
    assert panel.opened() is panel.holder


def test_the_number_of_pages_is_limited_to_those_that_are_open(panel):
    pages = [panel.first, panel.second, *(panel.opened() for _ in range(LIMITS.pages - 2))]
    assert panel.open("", "10.0.0.1") is None
    pages[5].connection = None
    panel.opened()
    assert panel.open(pages[5].secret, "10.0.0.1") is None
    pages[6].connection = None
    assert panel.opened(secret=pages[6].secret) is pages[6]


def test_confirmations_of_the_operators_page_and_enabling_renew_its_lease_and_nothing_else(panel):
    panel.confirm(panel.second)
    panel.ask(panel.first, "let_down")
    panel.open(panel.second.secret, "10.0.0.2")
    panel.ask(panel.second, "enable", "right")
    assert panel.arms.leases == []
    panel.confirm(panel.first)
    panel.open(panel.first.secret, "10.0.0.1")  # reloaded
    panel.ask(panel.first, "enable", "right")
    assert panel.arms.leases == [OWN_LEASE] * 3


def test_an_arm_that_another_operator_holds_is_only_let_down(panel):
    panel.arms.others["left"] = "anna"
    assert panel.other_operator == "anna"
    for kind, more in (("enable", {}), ("clear_fault", {}), ("set", {"values": {"support": 0.1}})):
        assert panel.status(panel.first, kind, "left", **more) == 403
        assert "anna" in panel.notes[-1]
    assert panel.arms.calls == []
    assert panel.status(panel.first, "enable", "right") == panel.status(panel.first, "let_down", "left") == 200
