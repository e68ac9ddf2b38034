# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where recordings and saved parameters go, how a trial is followed, and what is kept of a subject."""

import asyncio
import json
import sys
from pathlib import Path

import pytest
import yaml

from exo_gravity.panel import recordings
from exo_gravity.panel.control import Control
from exo_gravity.panel.recordings import Recordings

from ..support.panel_stage import WEARER_FILE, PlayedArms

# Stands for `trial --attach`: prints what it prints, and writes a report.
TRIAL = """
import json, pathlib, sys
given = [word for word in sys.argv if word.startswith("--subject=")][0].partition("=")[2]
output = sys.argv[sys.argv.index("--output") + 1]
folder = pathlib.Path(output, given, "2026-03-14" if given else "", "short_20260314_120000")
folder.mkdir(parents=True)
(folder / "report.html").touch()
for line in ({"folder": str(folder)}, {"step": 0, "left": 4.0}, LAST, {"problem": PROBLEM}):
    print(json.dumps(line), flush=True)
"""
CANNOT_START = "import sys; print('trial: no rclpy', file=sys.stderr); raise SystemExit(2)"


class Device:
    """One compensator, and a bridge whose state is `state`."""

    def __init__(self):
        self.state, self.performed = "active", []

    def parameters(self):
        compensator = {"mode": "one_g", "robot.mass": [0.5] * 4, "anfis": [], **WEARER_FILE}
        return {"/right/compensator": compensator, "/right/simulator": {}}

    def states(self):
        return {"right": self.state}

    def mark(self, text):
        self.marked = text
        return ""

    async def perform(self, script):
        self.performed.append(script)
        return ""


class Panel(Recordings):
    """Recordings below `folder / "out"` of an active arm, with the trial `short`; what a page is told and is noted."""

    def __init__(self, folder):
        (folder / "short.yaml").write_text(yaml.safe_dump({"name": "short", "steps": [{"hold": 4.0}]}))
        self.device, self.notes, self.out = Device(), [], folder / "out"
        super().__init__(str(self.out), folder, self.device, print, lambda: 0.0)
        self._control = Control(PlayedArms(), self, self.notes.append, lambda: 0.0)
        self._page = self._control.open("", "10.0.0.1")

    def ask(self, kind, **body):
        return asyncio.run(self._control.perform({"do": kind, **body}, self._page.secret, self._page.address))[1]

    def begin(self, subject, note=""):
        return self.ask("session", subject=subject, protocol="", note=note)

    def followed(self):
        """Start the trial `short`; return what the page shows at each change until it is done."""

        async def follow():
            assert await self.trial("short") == ""
            assert "running already" in await self.trial("short")
            assert "stop the trial" in await self.stop_recording()
            shown = [self.state()]
            while shown[-1]["trial"]["phase"] != "done":
                await asyncio.sleep(0)
                shown += [self.state()] if self.state() != shown[-1] else []
            return shown

        return asyncio.run(follow())


@pytest.fixture
def panel(tmp_path):
    """A panel's recordings."""
    return Panel(tmp_path)


@pytest.fixture
def run_instead(monkeypatch):
    """A function that lets a program run in place of the recorder and the trial."""

    def run_instead(code=TRIAL, problem="", last="{'phase': 'reporting'}"):
        code = code.replace("PROBLEM", repr(problem)).replace("LAST", last)
        monkeypatch.setattr(recordings, "command", lambda module, *words: [sys.executable, "-S", "-c", code, *words])

    return run_instead


def test_parameters_saved_twice_within_a_second_are_two_files(panel):
    paths = set()
    for _ in range(3):
        assert panel.ask("save") == ""
        paths.add(panel.state()["saved"])
    assert len(paths) == 3
    for path in paths:
        saved = yaml.safe_load(Path(path).read_text())["/right/compensator"]["ros__parameters"]
        assert saved["mode"] == "one_g" and saved["robot"] == {"mass": [0.5] * 4} and "anfis" not in saved


def test_a_folder_that_cannot_be_made_is_named(panel):
    panel.out.write_text("")
    for kind in ("save", "record"):
        assert panel.ask(kind).startswith(f"{panel.out}/")


