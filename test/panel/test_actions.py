"""Each request of a page is checked before anything is done."""

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.panel.actions import Action, parse

ARMS, TRIALS = ("right", "left"), ("demo",)


@pytest.mark.parametrize(
    ("body", "action"),
    [
        ({"do": "let_down"}, Action("let_down")),
        ({"do": "let_down", "arm": "left"}, Action("let_down", "left")),
        ({"do": "enable", "arm": "right"}, Action("enable", "right")),
        ({"do": "set", "arm": "right", "values": {"support": 1}}, Action("set", "right", {"support": 1.0})),
        ({"do": "trial", "name": "demo"}, Action("trial", name="demo")),
        ({"do": "take"}, Action("take")),
    ],
)
def test_a_right_request_is_understood(body, action):
    assert parse(body, ARMS, TRIALS) == action


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
        parse(body, ARMS, TRIALS)


def test_the_log_shows_the_support_but_not_the_wearers_data():
    values = {"support": 0.3, "wearer.body_mass": 81.5, "wearer.sex": "female"}
    text = str(Action("set", "right", values))
    assert text == "set right support = 0.3, wearer.body_mass, wearer.sex"
