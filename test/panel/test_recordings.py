"""Where recordings and saved parameters go, and how a trial is followed."""

import asyncio
import sys
from pathlib import Path

import pytest
import yaml

from exo_gravity.panel import recordings
from exo_gravity.panel.control import Control
from exo_gravity.panel.recordings import Recordings

from ..support.panel_stage import PlayedArms

SCRIPT = {"name": "short", "steps": [{"hold": 4.0}]}
# Stands for `trial --attach`: prints what it prints, and writes a report.
TRIAL = """
import json, pathlib, sys
given = [word for word in sys.argv if word.startswith("--subject=")][0].partition("=")[2]
output = sys.argv[sys.argv.index("--output") + 1]
folder = pathlib.Path(output, given, "2026-03-14" if given else "", "short_20260314_120000")
folder.mkdir(parents=True)
(folder / "report.html").touch()
for line in ({"folder": str(folder)}, {"step": 0, "left": 4.0}, {"phase": "reporting"}, {"problem": PROBLEM}):
    print(json.dumps(line), flush=True)
"""


WEARER = {
    "wearer.body_mass": 75.0,
    "wearer.sex": "female",
    "wearer.segment_length": [0.3, 0.25, 0.08],
    "limits.lower": [-0.5, -0.2, -0.2, 0.0],
    "limits.upper": [0.5, 1.5, 1.5, 2.0],
}


class Device:
    """One compensator, and a bridge whose state is `state`."""

    def __init__(self, state="active"):
        self.state, self.performed = state, []

    def parameters(self):
        compensator = {"mode": "one_g", "robot.mass": [0.5] * 4, "anfis": [], **WEARER}
        return {"/right/compensator": compensator, "/right/simulator": {}}

    def states(self):
        return {"right": self.state}

    def mark(self, text):
        self.marked = text
        return ""

    async def perform(self, script):
        self.performed.append(script)
        return ""


@pytest.fixture
def made(tmp_path):
    """Recordings below `tmp_path / "out"` of an active arm, with the trial `short`."""
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(SCRIPT))
    device = Device()
    return device, Recordings(str(tmp_path / "out"), tmp_path, device, print, lambda: 0.0)


def answer(files, **body):
    """Return what a page that asks for this is told, and what is noted."""
    notes = []
    control = Control(PlayedArms(), files, notes.append, lambda: 0.0)
    page = control.open("", "10.0.0.1")
    return asyncio.run(control.perform(body, page.secret, page.address))[1], "\n".join(notes)


def test_parameters_saved_twice_within_a_second_are_two_files(made):
    paths = []
    for _ in range(3):
        assert asyncio.run(made[1].save()) == ""
        paths.append(made[1].state()["saved"])
    assert len(set(paths)) == 3
    for path in paths:
        saved = yaml.safe_load(Path(path).read_text())["/right/compensator"]["ros__parameters"]
        assert saved["mode"] == "one_g" and saved["robot"] == {"mass": [0.5] * 4} and "anfis" not in saved


def test_a_folder_that_cannot_be_made_is_named(made, tmp_path):
    (tmp_path / "out").write_text("")
    for kind in ("save", "record"):
        problem, _ = answer(made[1], do=kind)
        assert problem.startswith(f"{tmp_path}/out/") and problem.endswith(": Not a directory")


def test_a_recorder_that_has_ended_by_itself_is_stopped_with_its_exit_code(made, monkeypatch):
    monkeypatch.setattr(recordings, "command", lambda *words: [sys.executable, "-c", "raise SystemExit(1)"])

    async def stopped():
        assert await made[1].record() == ""
        while made[1].state()["recording"]["on"]:
            await asyncio.sleep(0.01)
        return await made[1].stop_recording()

    assert "ended with exit code 1" in asyncio.run(stopped())


async def followed(files):
    """Start the trial `short`; return what the page shows at each change until it is done."""
    assert await files.trial("short") == ""
    assert await files.trial("short") == "a trial is running already"
    assert await files.stop_recording() == "a trial is running: stop the trial"
    shown = [files.state()]
    while shown[-1]["trial"]["phase"] != "done":
        await asyncio.sleep(0)
        shown += [files.state()] if files.state() != shown[-1] else []
    return shown


