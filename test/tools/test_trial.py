# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""trial, from script to report: scripts and criteria, offline, over ROS, interrupted, repeated, and as a clip.

And its screen: what a person reads, how the clock or the virtual wearer leads, and why a trial ends early.
"""

import io
import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from subprocess import PIPE
from unittest.mock import Mock

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from rich.console import Console
from rosbags.rosbag2 import Reader

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.lab import processes
from exo_gravity.lab.report import video as clips
from exo_gravity.lab.trial import run as running
from exo_gravity.lab.trial.run import BRIDGE_TIMEOUT, LEAD, TrialScreen
from exo_gravity.lab.trial.scripted import analysed, read_script
from exo_gravity.sim.script import TrialScript
from exo_gravity.tools import trial

from ..support import CONFIG, csv_rows
from ..support import synthetic_bags as made
from ..support.launched_nodes import PORTS, LaunchedNodes
from ..support.waiting import PATIENCE

SHORT = {"name": "short", "steps": [{"move": [0.1, 0.6, 1.2, 0.5], "over": 2.0}, {"hold": 4.0}]}
RATED = (3.0, 9.0, 3.0, 3.0)  # Nm

# Scripts and criteria


@pytest.mark.parametrize("name", ["bow_and_walk", "demo", "thirteen_poses", "two_poses"])
def test_a_packaged_trial_stays_within_rated_torque_and_clear_of_the_joint_limits(name):
    _, script = read_script(name)
    values = yaml.safe_load((CONFIG / "exo.yaml").read_text())
    bridge, robot = (values[f"/right/{node}"]["ros__parameters"] for node in ("can_bridge", "compensator"))
    poses = np.array([step.value for step in script.steps if step.action == "move"])
    assert np.all(poses > np.array(bridge["position_min"]) + 0.15)
    assert np.all(poses < np.array(bridge["position_max"]) - 0.15)
    arm = ArmModel(robot["link_length"], robot["robot"]["cog"], robot["robot"]["mass"])
    for pitch, roll in itertools.product((-0.35, 0.0, 0.35), repeat=2):  # 20 degrees
        assert np.all(np.abs(gravity_torque(arm, poses, Tilt.of("right", pitch, roll).direction)) < RATED)


def bag_with(holds):
    recording = made.trial([[0.1 * n] * 4 for n in range(holds)], hold=4.0, rate=100.0)
    return made.bag_of(replace(recording, steps=(), carried=((0.0, recording.time[-1]),)))


HELD = [  # holds found, holds of the script in s, whether a person guides the arm, trouble before, and after
    (2, (4.0, 4.0), True, "", ""),
    (1, (4.0, 4.0), True, "", "right: 1 of 2 holds"),  # a real arm that never came to rest
    (1, (4.0, 4.0), True, "an arm is not active any more", "an arm is not active any more"),
    (2, (60.0, 14.0), True, "", "right: 0 of 2 holds"),  # a moment in which a person holds the arm still
    (2, (60.0, 14.0), False, "", ""),
]


@pytest.mark.parametrize(("found", "durations", "guided", "given", "trouble"), HELD)
def test_a_real_arm_must_have_held_for_half_of_each_hold_of_the_script(found, durations, guided, given, trouble):
    script = TrialScript.parse({"name": "holds", "steps": [{"hold": duration} for duration in durations]})
    report, why = analysed(bag_with(found), script, guided, given)
    assert why.startswith(trouble) and bool(why) == bool(trouble)
    assert len(report.arms[0][1].holds) == (0 if "0 of 2" in trouble else found)
    assert (why in report.notes) == (why != given)  # the page says it too


def test_only_holds_of_a_minute_are_judged_by_their_rate_and_a_simulator_makes_a_guide_needless():
    demo, poses = (analysed(bag_with(1), read_script(name)[1], False, "")[0] for name in ("demo", "thirteen_poses"))
    assert (demo.criteria.max_rate, poses.criteria.max_rate) == (math.inf, pytest.approx(math.radians(0.2) / 60))
    assert [running.check_bridges(CONFIG / name, True) for name in ("exo.yaml", "sim_both.yaml")] == [True, False]


# Offline


@pytest.fixture
def run(tmp_path, run_tool):
    """Run `trial` with `changes` of sim.yaml by node; return how it ended and the folder of its last attempt."""
    handlers = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]

    def run(*arguments, script=SHORT, simulator=None, **changes):
        path, output = tmp_path / "script.yaml", tmp_path / f"out_{next(PORTS)}"
        path.write_text(yaml.safe_dump(script))
        # Saves seconds. The wearer first moves after RAMPING_IN, in which a joint that moves gives up its torque.
        params = LaunchedNodes(tmp_path, simulator={"trial_delay": 3.0, **(simulator or {})}, **changes).path
        return run_tool("trial", path, "--params", params, "--output", output, *arguments), next(output.iterdir())

    yield run
    for number, handler in handlers:
        signal.signal(number, handler)


def column(folder, name):
    return [float(row[name]) for row in csv_rows(folder / "holds.csv")]


def test_an_offline_trial_of_a_subject_ends_with_a_report_of_its_recording_in_the_subjects_folder(run, run_tool):
    worn = {"wearer.body_mass": 75.0}  # of whose arm the motors carry nothing in One-G
    ended, above = run("--offline", "--subject", "P01", "--protocol", "pilot", "--note=- stiff", compensator=worn)
    (folder,) = above.glob("*-*-*/short_*")
    assert above.name == "P01" and {path.name for path in folder.iterdir()} == {
        *("params.yaml", "bag", "holds.csv", "motions.csv", "report.html", "report.json"),
        *("right_overview.png", "right_wearer.png"),  # it held: no drift to draw
    }
    assert ended.code == 0 and "It held." in ended.out
    np.testing.assert_allclose(column(folder, "pose_deg"), np.degrees(SHORT["steps"][0]["move"]), atol=2.0)
    with Reader(folder / "bag") as recorded:  # rosbags' own
        assert {"/right/joint_states", "/right/effort_commands", "/diagnostics"} <= set(recorded.topics)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert all(text in page for text in ("Simulated: programs made", "Protocol: pilot", "Note: - stiff"))
    assert float(re.search(r"the wearer carried (\d+) % of their arm", page)[1]) == pytest.approx(100.0, abs=5.0)
    rows = csv_rows(folder / "holds.csv")
    assert {(row["subject"], row["trial"], row["mode"]) for row in rows} == {("P01", folder.name, "one_g")}
    assert run_tool("report", folder / "bag", "--output", folder / "again").code == 0
    for table in ("holds.csv", "motions.csv"):
        assert csv_rows(folder / "again" / table) == csv_rows(folder / table)


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.thorough
def test_the_packaged_arm_drifts_less_than_a_fifth_of_a_degree_per_minute_in_all_thirteen_poses(run):
    content = yaml.safe_load((CONFIG / "trials" / "thirteen_poses.yaml").read_text())
    steps = [{"hold": 2.5} if "hold" in step else step for step in content["steps"]]
    ended, folder = run("--offline", script={"name": "thirteen", "steps": steps[: 2 * 13]})
    rates = np.abs(column(folder, "drift_deg_per_min"))
    assert ended.code == 0 and len(rates) == 4 * 13 and max(rates) < 0.2


@pytest.mark.usefixtures("without_pictures")
def test_ctrl_c_lets_the_arm_down_and_reports_what_was_recorded(run, monkeypatch):
    def stop_on_signals() -> threading.Event:
        stopped, asked = processes.stop_on_signals(), itertools.count()  # once a simulated second
        is_set, press = stopped.is_set, partial(os.kill, os.getpid(), signal.SIGINT)
        stopped.is_set = lambda: (next(asked) == 5 and press()) or is_set()
        return stopped

    monkeypatch.setattr(trial, "stop_on_signals", stop_on_signals)
    ended, folder = run(
        "--offline",
        script={"name": "long", "steps": [SHORT["steps"][0], {"hold": 3000.0}]},
        base="sim_both.yaml",  # the second arm is not even begun
    )
    assert ended.code == 1 and (folder / "report.html").exists()
    assert "stopped by the operator" in ended.out and "slipped" not in ended.out
    assert "left/can_bridge: stopped by the operator" in (folder / "report.html").read_text(encoding="utf-8")


BOW, HOLD = {"bow": math.radians(30.0), "over": 3.0}, {"hold": 1.0}
TRUNK = {  # the trunk's motion, whether its acceleration is compensated, and how far the arm moves in degrees
    "bow": ((BOW, HOLD), True, 0.0, 2.0),
    "walk": (({"walk": 4.0}, HOLD), True, 0.0, 1.0),
    "walk, tilt alone": (({"walk": 4.0},), False, 5.0, math.inf),
}


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.thorough
@pytest.mark.parametrize(("steps", "inertial", "least", "most"), TRUNK.values(), ids=TRUNK)
def test_an_arm_with_little_friction_stays_where_it_is_unless_a_walking_trunks_acceleration_is_left_out(
    run, steps, inertial, least, most
):
    script = {"name": "trunk", "steps": [{"move": [0.0, 0.4, 0.5, 1.0], "over": 2.0}, {"hold": 1.0}, *steps]}
    simulator = {"friction": {"coulomb": [0.03] * 4}, "trunk": {"pitch": 0.0, "roll": 0.0}, "imu.rate": 250.0}
    changes = {"simulator": simulator, "can_bridge": {"rate": 250.0}, "compensator": {"inertial": inertial}}
    _, folder = run("--offline", script=script, **changes)
    recording = made.only(folder / "bag")
    spans = [step for step in recording.steps if step.action in ("bow", "walk")]
    during = (recording.time >= spans[0].start) & (recording.time <= spans[-1].end)
    position = np.degrees(recording.position[during])
    assert least < np.abs(position - position[0]).max() < most and recording.steps[-1].action in steps[-1]


# On running nodes


def test_a_trial_goes_on_when_its_progress_is_no_longer_read():
    code = "import sys; from exo_gravity.tools.trial import _print_json as p; p(step=0); input(); p(step=1); p(step=2)"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True)
    assert process.stdout.readline() == '{"step": 0}\n'
    process.stdout.close()
    assert process.communicate("\n", timeout=PATIENCE)[1] == "" and process.returncode == 0


@pytest.mark.thorough
@pytest.mark.real_time
def test_over_ros_the_arm_holds_in_the_pose_that_it_has_offline(run):
    ended, folder = run()
    assert ended.code == 0, (folder / "log.txt").read_text()
    assert {"bag", "log.txt", "params.yaml", "report.html"} <= {path.name for path in folder.iterdir()}
    _, offline = run("--offline")
    np.testing.assert_allclose(column(folder, "pose_deg"), column(offline, "pose_deg"), atol=0.3)


# On a computer that is too busy


CASES = {  # longest stall and silence in ms of a simulator, whether it is disconnected, and what was not run for long
    "a stalled device": ("140", "150", "no", "right/simulator was not run for 140 ms"),
    "a stalled bridge": ("12", "130", "no", "right/can_bridge was not run for 130 ms"),
    "no gap": ("12", "14", "no", ""),
    "a simulated fault": ("60", "70", "yes", ""),
}


@pytest.mark.parametrize(("stall", "silence", "disconnected", "said"), CASES.values(), ids=CASES)
def test_a_trial_that_failed_says_which_process_of_the_simulation_stood_still(stall, silence, disconnected, said):
    bridge = {"level": 2, "message": "letting down", "state": "letting down", "fault": "motor_silent"}
    device = {"level": 0, "message": "running", "disconnected": disconnected}
    device |= {"longest stall (ms)": stall, "longest silence (ms)": silence}
    found = running.stall_of({"right/can_bridge": bridge, "right/simulator": device})
    assert said in found and bool(found) == bool(said)
    assert running.stall_of({"right/can_bridge": bridge}) == ""  # a real arm


# The screen

NO_SENTENCE = "zqx vw: kfj, 17"  # in the place of each: what a program decides does not depend on it


def status(state, level=0, fault="none", message=None, **more):
    return {"level": level, "message": message or state, "state": state, "fault": fault, **more}


ACTIVE = status("active")


class Screen(TrialScreen):
    def __init__(self, guided=True, bridges=("right/can_bridge",), lead=LEAD):
        self.now, self.out, self.steps = 0.0, io.StringIO(), []
        console = Console(file=self.out, width=120)
        super().__init__(
            TrialScript.parse(SHORT), guided, console, bridges, lead, lambda *s: self.steps.append(s), lambda: self.now
        )

    def at(self, now, position=(0.0,) * 4, bridge=ACTIVE, name="right/can_bridge", **arm):
        """Process a line of the recorder at `now`, in which the bridge has the status `bridge`; return the screen."""
        self.now = now
        faults = [bridge["message"]] if bridge["level"] else []
        arm = {"names": list("abcd"), "position": list(position), "effort": [0.0] * 4, **arm}
        self.take(json.dumps({"right": arm, "status": {name: bridge}, "faults": faults}))
        with self.console.capture() as capture:
            self.console.print(self.screen())
        return capture.get()

    @property
    def printed(self):
        return [line[5:] for line in self.out.getvalue().splitlines() if "joints in order: a, b, c, d" not in line]

    def end_of_trial(self, exit_code=None, moments=()):
        """Wait for the end, with a line at each of these moments; the operator stops the trial after the last one."""
        lines = (self.at(now) and None for now in moments)
        stopped = Mock(**{"wait.side_effect": itertools.chain((None,), lines, itertools.repeat(True))})
        return self.wait(stopped, lambda: exit_code, Future())


WAITING, TAKE_HOLD = "waiting for the arm", "take hold of the arm"


def test_a_person_waits_until_every_arm_is_active_whether_or_not_a_limit_acts():
    screen = Screen()
    text = screen.at(10.0, bridge=status("checking", 1, message="checking: waiting for effort commands"))
    assert WAITING in text and "effort commands" in text
    assert WAITING in screen.at(11.0, bridge=status("ramping in"))
    assert f"{TAKE_HOLD}: in 5 s, bring the arm to 6 34 69 29 deg" in screen.at(12.0)
    assert screen.out.getvalue() == "until the arm is carried: checking: waiting for effort commands\n"
    assert TAKE_HOLD in Screen().at(10.0, bridge=status("active", 1, message="active, limited by max_effort"))
    assert WAITING in Screen(bridges=("left/can_bridge", "right/can_bridge")).at(10.0)


def test_the_clock_leads_a_person_through_the_steps():
    screen = Screen()
    for now in (0.0, LEAD + 0.1):
        screen.at(now)
    assert "then: hands off for 4 s" in screen.at(LEAD + 1.0)
    assert "then: done" in screen.at(LEAD + 2.1) and not screen.done
    screen.at(LEAD + 3.0)
    screen.at(LEAD + 3.1, (0.9,), names=["finger"])  # of a gripper, on the same topic
    assert "drift 0.57 deg" in screen.at(LEAD + 5.9, (0.01, 0.0, 0.0, 0.0))
    screen.at(LEAD + 6.1, (0.01, 0.0, 0.0, 0.0))
    assert screen.done and Screen().end_of_trial(moments=(59.0, 66.5, 70.1)) == ""  # started as late as is allowed
    assert screen.printed == ["bring the arm to 6 34 69 29 deg, then let go", "hands off for 4 s", "drifted 0.57 deg"]


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
    screen = Screen(guided=guided, lead=LEAD if guided else None)
    screen.at(0.0, bridge=status("disabled", 1, message=NO_SENTENCE, refusal="joint_limits"))
    found = screen.end_of_trial()
    assert found == ("stopped by the operator" if guided else f"right/can_bridge: {NO_SENTENCE}")


NO_BRIDGE = {
    "no bridge": ((), "right/compensator", True),
    "a bridge that is off": ((), "right/can_bridge", False),
    "a bridge of the trial, whose process is watched": (("right/can_bridge",), "compensator", False),
}


@pytest.mark.parametrize(("bridges", "reports", "is_missing"), NO_BRIDGE.values(), ids=NO_BRIDGE)
def test_a_trial_on_running_nodes_ends_after_a_few_seconds_without_a_bridge(bridges, reports, is_missing):
    screen = Screen(bridges=bridges)
    for now in (100.0, 100.1 + BRIDGE_TIMEOUT):
        screen.at(now, bridge=ACTIVE if is_missing else status("disabled"), name=reports)
    assert ("no can_bridge has reported" in screen.end_of_trial()) is is_missing


# As a clip

CLIPS = {  # the file, the speed, the packages that are needed, and what is said
    "another format": ("clip.avi", 1.0, (), "a file that ends with .mp4 or .gif"),
    "no folder": ("missing/clip.gif", 1.0, (), "a file in a folder that exists"),
    "a speed that is none": ("clip.gif", float("nan"), (), "a number from 0.1 to 100"),
    "no encoder": ("clip.gif", 1.0, ("no_such_encoder",), r"no_such_encoder is not installed: .*sim"),
}


@pytest.mark.parametrize(("video", "speed", "needed", "said"), CLIPS.values(), ids=CLIPS)
def test_a_wrong_clip_is_refused_before_the_trial(tmp_path, monkeypatch, video, speed, needed, said):
    monkeypatch.setattr(clips, "NEEDED", needed)
    with pytest.raises(ParameterError, match=said):
        clips.requested(str(tmp_path / video), speed)


def colourful(frame):
    return int(np.count_nonzero(np.ptp(frame[..., :3].astype(int), axis=-1) > 60))  # torques, states and centres


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "speed"), [("gif", 20), ("mp4", 50)])  # a frame every 2 s
def test_a_clip_of_an_offline_trial_shows_the_arm_move_and_its_torques(run, tmp_path, kind, speed):
    clip, steps = tmp_path / f"clip.{kind}", [{"move": [0.0, 0.8, 0.6, 0.4], "over": 1.0}, {"hold": 2.0}]
    ended, _ = run("--offline", "--video", clip, "--video-speed", speed, script={"name": "short", "steps": steps})
    assert f"Clip: {clip}" in ended.out
    frames = iio.imread(clip, plugin="pillow" if kind == "gif" else "pyav")
    held = frames[len(frames) // 2]
    assert 4 <= len(frames) <= 12
    assert np.count_nonzero(np.any(held != frames[0], axis=-1)) > 0.01 * held.shape[0] * held.shape[1]
    assert colourful(held) > 1.5 * colourful(frames[0])
