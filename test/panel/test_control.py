# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The panel without web and ROS: who may do what, what is recorded, what is named after a fault, limits and texts.

Requests are checked, one page holds control, and letting down always works. The texts are complete in every language.
"""

import asyncio
import json
import math
import re
import shutil
import sys
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock, call

import pytest
import yaml

import exo_gravity.panel
from exo_gravity.core import vocabulary
from exo_gravity.core.compensation.load_change import CAUSE_TIME
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.command import FaultCode, State
from exo_gravity.core.safety.lease import LEASE_TIME
from exo_gravity.lab import processes
from exo_gravity.lab import vocabulary as beside
from exo_gravity.lab.inputs import parameter_file
from exo_gravity.lab.inputs.arms import fitting
from exo_gravity.panel import recordings
from exo_gravity.panel.control import GONE, MOST_PAGES, NEWS_DELAY, PANEL, Control, LoadChanges, Page, parse, setup_of
from exo_gravity.panel.recordings import Recordings
from exo_gravity.sim.script import TIMED, VALUED

from ..support.panel_stage import WEARER_FILE, PlayedArms, PlayedFiles

DOWN = [("let_down", "right"), ("let_down", "left")]


class Panel(Control):
    """Two pages, of which the first holds control, and what the arms were asked for."""

    def __init__(self) -> None:
        self.now = 100.0
        self.arms, self.files, self.notes = PlayedArms(), PlayedFiles(), list[str]()
        super().__init__(self.arms, self.files, lambda text: self.notes.append(text), lambda: self.now)
        self.first, self.second = (self.opened(f"10.0.0.{n}") for n in (1, 2))
        self.arms.leases.clear()

    def opened(self, address: str = "10.0.0.3", secret: str = "") -> Page:
        page = self.open(secret, address)
        assert page is not None
        page.connection = "open"
        return page

    def ask(self, page: Page | str, kind: str, arm: str = "", **more: object) -> tuple[int, str]:
        body = {"do": kind, **({"arm": arm} if arm else {}), **more}
        return asyncio.run(self.perform(body, getattr(page, "secret", page), "10.0.0.9"))

    def status(self, *request: object, **more: object) -> int:
        return self.ask(*request, **more)[0]


@pytest.fixture
def panel() -> Panel:
    return Panel()


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


@pytest.mark.parametrize("body", WRONG)
def test_a_wrong_request_is_refused(body):
    with pytest.raises(ParameterError):
        parse(body, ("right", "left"), {"demo"})


def test_page_and_log_get_refusals_and_the_name_of_the_client_and_never_the_wearers_data(panel):
    values = {"support": 1, "wearer.body_mass": 81.5, "wearer.sex": "female"}
    assert panel.ask(panel.first, "set", "right", values=values) == (200, "")
    assert panel.notes == ["10.0.0.1 page 1: set right support = 1.0, wearer.body_mass, wearer.sex: done"]
    for values in ({"wearer.body_mass": 81.5, "law": "exact"}, {"wearer.body_mass": 815.0}):
        assert panel.status(panel.first, "set", "right", values=values) == 400
        assert "wearer.body_mass" in panel.notes[-1] and "81" not in panel.notes[-1]
    panel.arms.problem = "refused: the arm is active"
    assert panel.ask(panel.first, "enable", "right") == (409, "refused: the arm is active")
    assert panel.notes[-1].endswith("enable right: refused: the arm is active")


OPERATED = [(kind, {"arm": "right"}) for kind in ("enable", "activate", "clear_fault", "resume", "confirm_pose")]
FILED = [(kind, {}) for kind in ("record", "stop_recording", "save", "stop_trial")] + [("trial", {"name": "demo"})]


def test_every_page_lets_down_and_marks_and_only_the_one_in_control_does_anything_else(panel):
    for page in (panel.first, panel.second, "", "guessed"):
        assert panel.ask(page, "let_down") == panel.ask(page, "let_down", "left") == (200, "")
    assert panel.arms.calls == 4 * [*DOWN, ("let_down", "left")]
    panel.arms.calls.clear()
    for done, (kind, more) in enumerate(OPERATED + FILED):
        assert [panel.status(page, kind, **more) for page in (panel.second, "", "guessed")] == [403] * 3
        assert len(panel.arms.calls) + len(panel.files.calls) == done
        assert panel.status(panel.first, kind, **more) == 200
    assert panel.arms.calls == [(kind, "right") for kind, _ in OPERATED]
    assert panel.files.calls == [" ".join((kind, *more.values())) for kind, more in FILED]
    panel.now += 10.0
    assert panel.status(panel.second, "marker", text="a") == 200 and panel.files.calls[-1] == "marker a"


def test_nothing_keeps_an_arm_up_neither_the_other_arm_nor_the_log(panel, caplog):
    panel.arms.errors["right"] = RuntimeError("the client is gone")
    assert panel.ask(panel.first, "let_down") == (409, "right: RuntimeError: the client is gone")
    panel.arms.errors.clear()
    panel.notes = Mock(**{"append.side_effect": OSError("no space left")})
    assert panel.ask(panel.first, "let_down") == (200, "") and panel.arms.calls == 2 * DOWN
    assert "no space left" in caplog.text and "page 1: let down: done" in caplog.text
    panel.arms.names = ()
    assert panel.status(panel.first, "let_down") == 409  # without an arm it fails visibly


def test_control_is_taken_and_given_up_here_and_at_the_arms(panel):
    assert panel.status(panel.second, "take") == 200
    assert panel.status(panel.first, "enable", "left") == 403
    for page in (panel.first, panel.second):
        panel.confirm(page)
    panel.ask(panel.second, "release")
    panel.confirm(panel.second)
    assert panel.arms.leases == [("10.0.0.2 page 2", kind) for kind in ("take", "hold", "release")]
    assert panel.status(panel.second, "enable", "left") == panel.status("guessed", "take") == 403
    assert panel.holder is None


def test_the_operators_page_is_gone_when_it_confirms_nothing_for_a_while_may_only_let_down_and_a_new_page_takes_over(
    panel,
):
    assert GONE > LEASE_TIME + 0.1  # s between two looks of the bridge: the arm has been let down by then
    panel.now += GONE + 0.01
    panel.confirm(panel.second)
    assert panel.is_gone() and [panel.status(panel.first, kind, **more) for kind, more in OPERATED] == [403] * 5
    panel.confirm(panel.first)
    assert not panel.is_gone() and panel.arms.calls == [] and panel.status(panel.first, "enable", "right") == 200
    panel.now += GONE + 0.1
    assert panel.opened() is panel.holder


def test_a_reloaded_page_stays_the_same_and_only_pages_that_are_open_count(panel):
    panel.first.connection = None
    assert panel.opened(secret=panel.first.secret) is panel.first is panel.holder and panel.first.number == 1
    assert panel.opened(secret="my own").secret != "my own"
    pages = [panel.opened() for _ in range(MOST_PAGES - 3)]
    assert panel.open("", "10.0.0.1") is None
    pages[2].connection = None
    panel.opened()
    assert panel.open(pages[2].secret, "10.0.0.1") is None
    pages[3].connection = None
    assert panel.opened(secret=pages[3].secret) is pages[3]


def test_confirmations_of_the_operators_page_and_enabling_renew_its_lease_and_nothing_else(panel):
    panel.ask(panel.first, "let_down")
    assert panel.arms.leases == []
    panel.confirm(panel.first)
    panel.open(panel.first.secret, "10.0.0.1")  # reloaded
    panel.ask(panel.first, "enable", "right")
    assert panel.arms.leases == [("10.0.0.1 page 1", "hold")] * 3


def test_an_arm_that_another_operator_holds_is_only_let_down(panel):
    panel.arms.others["left"] = "anna"
    assert panel.other_operator == "anna"
    for kind, more in (("enable", {}), ("clear_fault", {}), ("set", {"values": {"support": 0.1}})):
        assert panel.status(panel.first, kind, "left", **more) == 403
        assert "anna" in panel.notes[-1]
    assert panel.arms.calls == []
    assert panel.status(panel.first, "enable", "right") == panel.status(panel.first, "let_down", "left") == 200


# Recordings, sessions and trials

# Stands for `trial --attach`: prints what it prints, and writes a report.
TRIAL = """
import json, pathlib, sys
given = [word for word in sys.argv if word.startswith("--subject=")][0].partition("=")[2]
output = sys.argv[sys.argv.index("--output") + 1]
folder = pathlib.Path(output, given, "2026-03-14" if given else "", "short_20260314_120000")
folder.mkdir(parents=True)
(folder / "report.html").touch()
for line in ({"folder": str(folder)}, {"step": 0, "left": 4.0}, LAST, {"problem": PROBLEM, "stopped": bool(PROBLEM)}):
    print(json.dumps(line), flush=True)
