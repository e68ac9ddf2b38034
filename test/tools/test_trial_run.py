"""trial's scripts, criteria, nodes and screen: what is a hold, what a person reads, why a trial ends early."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import math
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.trial import run as running
from exo_gravity.lab.trial.run import TrialEnd, follow, is_guided, too_busy
from exo_gravity.lab.trial.screen import LEAD, TrialScreen, describe
from exo_gravity.lab.trial.scripted import analysed, read_script
from exo_gravity.sim.script import Step, TrialScript
from exo_gravity.tools import trial

from ..support import synthetic_bags as made

CONFIG = Path(__file__).parents[2] / "config"
RATED = (3.0, 9.0, 3.0, 3.0)  # Nm


@pytest.mark.parametrize("name", ["bow_and_walk", "demo", "two_poses", "thirteen_poses"])
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


def test_the_second_trial_has_thirteen_different_poses_of_a_minute_each():
    _, script = read_script("thirteen_poses")
    poses = {step.value for step in script.steps if step.action == "move"}
    assert len(poses) == 13
    assert [step.duration for step in script.steps if step.action == "hold"] == [60.0] * 13


def test_the_push_of_the_first_trial_lasts_from_17_to_20_s():
    _, script = read_script("two_poses")
    actions = [script.steps[script.at(time)[0]].action for time in (16.9, 17.1, 19.9, 20.1)]
    assert actions == ["hold", "push", "push", "hold"]


def test_an_unknown_name_is_answered_with_the_packaged_trials():
    with pytest.raises(ParameterError) as caught:
        read_script("nosuch")
    assert str(caught.value) == (
        "trial = 'nosuch': must be bow_and_walk, demo, thirteen_poses, two_poses or a YAML file with a script"
    )


def bag_with(holds: int) -> Bag:
    """Return a recording without a script, of one arm with that many holds of 4 s."""
    recording = made.trial([[0.1 * n] * 4 for n in range(holds)], hold=4.0, rate=100.0)
    unscripted = dataclasses.replace(recording, steps=(), carried=((0.0, recording.time[-1]),))
    return Bag(Path("bag"), 0, (unscripted,), (), {}, (), ())


def holding(*durations: float) -> TrialScript:
    return TrialScript.parse({"name": "holds", "steps": [{"hold": duration} for duration in durations]})


def test_only_holds_of_a_minute_are_judged_by_their_rate():
    rates = [
        analysed(bag_with(1), read_script(name)[1], False, "")[0].criteria.max_rate
        for name in ("demo", "thirteen_poses")
    ]
    assert rates == [math.inf, pytest.approx(math.radians(0.2) / 60)]


def test_a_hold_in_which_a_real_arm_never_came_to_rest_is_missing():
    script = holding(4.0, 4.0)
    assert analysed(bag_with(2), script, True, "")[1] == ""
    assert analysed(bag_with(1), script, True, "")[1] == "right: 1 of 2 holds were found"
    assert analysed(bag_with(1), script, True, "an arm is not active any more")[1] == "an arm is not active any more"


def test_a_moment_in_which_a_person_holds_the_arm_still_is_not_a_hold():
    script = holding(60.0, 14.0)  # of which at least 7 s remain
    report, trouble = analysed(bag_with(2), script, True, "")
    assert not report.arms[0][1].holds and trouble == "right: 0 of 2 holds were found"
    report, trouble = analysed(bag_with(2), script, False, "")
    assert len(report.arms[0][1].holds) == 2 and trouble == ""


def test_a_trial_is_guided_unless_a_simulator_performs_it():
    assert is_guided(CONFIG / "exo.yaml") and not is_guided(CONFIG / "sim_both.yaml")


SCRIPT = TrialScript.parse(
    {"name": "short", "steps": [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 4.0}]},
)
ACTIVE = {"level": 0, "message": "active", "state": "active", "fault": "none"}


class Screen:
    """The screen of a trial, whose clock and recorder's lines the test sets."""

    def __init__(
        self, guided: bool = True, bridges: Sequence[str] = ("right/can_bridge",), lead: float | None = LEAD
    ) -> None:
        self.now, self.out = 0.0, io.StringIO()
        self.console = Console(file=self.out, width=120)
        self.steps: list[tuple[int, float]] = []
        self.screen = TrialScreen(
            SCRIPT, guided, self.console, bridges, lead, lambda *step: self.steps.append(step), lambda: self.now
        )

    def at(self, now: float, position: Sequence[float] = (0.0,) * 4, bridge: Any = ACTIVE, **arm: Any) -> str:
        """Process a line of the recorder at `now`, in which the bridge has the status `bridge`; return the screen."""
        self.now = now
        status = {"right/can_bridge": bridge}
        faults = [f"{name}: {values['message']}" for name, values in status.items() if values["level"]]
        arm = {"position": list(position), "effort": [0.0] * 4, **arm}
        self.screen.take(json.dumps({"right": arm, "status": status, "faults": faults}))
        with self.console.capture() as capture:
            self.console.print(self.screen.screen())
        return capture.get()

    @property
    def printed(self) -> list[str]:
        """The lines that stay on the screen."""
        return self.out.getvalue().splitlines()


