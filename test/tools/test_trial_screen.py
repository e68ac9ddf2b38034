# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""trial's screen: what a person reads, how the clock or the virtual wearer leads, and why a trial ends early."""

from __future__ import annotations

import io
import json
import math
import threading
from concurrent.futures import Future

import pytest
from rich.console import Console

from exo_gravity.lab.trial.run import follow
from exo_gravity.lab.trial.screen import BRIDGE_TIMEOUT, LEAD, TrialScreen, describe
from exo_gravity.sim.script import Step, TrialScript

SCRIPT = TrialScript.parse(
    {"name": "short", "steps": [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 4.0}]},
)


def status(state, level=0, fault="none", message=None, **more):
    return {"level": level, "message": message or state, "state": state, "fault": fault, **more}


ACTIVE = status("active")


class Screen(TrialScreen):
    """The screen of a trial, whose clock and recorder's lines the test sets."""

    def __init__(self, guided=True, bridges=("right/can_bridge",), lead=LEAD):
        self.now, self.out, self.steps = 0.0, io.StringIO(), []
        console = Console(file=self.out, width=120)
        super().__init__(SCRIPT, guided, console, bridges, lead, lambda *s: self.steps.append(s), lambda: self.now)

    def at(self, now, position=(0.0,) * 4, bridge=ACTIVE, name="right/can_bridge", **arm):
        """Process a line of the recorder at `now`, in which the bridge has the status `bridge`; return the screen."""
        self.now = now
        faults = [bridge["message"]] if bridge["level"] else []
        arm = {"position": list(position), "effort": [0.0] * 4, **arm}
        self.take(json.dumps({"right": arm, "status": {name: bridge}, "faults": faults}))
        with self.console.capture() as capture:
            self.console.print(self.screen())
        return capture.get()

    @property
    def printed(self):
        """The lines that stay on the screen, without the number of the step."""
        return [line[5:] for line in self.out.getvalue().splitlines()]

    def end_of_trial(self, exit_code=None, stopped=None):
        return follow(self, stopped or threading.Event(), lambda: exit_code, Future())


WAITING, TAKE_HOLD = "waiting for the arm", "take hold of the arm"


def test_a_person_waits_until_every_arm_is_active_whether_or_not_a_limit_acts():
    screen = Screen()
    text = screen.at(10.0, bridge=status("checking", 1, message="checking: waiting for effort commands"))
    assert WAITING in text and "effort commands" in text
    assert WAITING in screen.at(11.0, bridge=status("ramping in"))
    assert f"{TAKE_HOLD}: in 5 s, bring the arm to 6 34 69 29 deg" in screen.at(12.0)
    assert screen.printed == []
    assert TAKE_HOLD in Screen().at(10.0, bridge=status("active", 1, message="active, limited by max_effort"))
    assert WAITING in Screen(bridges=("left/can_bridge", "right/can_bridge")).at(10.0)


def test_the_clock_leads_a_person_through_the_steps():
    screen = Screen()
    for now in (0.0, LEAD + 0.1):
        screen.at(now)
    assert "then: hands off for 4 s" in screen.at(LEAD + 1.0)
    for now in (2.1, 3.0):
        screen.at(LEAD + now)
    assert "drift 1.00 deg" in screen.at(LEAD + 4.0, position=(0.0, 0.0, math.radians(1.0), 0.0))
    assert not screen.done
    screen.at(LEAD + 6.1)
    assert screen.done
    assert screen.printed == ["bring the arm to 6 34 69 29 deg, then let go", "hands off for 4 s", "drifted 0.00 deg"]


WEARERS_MOVE = "the wearer brings the arm to 6 34 69 29 deg"