"""


COMPENSATOR = {"mode": "one_g", "robot.mass": [0.5] * 4, "anfis": [], **WEARER_FILE}


class Kept(Recordings):
    """Recordings below `folder / "out"` of an active arm, with the trial `short`; what a page is told and is noted."""

    def __init__(self, folder):
        (folder / "short.yaml").write_text(yaml.safe_dump({"name": "short", "steps": [{"hold": 4.0}]}))
        self.notes, self.out = [], folder / "out"
        self.device = Mock(
            **{"parameters.return_value": {"/right/compensator": COMPENSATOR, "/right/simulator": {}}},
            **{
                "states.return_value": {"right": "active"},
                "mark.return_value": "",
                "perform": AsyncMock(return_value=""),
            },
        )
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
            assert sorted(await asyncio.gather(self.trial("short"), self.trial("short"))) == [
                "", "a trial is running already",
            ]  # fmt: skip
            assert "stop the trial" in await self.stop_recording()
            shown = [self.state()]
            while shown[-1]["trial"]["phase"] != "done":
                await asyncio.sleep(0)
                shown += [self.state()] if self.state() != shown[-1] else []
            return shown

        return asyncio.run(follow())


@pytest.fixture
def kept(tmp_path):
    return Kept(tmp_path)


@pytest.fixture
def run_instead(monkeypatch):
    """A function that lets a program run in place of the recorder and the trial."""

    def run_instead(code=TRIAL, problem="", last="{'phase': 'reporting'}"):
        code = code.replace("PROBLEM", repr(problem)).replace("LAST", last)
        for module in (recordings, processes):
            monkeypatch.setattr(module, "program", lambda *_: [sys.executable, "-S", "-c", code])

    return run_instead


def test_parameters_saved_twice_within_a_second_are_two_files_and_a_folder_that_cannot_be_made_is_named(kept):
    paths = [kept.ask("save") or kept.state()["saved"] for _ in range(3)]
    assert len(set(paths)) == 3
    for path in paths:
        saved = parameter_file.load(path)["/right/compensator"]
        assert saved["mode"] == "one_g" and saved["robot.mass"] == [0.5] * 4 and "anfis" not in saved
    shutil.rmtree(kept.out)
    kept.out.write_text("")
    for kind in ("save", "record"):
        assert kept.ask(kind).startswith(f"{kept.out}/")


def test_a_recorder_that_has_ended_by_itself_is_stopped_with_its_exit_code(kept, run_instead):
    run_instead("raise SystemExit(1)")

    async def stopped():
        assert await kept.record() == ""
        while kept.state()["recording"]["on"]:
            await asyncio.sleep(0.01)
        assert "exit code 1: see " in kept.state()["recording"]["problem"]  # the page says it by itself
        return await kept.stop_recording()

    assert "exit code 1" in asyncio.run(stopped()) and not kept.state()["recording"]["problem"]


@pytest.mark.parametrize(("last", "problem"), [("{'phase': 'reporting'}", ""), ("{'step': 0, 'left': 3.0}", "stopped")])
def test_a_trial_of_a_subject_is_followed_to_its_report_and_listed_also_after_a_restart(
    kept, run_instead, tmp_path, last, problem
):
    run_instead(last=last, problem=problem)
    assert kept.begin("P01") == ""
    first, *_, end = kept.followed()
    assert first["recording"]["on"] and (first["trial"]["phase"], first["trial"]["step"]) == ("running", -1)
    assert not first["trial"]["guided"] and kept.device.perform.mock_calls == [
        call(str(tmp_path / "short.yaml")),
        call(""),
    ]
    name = "P01/2026-03-14/short_20260314_120000"
    assert end["trial"] == {
        "phase": "done",
        "name": "short",
        "problem": problem,
        "stopped": bool(problem),
        "report": name,
    }
    assert not end["recording"]["on"]
    restarted = Kept(tmp_path)
    entry = {"subject": "P01", "trial": "short", "when": "2026-03-14 12:00:00", "report": name, "folder": ""}
    entry |= {"verdict": "", "protocol": "", "seconds": None}
    assert restarted.past() == {"subjects": ["P01"], "past": [entry]}
    assert restarted.state()["session"]["subject"] == ""
    assert restarted.file(name, "report.html") == kept.out / name / "report.html"
    told = {"verdict": "It held.", "protocol": "pilot", "seconds": 61.5}
    (kept.out / name / "report.json").write_text(json.dumps(told))
    (kept.out / name / "bag").mkdir()
    assert restarted.past()["past"] == [{**entry, **told, "folder": name}]
    (tmp_path / "report.html").touch()
    for wrong in ("..", str(tmp_path), "\0", "a" * 3000, "../etc"):  # no other file is served
        assert restarted.file(wrong, "report.html") is None


def test_a_trial_that_cannot_start_says_why(kept, run_instead):
    run_instead("import sys; print('trial: no rclpy', file=sys.stderr); raise SystemExit(2)")
    assert kept.followed()[-1]["trial"]["problem"] == "trial: no rclpy"
    kept.device.states.return_value = {"right": "disabled"}
    assert "every arm is active" in asyncio.run(kept.trial("short"))


def test_a_name_is_refused_as_a_code_and_does_not_reach_the_log_and_a_marker_without_a_text_is_called_marker(kept):
    problem = kept.begin("Anna Meier")
    assert problem.startswith("subject ") and problem in kept.notes[-1] and "Anna" not in kept.notes[-1]
    assert kept.state()["session"]["subject"] == ""
    assert kept.ask("marker", text="") == "" and kept.device.mark.mock_calls == [call("marker")]
    assert kept.ask("marker", text=["a"]).startswith("text ")
    assert kept.ask("marker", text="calm \ud83d").startswith("text must be")


@pytest.mark.parametrize("text", ["wearer.body_mass: 7000.0", "robot.mass: 1.0", "- 1", "{"])
def test_what_belongs_to_the_wearer_is_kept_in_a_file_and_read_again_with_the_subject_unless_it_is_wrong(kept, text):
    assert kept.ask("keep_wearer")
    kept.begin("P01")
    assert kept.state()["session"]["wearer"] == {} and kept.ask("keep_wearer") == ""
    kept.device.parameters.return_value = {"/right/compensator": {**COMPENSATOR, "wearer.body_mass": 0.0}}
    assert kept.ask("keep_wearer") == "no wearer has been entered"
    for subject, wearer in (("P02", {}), ("P01", WEARER_FILE), ("P02", {})):
        kept.begin(subject)
        assert kept.state()["session"]["wearer"] == wearer
    assert kept.past()["subjects"] == ["P01"]
    (kept.out / "P01" / "wearer.yaml").write_text(text)
    assert kept.begin("P01") and kept.state()["session"]["subject"] == "P02"


# After a fault


LOAD = {"mode": "zero_g", "support": 0.1, "wearer.body_mass": 75.0, "payload.mass": 0.0}
UNKNOWN = dict.fromkeys(LOAD)


class PanelLook:
    """The panel's look at one arm ten times a second."""

    def __init__(self, changing: str = "none") -> None:
        self.changes, self.now, self.load = LoadChanges(), 0.0, dict[str, Any](LOAD)
        self.fault, self.changing = "none", changing
        self.go(1.0)

    def go(self, seconds: float, load: dict[str, Any] | None = None) -> Any:
        """Return what is named as the cause of a fault, so many seconds after this load was set."""
        self.load |= load or {}
        known = {name: value for name, value in self.load.items() if value is not None}
        for _ in range(round(10 * seconds)):
            self.now += 0.1
            state = {"bridge": {"fault": self.fault}, "compensator": {"changing load": self.changing}}
            arms = self.changes.with_causes({"right": state}, {"right": ({}, known)}, self.now)
        return arms["right"]["cause"]

    def fail(self, seconds: float = 0.1) -> Any:
        self.fault = "over_speed"
        return self.go(seconds)