def checking(what: str) -> dict[str, Any]:
    return {"level": 1, "message": f"checking: waiting for {what}", "state": "checking", "fault": "none"}


def test_a_person_waits_until_the_arm_is_active():
    screen = Screen()
    text = screen.at(10.0, bridge=checking("effort commands"))
    assert "waiting for the arm to be carried" in text and "checking" in text
    ramping = {"level": 0, "message": "ramping in", "state": "ramping in", "fault": "none"}
    assert "waiting for the arm to be carried" in screen.at(11.0, bridge=ramping)
    assert "take hold of the arm: in 5 s, bring the arm to 6 34 69 29 deg, then let go" in screen.at(12.0)
    assert screen.printed == []


def test_a_limit_that_acts_does_not_keep_a_person_waiting():
    limited = {**ACTIVE, "level": 1, "message": "active, limited by max_effort (right_elbow_flexion)"}
    assert "take hold of the arm" in Screen().at(10.0, bridge=limited)


def test_a_person_with_two_arms_waits_for_both():
    screen = Screen(bridges=("left/can_bridge", "right/can_bridge"))
    assert "waiting for the arm to be carried" in screen.at(10.0)


def test_the_clock_leads_a_person_through_the_steps():
    screen = Screen()
    screen.at(0.0)
    screen.at(LEAD + 0.1)
    assert "then: hands off for 4 s" in screen.at(LEAD + 1.0)
    screen.at(LEAD + 2.1)
    screen.at(LEAD + 3.0)
    assert "drift 1.00 deg" in screen.at(LEAD + 4.0, position=(0.0, 0.0, math.radians(1.0), 0.0))
    assert not screen.screen.done
    screen.at(LEAD + 6.1)
    assert screen.screen.done
    assert [line[5:] for line in screen.printed] == [
        "bring the arm to 6 34 69 29 deg, then let go",
        "hands off for 4 s",
        "drifted 0.00 deg",
    ]


def test_at_a_simulated_arm_the_virtual_wearer_leads():
    screen = Screen(guided=False, lead=None)
    screen.at(100.0)
    assert screen.printed == []
    screen.at(101.0, step={"step": 0})
    assert screen.printed == ["1/2  the wearer brings the arm to 6 34 69 29 deg"]
    screen.at(102.0, step={"step": 2})
    assert screen.screen.done


def test_on_nodes_that_run_already_the_clock_leads_at_once_whatever_an_earlier_trial_left():
    screen = Screen(guided=False, bridges=(), lead=0.0)
    screen.at(100.0, step={"step": 2})
    screen.at(100.1, step={"step": 2})
    screen.at(101.0, step={"step": 0})
    assert screen.steps == [(-1, 0.0), (0, 2.0), (0, pytest.approx(1.1))]
    assert screen.printed == ["1/2  the wearer brings the arm to 6 34 69 29 deg"]


def test_half_a_line_of_a_killed_recorder_is_ignored():
    screen = Screen()
    screen.at(1.0)
    screen.screen.take('{"right": {"posi')
    assert screen.screen.silence == 0.0
    screen.now = 4.0
    assert screen.screen.silence == 3.0


@pytest.fixture
def nodes() -> Future[None]:
    """Nodes that run."""
    return Future()


def test_a_recorder_that_ends_ends_the_trial(nodes):
    screen = Screen()
    screen.at(0.0)
    why = follow(screen.screen, threading.Event(), lambda: -9, nodes)
    assert why == "the recorder ended with exit code -9 before the trial was done"


def test_a_recorder_that_prints_nothing_ends_the_trial(nodes):
    screen = Screen()
    screen.at(0.0)
    screen.now = 10.1
    why = follow(screen.screen, threading.Event(), lambda: None, nodes)
    assert why == "the recorder has sent no data for 10 s"


@pytest.mark.parametrize("state", ["letting down", "fault"])
def test_a_latched_fault_ends_the_trial_with_its_reason(nodes, state):
    screen, message = Screen(), f"{state}: motor_silent: elbow"
    screen.at(0.0, bridge={"level": 2, "message": message, "state": state, "fault": "motor_silent"})
    why = follow(screen.screen, threading.Event(), lambda: None, nodes)
    assert why == f"right/can_bridge: {message}"


