# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""trial's scripts, criteria and screen: what is a hold, what a person reads, why a trial ends early or is repeated."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import math
import threading
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.errors import DataError
from exo_gravity.lab.trial import run as running
from exo_gravity.lab.trial.run import TrialEnd, follow, is_guided, too_busy
from exo_gravity.lab.trial.screen import BRIDGE_TIMEOUT, LEAD, TrialScreen, describe
from exo_gravity.lab.trial.scripted import analysed, read_script
from exo_gravity.sim.script import Step, TrialScript
from exo_gravity.tools import trial

from ..support import CONFIG
from ..support import synthetic_bags as made

RATED = (3.0, 9.0, 3.0, 3.0)  # Nm
PACKAGED = ("bow_and_walk", "demo", "thirteen_poses", "two_poses")


@pytest.mark.parametrize("name", PACKAGED)
def test_a_packaged_trial_stays_within_rated_torque_and_clear_of_the_joint_limits(name):
    _, script = read_script(name)
    values = yaml.safe_load((CONFIG / "exo.yaml").read_text())
    bridge, robot = (values[f"/right/{node}"]["ros__parameters"] for node in ("can_bridge", "compensator"))
    poses = np.array([step.value for step in script.steps if step.action == "move"])
    assert np.all(poses > np.array(bridge["position_min"]) + 0.15)
    assert np.all(poses < np.array(bridge["position_max"]) - 0.15)
    arm = ArmModel(robot["link_length"], robot["robot"]["cog"], robot["robot"]["mass"])
    for pitch, roll in itertools.product((-0.35, 0.0, 0.35), repeat=2):  # 20 degrees
        torque = gravity_torque(arm, poses, Tilt.of("right", pitch, roll).direction)
        assert np.all(np.abs(torque) < RATED)


def bag_with(holds):
    """Return a recording without a script, of one arm with that many holds of 4 s."""
    recording = made.trial([[0.1 * n] * 4 for n in range(holds)], hold=4.0, rate=100.0)
    return made.bag_of(dataclasses.replace(recording, steps=(), carried=((0.0, recording.time[-1]),)))


@pytest.mark.parametrize(
    ("found", "durations", "guided", "given", "trouble"),
    [
        (2, (4.0, 4.0), True, "", ""),
        (1, (4.0, 4.0), True, "", "right: 1 of 2 holds"),  # a real arm that never came to rest
        (1, (4.0, 4.0), True, "an arm is not active any more", "an arm is not active any more"),
        (2, (60.0, 14.0), True, "", "right: 0 of 2 holds"),  # a moment in which a person holds the arm still
        (2, (60.0, 14.0), False, "", ""),
    ],
)
def test_a_real_arm_must_have_held_for_half_of_each_hold_of_the_script(found, durations, guided, given, trouble):
    script = TrialScript.parse({"name": "holds", "steps": [{"hold": duration} for duration in durations]})
    report, why = analysed(bag_with(found), script, guided, given)
    assert why.startswith(trouble) and bool(why) == bool(trouble)
    assert len(report.arms[0][1].holds) == (0 if "0 of 2" in trouble else found)


def test_only_holds_of_a_minute_are_judged_by_their_rate_and_a_simulator_makes_a_guide_needless():
    rates = [
        analysed(bag_with(1), read_script(name)[1], False, "")[0].criteria.max_rate
        for name in ("demo", "thirteen_poses")
    ]
    assert rates == [math.inf, pytest.approx(math.radians(0.2) / 60)]
    assert is_guided(CONFIG / "exo.yaml") and not is_guided(CONFIG / "sim_both.yaml")


# The screen

SCRIPT = TrialScript.parse(
    {"name": "short", "steps": [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 4.0}]},
)


def status(state, level=0, fault="none", message=None):
    return {"level": level, "message": message or state, "state": state, "fault": fault}


ACTIVE = status("active")