SUPPORT = {"what": "support", "from": 0.1, "to": 0.6}
RAISED = {"support": 0.6}
CAUSES: dict[str, tuple[list[tuple[float, dict[str, Any]]], str, dict[str, Any] | None]] = {
    # What is set, each with the seconds that follow; the joint whose load still changes; and what is named of a fault.
    "support": ([(2.0, RAISED)], "none", SUPPORT),
    "mode": ([(2.0, {"mode": "one_g", "support": 0.0})], "none", {"what": "mode", "from": "zero_g", "to": "one_g"}),
    "never the wearer's data": ([(2.0, {"wearer.body_mass": 90.0, "support": 0.0})], "none", {"what": "wearer"}),
    "payload": ([(2.0, {"payload.mass": 1.5})], "none", {"what": "payload", "from": 0.0, "to": 1.5}),
    "long before": ([(CAUSE_TIME + 1.0, RAISED)], "none", None),
    "long before, and still changing": ([(CAUSE_TIME + 1.0, RAISED)], "right_elbow_flexion", SUPPORT),
    "a slider on its way": ([(0.5, {"support": support}) for support in (0.2, 0.4, 0.6)], "none", SUPPORT),
    "support that does not act": ([(CAUSE_TIME + 1.0, {"mode": "one_g"}), (1.0, RAISED)], "none", None),
    "parameters that become known": ([(1.0, UNKNOWN), (1.0, LOAD)], "none", None),
}