def test_at_a_simulated_arm_the_virtual_wearer_leads_and_on_running_nodes_the_clock_whatever_was_before():
    screen = Screen(guided=False, lead=None)
    screen.at(100.0)
    assert screen.printed == []
    for now, step in ((101.0, 0), (102.0, 2)):
        screen.at(now, step={"step": step})
        assert screen.printed == [WEARERS_MOVE] and screen.done == (step == 2)
    screen = Screen(guided=False, bridges=(), lead=0.0)
    for now, step in ((100.0, 2), (100.1, 2), (101.0, 0)):
        screen.at(now, step={"step": step})
    assert screen.steps == [(-1, 0.0), (0, 2.0), (0, pytest.approx(1.1))]
    assert screen.printed == [WEARERS_MOVE]


MOTOR = "motor_silent: elbow"
NO_SENTENCE = "zqx vw: kfj, 17"  # in the place of each: what a program decides does not depend on it
ENDS = {  # the bridge's status, for how long the recorder is silent in s, its exit code, and why the trial ends
    "the recorder ended": (ACTIVE, 0.0, -9, "exit code -9"),
    "no data": (ACTIVE, 10.1, None, "no data for 10 s"),
    "letting down": (status("letting down", 2, "motor_silent"), 0.0, None, NO_SENTENCE),
    "fault": (status("fault", 2, "motor_silent"), 0.0, None, NO_SENTENCE),
    "let down": (status("letting down"), 0.0, None, "not active any more"),
}


@pytest.mark.parametrize(("bridge", "silence", "exit_code", "why"), ENDS.values(), ids=ENDS)
def test_a_trial_ends_by_keys_whatever_the_sentences_say(bridge, silence, exit_code, why):
    screen = Screen()
    screen.at(0.0, bridge={**ACTIVE, "message": NO_SENTENCE})
    screen.at(1.0, bridge={**bridge, "message": NO_SENTENCE})
    screen.now += silence
    screen.take('{"right": {"posi')  # half a line of a killed recorder
    assert screen.silence == silence and why in screen.end_of_trial(exit_code)


@pytest.mark.parametrize("guided", [False, True])
def test_a_start_that_has_ended_ends_a_trial_unless_a_person_may_start_it_again(guided):
    screen, stopped = Screen(guided=guided, lead=LEAD if guided else None), threading.Event()
    screen.at(0.0, bridge=status("disabled", 1, message=NO_SENTENCE, refusal="joint_limits"))
    threading.Timer(0.2, stopped.set).start()
    found = screen.end_of_trial(stopped=stopped)
    assert found == ("stopped by the operator" if guided else f"right/can_bridge: {NO_SENTENCE}")


@pytest.mark.parametrize(
    ("bridges", "reports", "is_missing"),
    [((), "right/compensator", True), ((), "right/can_bridge", False), (("right/can_bridge",), "compensator", False)],
    ids=["no bridge", "a bridge that is off", "a bridge of the trial, whose process is watched"],
)
def test_a_trial_on_running_nodes_ends_after_a_few_seconds_without_a_bridge(bridges, reports, is_missing):
    screen = Screen(bridges=bridges)
    for now in (100.0, 100.1 + BRIDGE_TIMEOUT):
        screen.at(now, bridge=ACTIVE if is_missing else status("disabled"), name=reports)
    assert screen.has_no_bridge is is_missing
    assert not is_missing or "no can_bridge has reported" in screen.end_of_trial()


STEPS = [
    (Step("bow", 3.0, (0.52,)), ("bow", "30 deg forward", "3 s")),
    (Step("lean", 2.0, (-0.26,)), ("lean", "-15 deg to the right", "2 s")),
    (Step("walk", 60.0), ("walk", "60 s")),
    (Step("sit", 2.0), ("sit",)),
    (Step("load", 1.0, (0.5,)), ("take", "0.5 kg")),
    (Step("load", 1.0, (0.0,)), ("let go",)),
]


@pytest.mark.parametrize(("step", "words"), STEPS)
def test_the_steps_of_the_trunk_and_of_a_load_are_instructions_too(step, words):
    for guided in (True, False):
        said = describe(step, guided)
        assert all(word in said for word in words) and said.startswith("the wearer: ") != guided