class Screen(TrialScreen):
    """The screen of a trial, whose clock and recorder's lines the test sets."""

    def __init__(self, guided=True, bridges=("right/can_bridge",), lead=LEAD):
        self.now, self.out, self.steps = 0.0, io.StringIO(), []
        console = Console(file=self.out, width=120)
        super().__init__(SCRIPT, guided, console, bridges, lead, lambda *s: self.steps.append(s), lambda: self.now)

    def at(self, now, position=(0.0,) * 4, bridge=ACTIVE, **arm):
        """Process a line of the recorder at `now`, in which the bridge has the status `bridge`; return the screen."""
        self.now = now
        faults = [bridge["message"]] if bridge["level"] else []
        arm = {"position": list(position), "effort": [0.0] * 4, **arm}
        self.take(json.dumps({"right": arm, "status": {"right/can_bridge": bridge}, "faults": faults}))
        with self.console.capture() as capture:
            self.console.print(self.screen())
        return capture.get()

    @property
    def printed(self):
        """The lines that stay on the screen, without the number of the step."""
        return [line[5:] for line in self.out.getvalue().splitlines()]

    def end_of_trial(self, exit_code=None):
        return follow(self, threading.Event(), lambda: exit_code, Future())


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
    for now in (0.0, 0.1):
        screen.at(now if not now else LEAD + now)
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
    screen.at(101.0, step={"step": 0})
    assert screen.printed == [WEARERS_MOVE]
    screen.at(102.0, step={"step": 2})
    assert screen.done
    screen = Screen(guided=False, bridges=(), lead=0.0)
    for now, step in ((100.0, 2), (100.1, 2), (101.0, 0)):
        screen.at(now, step={"step": step})
    assert screen.steps == [(-1, 0.0), (0, 2.0), (0, pytest.approx(1.1))]
    assert screen.printed == [WEARERS_MOVE]


def test_half_a_line_of_a_killed_recorder_is_ignored():
    screen = Screen()
    screen.at(1.0)
    screen.take('{"right": {"posi')
    screen.now = 4.0
    assert screen.silence == 3.0


MOTOR = "motor_silent: elbow"
ENDS = {
    "the recorder ended": (ACTIVE, 0.0, -9, "exit code -9"),
    "no data": (ACTIVE, 10.1, None, "no data for 10 s"),
    "letting down": (status("letting down", 2, "motor_silent", MOTOR), 0.0, None, MOTOR),
    "fault": (status("fault", 2, "motor_silent", MOTOR), 0.0, None, MOTOR),
    "let down": (status("letting down"), 0.0, None, "not active any more"),
}


NO_SENTENCE = "zqx vw: kfj, 17"  # in the place of each: what a program decides does not depend on it


@pytest.mark.parametrize("name", ENDS)
def test_a_trial_ends_by_keys_whatever_the_sentences_say(name):
    bridge, silence, exit_code, why = ENDS[name]
    screen = Screen()
    screen.at(0.0, bridge={**ACTIVE, "message": NO_SENTENCE})
    screen.at(1.0, bridge={**bridge, "message": NO_SENTENCE})
    screen.now += silence
    assert (NO_SENTENCE if why == MOTOR else why) in screen.end_of_trial(exit_code)


@pytest.mark.parametrize("guided", [False, True])
def test_a_start_that_has_ended_ends_a_trial_unless_a_person_may_start_it_again(guided):
    screen = Screen(guided=guided, lead=LEAD if guided else None)
    refused = {**status("disabled", 1, message=NO_SENTENCE), "refusal": "joint_limits"}
    screen.at(0.0, bridge=refused)
    stopped = threading.Event()
    threading.Timer(0.2, stopped.set).start()
    found = follow(screen, stopped, lambda: None, Future())
    assert found == ("stopped by the operator" if guided else f"right/can_bridge: {NO_SENTENCE}")