@pytest.mark.parametrize(("steps", "changing", "cause"), CAUSES.values(), ids=CAUSES)
def test_a_change_of_load_shortly_before_a_fault_is_named(steps, changing, cause):
    look = PanelLook(changing)
    for seconds, load in steps:
        assert look.go(seconds, load) is None
    assert look.fail() == look.go(NEWS_DELAY) == cause
    assert look.go(60.0, {"support": 0.3}) == cause  # set while the arm is off
    look.fault, look.changing = "none", "none"
    assert look.go(10.0) is None and look.fail() is None


@pytest.mark.parametrize(("delay", "cause"), [(-0.5, SUPPORT), (0.5, None)])
def test_a_change_of_which_the_panel_learns_after_the_fault_is_the_cause_and_a_later_one_is_not(delay, cause):
    look = PanelLook()
    look.fail(NEWS_DELAY + delay)
    assert look.go(0.1, RAISED) == cause


def test_the_limit_of_a_joint_is_the_smaller_one_and_nodes_of_other_programs_leave_the_page_its_setup():
    for ours, its, shown in [
        ([3.0, 9.0, 3.0, 3.0], [0.0, 5.0, 0.0, 12.0], [3.0, 5.0, 3.0, 3.0]),
        ([3.0, 9.0, 3.0], [2.0] * 4, [2.0] * 3),  # of an arm with other joints
    ]:
        assert setup_of({"right": ({"max_effort": ours}, {"max_effort": its})})["arms"]["right"]["max_effort"] == shown
    bridge = fitting("/right/can_bridge", {"max_effort": "much", "can.channel": ["vcan0"], "rate": math.nan, "own": 1})
    compensator = fitting("/right/compensator", {"max_effort": 3.0, "support": 0.5, "payload.mass": math.inf})
    assert (bridge, compensator) == ({"own": 1}, {"support": 0.5})
    shown = setup_of({"right": (bridge, compensator)})["arms"]["right"]
    assert shown["max_effort"] is None and shown["settings"]["support"] == 0.5


