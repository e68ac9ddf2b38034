"""Where recordings and saved parameters go, and how a trial is followed."""

import asyncio
import sys
from pathlib import Path

import pytest
import yaml

from exo_gravity.panel import recordings
from exo_gravity.panel.recordings import Recordings

SCRIPT = {"name": "short", "steps": [{"hold": 4.0}]}
# Stands for `trial --attach`: prints what it prints, and writes a report.
TRIAL = """
import json, pathlib, sys
folder = pathlib.Path(sys.argv[sys.argv.index("--output") + 1], "short_1")
folder.mkdir(parents=True)
(folder / "report.html").touch()
for line in ({"folder": str(folder)}, {"step": 0, "left": 4.0}, {"phase": "reporting"}, {"problem": PROBLEM}):
    print(json.dumps(line), flush=True)
"""


class Device:
    """One compensator, and a bridge whose state is `state`."""

    def __init__(self, state="active"):
        self.state, self.performed = state, []

    def parameters(self):
        return {"/right/compensator": {"mode": "one_g", "robot.mass": [0.5] * 4, "anfis": []}, "/right/simulator": {}}

    def states(self):
        return {"right": self.state}

    async def perform(self, script):
        self.performed.append(script)
        return ""


@pytest.fixture
def made(tmp_path):
    """Recordings below `tmp_path / "out"` of an active arm, with the trial `short`."""
    (tmp_path / "short.yaml").write_text(yaml.safe_dump(SCRIPT))
    device = Device()
    return device, Recordings(str(tmp_path / "out"), tmp_path, device, print, lambda: 0.0)


def test_parameters_saved_twice_within_a_second_are_two_files(made):
    paths = []
    for _ in range(3):
        assert asyncio.run(made[1].save()) == ""
        paths.append(made[1].state()["saved"])
    assert len(set(paths)) == 3
    expected = {"/right/compensator": {"ros__parameters": {"mode": "one_g", "robot": {"mass": [0.5] * 4}}}}
    assert [yaml.safe_load(Path(path).read_text()) for path in paths] == [expected] * 3


def test_a_folder_that_cannot_be_made_is_named(made, tmp_path):
    (tmp_path / "out").write_text("")
    assert asyncio.run(made[1].save()) == f"{tmp_path}/out: Not a directory"
    assert str(tmp_path / "out") in asyncio.run(made[1].record())


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
    assert not first["trial"]["guided"] and device.performed == [str(tmp_path / "short.yaml")]
    assert last["trial"] == {"phase": "done", "name": "short", "problem": problem, "report": "short_1"}
    assert not last["recording"]["on"] and files.report("short_1") == tmp_path / "out" / "short_1" / "report.html"


def test_a_trial_that_cannot_start_says_why(made, monkeypatch):
    code = "import sys; print('trial: no rclpy', file=sys.stderr); raise SystemExit(2)"
    monkeypatch.setattr(recordings, "command", lambda module, *args: [sys.executable, "-c", code])
    assert asyncio.run(followed(made[1]))[-1]["trial"]["problem"] == "trial: no rclpy"


def test_a_trial_needs_every_arm_active(made):
    made[0].state = "disabled"
    assert asyncio.run(made[1].trial("short")) == "a trial starts when every arm is active"
