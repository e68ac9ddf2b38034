# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Which change of load the panel names after a fault, and the torque limits that it shows."""

from __future__ import annotations

import math
from typing import Any

import pytest

from exo_gravity.core.compensation.guidance import CAUSE_TIME
from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.lab.inputs.arms import fitting
from exo_gravity.panel.view import NEWS_DELAY, LoadChanges, setup_of


class PanelLook:
    """The panel's look at one arm ten times a second; `cause` is what it names."""

    def __init__(self) -> None:
        self.changes, self.now, self.cause = LoadChanges(), 0.0, None
        self.load: dict[str, Any] = {"mode": "zero_g", "support": 0.1, "wearer.body_mass": 75.0, "payload.mass": 0.0}
        self.fault, self.changing = "none", "none"
        self.go(1.0)

    def go(self, seconds: float, **load: Any) -> Any:
        self.load = {**self.load, **load}
        for _ in range(round(10 * seconds)):
            self.now += 0.1
            state = {"bridge": {"fault": self.fault}, "compensator": {"changing load": self.changing}}
            arms = self.changes.with_causes({"right": state}, {"right": ({}, self.load)}, self.now)
            self.cause = arms["right"]["cause"]
        return self.cause

    def fail(self, seconds: float = 0.1) -> Any:
        self.fault = "over_speed"
        return self.go(seconds)


@pytest.mark.parametrize(
    ("load", "cause"),
    [
        ({"support": 0.6}, {"what": "support", "from": 0.1, "to": 0.6}),
        ({"mode": "one_g", "support": 0.0}, {"what": "mode", "from": "zero_g", "to": "one_g"}),
        ({"wearer.body_mass": 90.0, "support": 0.0}, {"what": "wearer"}),
        ({"mode": "zero_g", "payload.mass": 1.5}, {"what": "payload", "from": 0.0, "to": 1.5}),
    ],
)
def test_a_change_of_load_shortly_before_a_fault_is_named_and_never_the_wearers_data(load, cause):
    look = PanelLook()
    assert look.go(2.0, **load) is None
    assert look.fail() == cause
    assert look.go(NEWS_DELAY) == cause
    assert look.go(60.0, support=0.3) == cause  # set while the arm is off
    look.fault = "none"
    assert look.go(10.0) is None
    assert look.fail() is None


SUPPORT = {"what": "support", "from": 0.1, "to": 0.6}


@pytest.mark.parametrize(("changing", "cause"), [("none", None), ("right_elbow_flexion", SUPPORT)])
def test_a_change_long_before_is_not_the_cause_unless_the_load_still_changes(changing, cause):
    look = PanelLook()
    look.changing = changing
    look.go(CAUSE_TIME + 1.0, support=0.6)
    assert look.fail() == cause


def test_a_slider_on_its_way_is_one_change():
    look = PanelLook()
    for support in (0.2, 0.4, 0.6):
        look.go(0.5, support=support)
    assert look.fail() == SUPPORT


@pytest.mark.parametrize(("delay", "cause"), [(-0.5, SUPPORT), (0.5, None)])
def test_a_change_of_which_the_panel_learns_after_the_fault_is_the_cause_and_a_later_one_is_not(delay, cause):
    look = PanelLook()
    look.fail(NEWS_DELAY + delay)
    assert look.go(0.1, support=0.6) == cause


def test_support_that_does_not_act_and_parameters_that_are_not_known_are_no_change():
    look = PanelLook()
    look.go(CAUSE_TIME + 1.0, mode="one_g")
    look.go(1.0, support=0.6)
    assert look.fail() is None
    look = PanelLook()
    known, look.load = look.load, {}
    look.go(1.0)
    look.go(1.0, **known)
    assert look.fail() is None


def test_the_limit_of_a_joint_is_the_smaller_one_and_a_compensator_without_a_limit_of_its_own_has_none():
    bridge = values_of(
        CAN_BRIDGE, {"can.interface": "virtual", "can.channel": "test", "max_effort": [3.0, 9.0, 3.0, 3.0]}
    )
    compensator = values_of(COMPENSATOR, {}) | {"max_effort": [0.0, 5.0, 0.0, 12.0]}
    assert setup_of({"right": (bridge, compensator)})["arms"]["right"]["max_effort"] == [3.0, 5.0, 3.0, 3.0]


def test_nodes_of_other_programs_and_of_other_arms_that_have_an_arms_names_leave_the_page_its_setup():
    bridge = fitting("/right/can_bridge", {"max_effort": "much", "can.channel": ["vcan0"], "rate": math.nan, "own": 1})
    assert bridge == {"own": 1}
    compensator = fitting("/right/compensator", {"max_effort": 3.0, "support": 0.5, "payload.mass": math.inf})
    assert compensator == {"support": 0.5}
    shown = setup_of({"right": (bridge, compensator)})["arms"]["right"]
    assert shown["max_effort"] is None and shown["settings"]["support"] == 0.5
    others = {"right": ({"max_effort": [3.0, 9.0, 3.0]}, {"max_effort": [2.0] * 4})}
    assert setup_of(others)["arms"]["right"]["max_effort"] == [2.0] * 3