def test_a_trial_on_running_nodes_ends_after_a_few_seconds_without_a_bridge():
    screen = Screen(bridges=())
    line = {"right": {"position": [0.0] * 4, "effort": [0.0] * 4}, "status": {"right/compensator": ACTIVE}}
    for screen.now in (100.0, 100.1 + BRIDGE_TIMEOUT):
        screen.take(json.dumps(line))
    assert "no can_bridge has reported" in screen.end_of_trial()
    screen = Screen(bridges=())
    for now in (100.0, 100.1 + BRIDGE_TIMEOUT):
        screen.at(now, bridge=status("disabled"))
    assert not screen.has_no_bridge
    screen = Screen()  # the trial has started its bridge: its process is watched
    screen.take(json.dumps(line))
    screen.now += 2.0 * BRIDGE_TIMEOUT
    assert not screen.has_no_bridge


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (Step("bow", 3.0, (0.52,)), ("bow", "30 deg forward", "3 s")),
        (Step("lean", 2.0, (-0.26,)), ("lean", "-15 deg to the right", "2 s")),
        (Step("walk", 60.0), ("walk", "60 s")),
        (Step("sit", 2.0), ("sit",)),
        (Step("load", 1.0, (0.5,)), ("take", "0.5 kg")),
        (Step("load", 1.0, (0.0,)), ("let go",)),
    ],
)
def test_the_steps_of_the_trunk_and_of_a_load_are_instructions_too(step, words):
    for guided in (True, False):
        said = describe(step, guided)
        assert all(word in said for word in words) and said.startswith("the wearer: ") != guided


# Trials on a computer that is too busy


def simulator(stall=12.0, silence=14.0, disconnected="no"):
    values = {"longest stall (ms)": f"{stall:.0f}", "longest silence (ms)": f"{silence:.0f}"}
    return {"level": 0, "message": "running", "disconnected": disconnected, **values}


SILENT, STALE, HOT = (
    status("letting down", 2, fault, f"letting down: {fault}")
    for fault in ("motor_silent", "command_stale", "over_temperature")
)
CASES = {
    "a stalled device": (SILENT, simulator(140, 150), "right/simulator was not run for 140 ms"),
    "a stalled bridge": (SILENT, simulator(12, 130), "right/can_bridge was not run for 130 ms"),
    "late replies without a long gap": (SILENT, simulator(), "replies"),
    "late efforts": (STALE, simulator(), "efforts"),
    "a simulated fault": (SILENT, simulator(60, 70, "yes"), ""),
    "a hot motor": (HOT, simulator(140, 150), ""),
    "a real arm's silent motor": (SILENT, None, ""),
    "a real arm's late efforts": (STALE, None, ""),
}


@pytest.mark.parametrize(("bridge", "device", "reason"), CASES.values(), ids=CASES)
def test_only_a_gap_and_late_replies_or_efforts_of_a_simulated_arm_mean_a_busy_computer(bridge, device, reason):
    found = too_busy({"right/can_bridge": bridge, **({"right/simulator": device} if device else {})})
    assert reason in found and bool(found) == bool(reason)
    unsaid = {"right/can_bridge": bridge, **({"right/simulator": device} if device else {})}
    assert too_busy({name: {**values, "message": NO_SENTENCE} for name, values in unsaid.items()}) == found


STALLED = "right/simulator was not run for 140 ms"
BUSY = TrialEnd("right/can_bridge: letting down: motor_silent", 1, STALLED)
FAULT = TrialEnd("right/can_bridge: letting down: over_temperature", 1, "")


@pytest.mark.parametrize(
    ("ends", "code", "attempts", "last_line"),
    [
        ((BUSY, BUSY, BUSY), 3, 3, STALLED),
        ((BUSY, FAULT), 1, 2, "over_temperature"),
        ((FAULT, BUSY), 1, 1, "over_temperature"),
    ],
)
def test_a_trial_on_a_busy_computer_is_repeated_and_one_with_a_fault_is_not(
    tmp_path, monkeypatch, capsys, ends, code, attempts, last_line
):
    left = list(ends)

    def no_recording(path: Path) -> None:
        raise DataError(f"{path}: nothing was recorded")

    monkeypatch.setattr(running, "run_nodes", lambda *_: left.pop(0))
    monkeypatch.setattr("exo_gravity.lab.bag.reader.read_bag", no_recording)
    monkeypatch.setattr(trial, "stop_on_signals", threading.Event)
    assert trial.main(["demo", "--output", str(tmp_path)]) == code
    assert len(ends) - len(left) == attempts
    lines = capsys.readouterr().out.splitlines()
    assert last_line in lines[-1] and (f"attempt {attempts} of 3" in "".join(lines)) == (attempts > 1)