@pytest.mark.parametrize("problem", ["", "stopped by the operator"])
def test_a_trial_is_followed_to_its_report(made, monkeypatch, tmp_path, problem):
    device, files = made
    code = TRIAL.replace("PROBLEM", repr(problem))
    monkeypatch.setattr(recordings, "command", lambda module, *args: [sys.executable, "-c", code, *args])
    shown = asyncio.run(followed(files))
    first, last = shown[0], shown[-1]
    assert first["recording"]["on"] and (first["trial"]["phase"], first["trial"]["step"]) == ("running", -1)
    assert not first["trial"]["guided"] and device.performed == [str(tmp_path / "short.yaml"), ""]
    name = "short_20260314_120000"
    assert last["trial"] == {"phase": "done", "name": "short", "problem": problem, "report": name}
    assert not last["recording"]["on"] and files.report(name) == tmp_path / "out" / name / "report.html"


def test_a_trial_that_cannot_start_says_why(made, monkeypatch):
    code = "import sys; print('trial: no rclpy', file=sys.stderr); raise SystemExit(2)"
    monkeypatch.setattr(recordings, "command", lambda module, *args: [sys.executable, "-c", code])
    assert asyncio.run(followed(made[1]))[-1]["trial"]["problem"] == "trial: no rclpy"


def test_a_trial_needs_every_arm_active(made):
    made[0].state = "disabled"
    assert asyncio.run(made[1].trial("short")) == "a trial starts when every arm is active"


def test_the_virtual_wearer_ends_with_a_trial_that_an_arm_ended(made, monkeypatch):
    device, files = made
    code = TRIAL.replace("PROBLEM", "''").replace('{"phase": "reporting"}', '{"step": 0, "left": 3.0}')
    monkeypatch.setattr(recordings, "command", lambda module, *args: [sys.executable, "-c", code, *args])
    asyncio.run(followed(files))
    assert device.performed[-1] == ""


# Sessions


def begin(files, subject, note=""):
    return answer(files, do="session", subject=subject, protocol="", note=note)[0]


def test_a_trial_of_a_subject_is_in_the_list_with_its_report_after_a_restart(made, monkeypatch, tmp_path):
    device, files = made
    code = TRIAL.replace("PROBLEM", "''")
    monkeypatch.setattr(recordings, "command", lambda module, *args: [sys.executable, "-c", code, *args])
    assert begin(files, "P01") == ""
    asyncio.run(followed(files))
    restarted = Recordings(str(tmp_path / "out"), tmp_path, device, print, lambda: 0.0)
    name = "P01/2026-03-14/short_20260314_120000"
    entry = {"subject": "P01", "trial": "short", "when": "2026-03-14 12:00:00", "report": name}
    assert restarted.past() == {"subjects": ["P01"], "past": [entry]}
    assert restarted.report(name) == tmp_path / "out" / name / "report.html"
    assert restarted.state()["session"]["subject"] == ""


def test_no_other_file_is_served_as_a_report(made, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "report.html").touch()
    assert made[1].report("..") is None and made[1].report(str(tmp_path)) is None


def test_a_name_is_refused_as_a_code_and_does_not_reach_the_log(made):
    problem, log = answer(made[1], do="session", subject="Anna Meier", protocol="", note="")
    assert "must be a code" in problem and problem in log and "Anna" not in log
    assert made[1].state()["session"]["subject"] == ""
    assert "must be a text" in begin(made[1], "P01", note="x" * 1001)


def test_what_belongs_to_the_wearer_is_kept_in_a_file_and_read_again_with_the_subject(made):
    files = made[1]
    assert asyncio.run(files.keep_wearer()) == "no subject is chosen"
    begin(files, "P01")
    assert files.state()["session"]["wearer"] == {} and asyncio.run(files.keep_wearer()) == ""
    begin(files, "P02")
    assert files.state()["session"]["wearer"] == {}
    begin(files, "P01")
    assert files.state()["session"]["wearer"] == WEARER
    assert files.past()["subjects"] == ["P01"]


@pytest.mark.parametrize("text", ["wearer.body_mass: 7000.0", "robot.mass: 1.0", "- 1", "{"])
def test_a_wrong_wearers_file_is_refused(made, tmp_path, text):
    (tmp_path / "out" / "P01").mkdir(parents=True)
    (tmp_path / "out" / "P01" / "wearer.yaml").write_text(text)
    assert "must be" in begin(made[1], "P01") and made[1].state()["session"]["subject"] == ""


def test_a_marker_without_a_text_is_called_marker(made):
    assert asyncio.run(made[1].marker("")) == "" and made[0].marked == "marker"
    assert answer(made[1], do="marker", text=["a"])[0] == "text must be a text of at most 1000 characters"