# Texts

FOLDER = Path(exo_gravity.panel.__file__).parent
CONTENT = json.loads((FOLDER / "strings.json").read_text(encoding="utf-8"))
TEXTS = CONTENT["texts"]
(MARKERS,) = (param.default for param in PANEL if param.name == "markers")
WORDS = {  # of the nodes, that an operator must understand
    "fault": FaultCode, "do": FaultCode, "state": [state.value for state in State], "step": (*TIMED, *VALUED),
    "sentence": [state.value for state in State], "wait": vocabulary.Wait, "reason": vocabulary.Withdrawal,
    "trouble": (*beside.WeighingTrouble, *beside.WeighingRefused), "source": vocabulary.Source, "marker": MARKERS,
    "weighing": set(beside.WeighingPhase) - {beside.WeighingPhase.NONE},
}  # fmt: skip


def test_every_word_of_the_nodes_and_all_that_the_page_asks_for_has_its_text_in_every_language():
    for key, texts in TEXTS.items():
        assert len(texts) == len(CONTENT["languages"]) and all(text.strip() for text in texts), key
        assert len({tuple(sorted(set(re.findall(r"\{\d\}", text)))) for text in texts}) == 1, key
    assert {f"{kind}.{word}" for kind, words in WORDS.items() for word in words} <= TEXTS.keys()
    static = FOLDER / "static"
    asked = set(re.findall(r'data-text="([^"]+)"', (static / "index.html").read_text(encoding="utf-8")))
    for script in static.glob("*.js"):
        asked |= set(re.findall(r'\bt\("([^"]+)"', script.read_text(encoding="utf-8")))
    assert asked <= TEXTS.keys() and len(asked) > 50