def test_a_recorder_that_has_ended_by_itself_is_stopped_with_its_exit_code(panel, run_instead):
    run_instead("raise SystemExit(1)")

    async def stopped():
        assert await panel.record() == ""
        while panel.state()["recording"]["on"]:
            await asyncio.sleep(0.01)
        return await panel.stop_recording()

    assert "exit code 1" in asyncio.run(stopped())


@pytest.mark.parametrize("problem", ["", "stopped by the operator"])
def test_a_trial_is_followed_to_its_report(panel, run_instead, tmp_path, problem):
    run_instead(problem=problem)
    first, *_, last = panel.followed()
    assert first["recording"]["on"] and (first["trial"]["phase"], first["trial"]["step"]) == ("running", -1)
    assert not first["trial"]["guided"] and panel.device.performed == [str(tmp_path / "short.yaml"), ""]
    name = "short_20260314_120000"
    assert last["trial"] == {"phase": "done", "name": "short", "problem": problem, "report": name}
    assert not last["recording"]["on"] and panel.report(name) == panel.out / name / "report.html"
    (tmp_path / "report.html").touch()
    assert panel.report("..") is panel.report(str(tmp_path)) is None  # no other file is served


def test_a_trial_that_cannot_start_says_why(panel, run_instead):
    run_instead(CANNOT_START)
    assert panel.followed()[-1]["trial"]["problem"] == "trial: no rclpy"
    panel.device.state = "disabled"
    assert "every arm is active" in asyncio.run(panel.trial("short"))


def test_the_virtual_wearer_ends_with_a_trial_that_an_arm_ended(panel, run_instead):
    run_instead(last="{'step': 0, 'left': 3.0}")
    panel.followed()
    assert panel.device.performed[-1] == ""


def test_a_trial_of_a_subject_is_in_the_list_with_its_report_after_a_restart(panel, run_instead, tmp_path):
    run_instead()
    assert panel.begin("P01") == ""
    panel.followed()
    restarted = Panel(tmp_path)
    name = "P01/2026-03-14/short_20260314_120000"
    entry = {"subject": "P01", "trial": "short", "when": "2026-03-14 12:00:00", "report": name}
    assert restarted.past() == {"subjects": ["P01"], "past": [entry]}
    assert restarted.report(name) == panel.out / name / "report.html"
    assert restarted.state()["session"]["subject"] == ""


def test_a_name_is_refused_as_a_code_and_does_not_reach_the_log(panel):
    problem = panel.begin("Anna Meier")
    assert problem.startswith("subject ") and problem in panel.notes[-1] and "Anna" not in panel.notes[-1]
    assert panel.begin("P01", note="x" * 1001).startswith("note ")
    assert panel.state()["session"]["subject"] == ""


def test_what_belongs_to_the_wearer_is_kept_in_a_file_and_read_again_with_the_subject(panel):
    assert panel.ask("keep_wearer")
    panel.begin("P01")
    assert panel.state()["session"]["wearer"] == {} and panel.ask("keep_wearer") == ""
    for subject, wearer in (("P02", {}), ("P01", WEARER_FILE)):
        panel.begin(subject)
        assert panel.state()["session"]["wearer"] == wearer
    assert panel.past()["subjects"] == ["P01"]


@pytest.mark.parametrize("text", ["wearer.body_mass: 7000.0", "robot.mass: 1.0", "- 1", "{"])
def test_a_wrong_wearers_file_is_refused(panel, text):
    (panel.out / "P01").mkdir(parents=True)
    (panel.out / "P01" / "wearer.yaml").write_text(text)
    assert panel.begin("P01") and panel.state()["session"]["subject"] == ""


def test_a_marker_without_a_text_is_called_marker(panel):
    assert panel.ask("marker", text="") == "" and panel.device.marked == "marker"
    assert panel.ask("marker", text=["a"]).startswith("text ")


def test_half_of_a_character_is_refused_and_reaches_no_page(panel):
    assert panel.ask("marker", text="calm \ud83d").startswith("text must be")
    assert panel.begin("P01", note="calm \ud83d").startswith("note must be")
    json.dumps(panel.state(), ensure_ascii=False).encode()


@pytest.mark.parametrize("name", ["\0", "a" * 3000, "../etc"])
def test_a_name_that_no_report_has_finds_none(panel, name):
    assert panel.report(name) is None