def test_an_arm_that_is_let_down_ends_a_trial_that_the_clock_leads(nodes):
    screen = Screen()
    screen.at(0.0)
    screen.at(1.0, bridge={"level": 0, "message": "letting down", "state": "letting down", "fault": "none"})
    why = follow(screen.screen, threading.Event(), lambda: None, nodes)
    assert why == "an arm is not active any more"


def test_the_steps_of_the_trunk_are_instructions_too() -> None:
    assert describe(Step("bow", 3.0, (0.52,)), True) == "bow to 30 deg forward in 3 s, and leave the arm alone"
    assert describe(Step("lean", 2.0, (-0.26,)), True) == "lean to -15 deg to the right in 2 s, and leave the arm alone"
    assert describe(Step("walk", 60.0), True) == "walk for 60 s, and leave the arm alone"
    assert describe(Step("sit", 2.0), False) == "the wearer: sit down hard, and leave the arm alone"


SILENT = {"level": 2, "message": "letting down: motor_silent", "state": "letting down", "fault": "motor_silent"}
STALE = {**SILENT, "message": "letting down: command_stale", "fault": "command_stale"}
HOT = {**SILENT, "message": "letting down: over_temperature", "fault": "over_temperature"}


def simulator(stall: float = 12.0, silence: float = 14.0, disconnected: str = "no") -> dict[str, Any]:
    return {
        "level": 0,
        "message": "running",
        "longest stall (ms)": f"{stall:.0f}",
        "longest silence (ms)": f"{silence:.0f}",
        "disconnected": disconnected,
    }


CASES = {
    "a stalled device": (SILENT, simulator(140, 150), "right/simulator was not run for 140 ms"),
    "a stalled bridge": (SILENT, simulator(12, 130), "right/can_bridge was not run for 130 ms"),
    "late replies without a long gap": (SILENT, simulator(), "the replies of the simulated motors came too late"),
    "late efforts": (STALE, simulator(), "the efforts came too late"),
    "a simulated fault": (SILENT, simulator(60, 70, "yes"), ""),
    "a hot motor": (HOT, simulator(140, 150), ""),
}


@pytest.mark.parametrize(("bridge", "device", "reason"), CASES.values(), ids=CASES)
def test_only_a_gap_and_late_replies_or_efforts_mean_a_busy_computer(bridge, device, reason):
    assert too_busy({"right/can_bridge": bridge, "right/simulator": device}) == reason


def test_a_real_arm_is_never_excused_by_a_busy_computer():
    assert too_busy({"right/can_bridge": STALE}) == too_busy({"right/can_bridge": SILENT}) == ""


class Attempts:
    """Stands for the nodes: each attempt ends in the next of the given ways, and records nothing."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *ends: TrialEnd) -> None:
        self.ends = list(ends)
        monkeypatch.setattr(running, "run_nodes", lambda *arguments: self.ends.pop(0))
        monkeypatch.setattr("exo_gravity.lab.bag.reader.read_bag", self._no_recording)
        monkeypatch.setattr(trial, "stop_on_signals", threading.Event)

    @staticmethod
    def _no_recording(path: Path) -> None:
        raise DataError(f"{path}: nothing was recorded")


BUSY = TrialEnd("right/can_bridge: letting down: motor_silent", 1, "right/simulator was not run for 140 ms")
FAULT = TrialEnd("right/can_bridge: letting down: over_temperature", 1, "")
LAST_LINE = (
    "trial: this computer was too busy: right/simulator was not run for 140 ms. "
    "Close other programs and try again. The arm has no fault."
)


def run(tmp_path: Path) -> int:
    return trial.main(["demo", "--output", str(tmp_path)])


def test_a_busy_computer_ends_a_trial_with_exit_code_3_and_advice_in_the_last_line(tmp_path, monkeypatch, capsys):
    attempts = Attempts(monkeypatch, BUSY, BUSY, BUSY)
    assert run(tmp_path) == 3
    assert attempts.ends == []
    assert capsys.readouterr().out.splitlines()[-1] == LAST_LINE


def test_a_trial_that_failed_on_a_busy_computer_is_repeated(tmp_path, monkeypatch, capsys):
    attempts = Attempts(monkeypatch, BUSY, FAULT)
    assert run(tmp_path) == 1
    assert attempts.ends == []
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "this computer was too busy: right/simulator was not run for 140 ms; attempt 2 of 3"
    assert lines[-1] == "trial: right/can_bridge: letting down: over_temperature"


def test_a_fault_of_the_arm_is_not_repeated(tmp_path, monkeypatch):
    attempts = Attempts(monkeypatch, FAULT, BUSY)
    assert run(tmp_path) == 1
    assert attempts.ends == [BUSY]
