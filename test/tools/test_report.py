# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The command `report`, from a bag to the terminal, files and an exit code: what it says of a recording, or of many."""

import base64
import io
import json
import math
import os
import re
import signal
from dataclasses import asdict, replace
from functools import partial
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pandas
import pyarrow.parquet
import pytest
import yaml
from rich.console import Console
from scipy import stats

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.tilt import gravity_in_trunk
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.safety.command import FaultCode
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Event, NodeStatus, Session
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import load
from exo_gravity.lab.observer import wearer_sentences
from exo_gravity.lab.parallel import on_cluster
from exo_gravity.lab.report import cohort, html, study
from exo_gravity.lab.report.trial_report import STAMPS, analyse, print_report, write
from exo_gravity.lab.trial.analysis import ARRAYS, HoldCriteria, Recording

from ..support import CONFIG, csv_rows
from ..support import synthetic_bags as made
from ..support.thorough import quick
from ..support.urdf_oracle import WornMujocoArm


@pytest.fixture(scope="module")
def held():
    return analyse(made.bag_of(made.trial(made.POSES, hold=4.0, push=made.PUSH)))


@pytest.fixture(scope="module")
def folder(held, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write(held, folder)
    return folder


@pytest.fixture(scope="module")
def short_bag(tmp_path_factory):
    """A bag of two holds with some drift in the elbow, 6 degrees per minute."""
    recording = made.trial(made.POSES, hold=4.0, rate=100.0, drift=AWAY)
    return made.write_bag(tmp_path_factory.mktemp("bags") / "short_1.2", made.messages(recording))


AWAY = np.array([0.0, 0.0, 0.0, math.radians(6.0) / 60.0])  # rad/s


def printed(report):
    console = Console(file=io.StringIO(), width=140)
    print_report(report, console)
    return " ".join(console.file.getvalue().split())


def page_in(folder):
    """Return the page in `folder`, which is well-formed: its source and its text."""
    source = (folder / "report.html").read_text(encoding="utf-8")
    root = ElementTree.fromstring(re.sub(r"<(meta|img|br)\b([^>]*)>", r"<\1\2/>", source))
    return SimpleNamespace(source=source, text="".join(root.itertext()), root=root)


@pytest.fixture
def page_of(tmp_path, without_pictures):
    """A function that writes a report without pictures, and returns its page."""

    def page_of(report):
        write(report, tmp_path)
        return page_in(tmp_path)

    return page_of


# Tables, figures and the page


def test_the_csv_files_have_the_numbers_of_the_analysis_in_degrees(held, folder):
    ((recording, trial),) = held.arms
    found = csv_rows(folder / "holds.csv")
    assert len(found) == 4 * len(trial.holds) == 12
    for row in found:
        hold, joint = trial.holds[int(row["hold"]) - 1], recording.joint_names.index(row["joint"])
        expected = (math.degrees(hold.pose[joint]), 60 * math.degrees(hold.drift_rate[joint]), hold.torque_error[joint])
        numbers = [float(row[name]) for name in ("pose_deg", "drift_deg_per_min", "torque_error_nm")]
        assert numbers == pytest.approx(expected, rel=1e-4)
    push = [row for row in csv_rows(folder / "motions.csv") if row["kind"] == "push"]
    np.testing.assert_allclose([float(row["peak_deg"]) for row in push], np.degrees(made.PUSH), atol=0.1)


def test_the_terminal_shows_every_hold_and_the_push_and_an_unknown_torque_error_as_a_dash(held, tmp_path, page_of):
    text = printed(held)
    assert all(re.search(rf" {hold} \d+\.\d+ \d+\.\d+ ", text) for hold in (1, 2, 3))
    assert re.search(r"push \S+ \S+ 2\.\d 14\.\d -8\.\d 5\.\d", text)
    (whole,) = held.bag.recordings
    report = analyse(made.bag_of(replace(whole, command=np.full_like(whole.command, math.nan))))
    page_of(report)
    assert {row["torque_error_nm"] for row in csv_rows(tmp_path / "holds.csv")} == {""}
    assert printed(report).count("–") > text.count("–")


def test_the_page_refers_to_nothing_outside_itself_and_its_pictures_are_the_png_files(held, folder):
    page = page_in(folder)
    assert "url(" not in page.source and f"<h1>{held.title}</h1>" in page.source
    given = [item for element in page.root.iter() for item in element.items()]
    references = [value for name, value in given if name in ("src", "href", "srcset", "data")]
    embedded = [base64.b64decode(ref.removeprefix("data:image/png;base64,")) for ref in references]
    assert embedded == [(folder / "right_overview.png").read_bytes()]  # the joints stayed: no drift to draw
    picture = matplotlib.image.imread(folder / "right_overview.png")
    assert picture.shape[1] >= 1600 and picture[..., :3].std() > 0.05


def test_text_from_a_recording_cannot_become_markup(held, page_of):
    texts = {"events": (Event(1.0, "<script>alert(1)</script>"),), "parameters": {"/a": "/a: <b>\n"}}
    source = page_of(analyse(made.bag_of(*held.bag.recordings, **texts, notes=("<i>",)))).source
    assert "<script>" not in source and "<b>\n" not in source and "&lt;script&gt;" in source
    assert "frame [01 02]" in printed(analyse(made.bag_of(*held.bag.recordings, notes=("frame [01 02]",))))


# The command


def test_the_report_is_written_next_to_its_recording_and_on_request_time_series_and_figures_with_text(
    short_bag, tmp_path, monkeypatch, run_tool
):
    assert run_tool("report", short_bag).code == 0
    assert {path.name for path in short_bag.with_name("short_1.2_report").iterdir()} == {
        *("holds.csv", "motions.csv", "report.html", "report.json", "right_drift.png", "right_overview.png")
    }
    folder = short_bag.with_name("short_1.2_report")
    assert run_tool("report", short_bag, "--min-hold", "99").code == 1 and "never still" in page_in(folder).text
    assert {path.name for path in folder.iterdir()} == {"report.html", "report.json", "right_overview.png"}  # no others
    nowhere = run_tool("report", short_bag, "--output", short_bag / "metadata.yaml" / "report")
    assert nowhere.code == 2 and "cannot write the report there" in nowhere.err
    assert [
        "time_series.csv" in run_tool("report", short_bag, "--output", tmp_path, *words).out
        for words in (("--csv",), ())
    ] == [True, False]
    rows, (recording,) = csv_rows(tmp_path / "time_series.csv"), read_bag(short_bag).recordings
    elbow = [row for row in rows if row["joint"] == recording.joint_names[3]]
    values = (recording.time, recording.position[:, 3], recording.velocity[:, 3], recording.effort[:, 3])
    for name, expected in zip(("time_s", "position_rad", "velocity_rad_per_s", "torque_nm"), values, strict=True):
        np.testing.assert_allclose([float(row[name]) for row in elbow], expected, atol=1e-6)
    assert len(rows) == 4 * len(elbow) and elbow[0]["command_nm"] == ""  # no command before the first joint state
    assert float(elbow[-1]["command_nm"]) == pytest.approx(recording.command[-1, 3], abs=1e-6)


@pytest.mark.usefixtures("without_pictures")
def test_a_figure_for_a_paper_has_its_size_letters_of_8_pt_embedded_fonts_and_the_part_that_was_asked_for(
    short_bag, tmp_path, run_tool
):
    wanted = ["--figures", "pdf", "--figures", "svg", "--width", "85", "--joints", "2", "4", "--from", "3", "--to", "9"]
    assert run_tool("report", short_bag, "--output", tmp_path, *wanted).code == 0
    for name in ("right_overview", "right_drift"):
        pdf = (tmp_path / f"{name}.pdf").read_bytes()
        width = float(re.search(rb"/MediaBox \[ 0 0 ([\d.]+)", pdf)[1])
        assert width == pytest.approx(85.0 / 25.4 * 72.0, abs=0.1) and b"/Type3" not in pdf and b"/FontFile2" in pdf
        svg = (tmp_path / f"{name}.svg").read_text(encoding="utf-8")
        assert set(re.findall(r"font-size: ([\d.]+)px", svg)) == {"8"} and "@font-face" in svg
    svg = (tmp_path / "right_overview.svg").read_text(encoding="utf-8")
    assert re.findall(r">(joint \d)</text>", svg) == ["joint 2", "joint 4"] and ">Velocity (deg/s)</text>" in svg
    times = [float(x) for x in re.findall(r"text-anchor: middle[^>]*>([\d.]+)</text>", svg)]
    assert times and max(times) <= 9.0  # s


REFUSED = {  # words, and what is said
    "a joint that it lacks": (["--joints", "5"], "joints = [5]: must be numbers from 1 to 4"),
    "a time that it lacks": (["--from", "100"], "must be a part of the recording, which lasts from 0.0 to"),
    "no such font": (["--figures", "svg", "--font", "Nothing"], "font = 'Nothing': must be the name of a font"),
    "too wide": (["--figures", "svg", "--width", "900"], "width = 900.0: must be a number from 40 to 400 mm"),
    "a width of nothing": (["--width", "85"], "--width and --font are those of --figures"),
}


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(("words", "said"), REFUSED.values(), ids=REFUSED)
def test_a_figure_that_cannot_be_drawn_is_refused(short_bag, tmp_path, words, said, run_tool):
    ended = run_tool("report", short_bag, "--output", tmp_path, *words)
    assert ended.code == 2 and said in ended.err


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("limits", "code", "words"),
    [
        (["--max-drift=0.3"], 1, r"within 10 s of hold \d, joint 4 moved 0\.\d+ degrees, more than 0\.30"),
        (["--max-rate=5"], 1, r"its drift in hold \d, joint 4 moved 6\.\d+ degrees per minute, more than 5\.00"),
        (["--max-drift=0.5", "--max-rate=7"], 0, "more than"),
    ],
)
def test_a_limit_on_the_command_line_is_in_degrees(short_bag, tmp_path, limits, code, words, run_tool):
    ended = run_tool("report", short_bag, "--output", tmp_path, *limits)
    assert ended.code == code and bool(re.search(words, ended.out)) == bool(code)


# What was recorded in part


LIMITED = {  # what differs of the recording, which is carried until s; what is said, and the exit code
    "unknown when it was carried": ({}, None, "when the arm was carried", 0),
    "cut short": ({}, 15.0, "15.0 s, before the script ended", 0),
    "no script": ({"steps": ()}, math.inf, "no step of a script", 0),
    "a joint that never moved": (
        {"position": made.trial(made.POSES, hold=4.0, push=made.PUSH).position * (0, 1, 1, 1)},
        math.inf,
        "right: joint 1 read one position throughout",
        0,
    ),
}


@pytest.mark.parametrize(("changes", "end", "said", "code"), LIMITED.values(), ids=LIMITED)
def test_what_limits_the_verdict_is_noted(held, page_of, changes, end, said, code):
    (whole,) = held.bag.recordings
    carried = None if end is None else ((0.0, min(end, whole.time[-1])),)
    report = analyse(made.bag_of(replace(whole, carried=carried, **changes)))
    assert report.exit_code == code and said in printed(report) and said in page_of(report).text
    assert len(report.arms[0][1].holds) == 3 and "<–" not in printed(report)


def test_a_recording_that_is_damaged_in_part_is_judged_by_the_rest_and_ends_with_2(held):
    (whole,) = held.bag.recordings
    damaged = analyse(made.bag_of(whole, problems=("left: damaged",)))
    assert damaged.exit_code == 2 and damaged.verdict[0].startswith("It held, as far as")
    assert "left: damaged" in printed(damaged)


# What stands on top

COMPENSATOR = """/right/compensator:
  ros__parameters: {side: right, mode: zero_g, support: 0.3, wearer.body_mass: 75.0, wearer.sex: female}
"""
REASON = "right_elbow_flexion turns too fast"
FAULT = f"letting down: over_speed: {REASON}"
WHOLE = made.trial(made.POSES, hold=6.0, rate=250.0)


def report_of(recording, *events, given=COMPENSATOR, **more):
    session = Session("P01", "pilot", "first visit", "1.2.3")
    parameters = {"/right/compensator": given}
    return analyse(made.bag_of(recording, events=events, parameters=parameters, session=session, **more))


def reported(seconds, node, level, message, fault="none", fault_text=""):
    return Event(seconds, f"{node}: {message}", status=NodeStatus(node, level, message, fault, fault_text))


def fault_at(seconds, fault="over_speed", fault_text=REASON, message=FAULT):
    return reported(seconds, "right/can_bridge", 2, message, fault, fault_text)


def setting(seconds, name, value):
    return Event(seconds, f"/right/compensator: {name} = {value}", ("/right/compensator", name, value))


mode_set = partial(setting, name="mode")


def test_rows_and_page_say_of_whom_under_what_settings_and_by_what_criteria(page_of, tmp_path):
    page = page_of(report_of(WHOLE, setting(3.0, "wearer.body_mass", 90.0), mode_set(9.0, value="one_g")))
    rows = csv_rows(tmp_path / "holds.csv")
    shared = {"trial": "demo", "subject": "P01", "arm": "right", "side": "right", "version": "1.2.3"}
    assert all(row.items() >= shared.items() for row in rows)
    carried = [(row["mode"], row["support"]) for row in rows]
    assert carried == [("zero_g", "0.3")] * 4 + [("one_g", "")] * 4  # One-G does not use the support
    wearer = "75 kg, 90 kg from 3.0 s, female"
    top = ("It held.", "P01", "pilot", "first visit", "Zero-G, One-G from 9.0 s", "30 %", wearer, "Criteria:")
    places = [page.text.index(part) for part in (*top, "1.2.3", "Arm: right")]
    assert places == sorted(places)
    assert "One-G, support none" in printed(report_of(WHOLE, given=COMPENSATOR.replace("zero_g", "one_g")))


BRIDGE = """/right/can_bridge:
  ros__parameters: {{can.interface: {}, can.channel: {}}}
"""
SAID = {"simulated": "Simulated: programs made", "real": "Recorded on a real arm", "unknown": "does not say whether"}
SOURCES = [(("virtual", "stage"), "simulated"), (("socketcan", "can0"), "real"), (("socketcan", "vcan0"), "unknown")]


@pytest.mark.parametrize(("bridge", "source"), SOURCES)
def test_page_rows_figures_and_terminal_say_where_the_numbers_come_from(page_of, tmp_path, bridge, source, monkeypatch):
    stamped = []
    monkeypatch.setattr(html, "saved", lambda *given: stamped.append(given[2]) or b"")
    report = analyse(made.bag_of(WHOLE, parameters={"/right/can_bridge": BRIDGE.format(*bridge)}))
    text = page_of(report).text
    assert text.index(SAID[source]) < text.index("It held") and f"source: {source}" in printed(report)
    assert {row["source"] for row in csv_rows(tmp_path / "holds.csv")} == {source}
    assert set(report.bag.columns()["source"]) == {source} and set(stamped) == {STAMPS[Source(source)]}


def test_what_the_nodes_say_of_the_source_is_believed_before_the_parameters(tmp_path):
    entries = [*made.messages(WHOLE), made.status(0.5, "active", state="active", source="real")]
    bag = read_bag(made.write_bag(tmp_path / "bag", entries))
    assert bag.source("right") is Source.REAL and bag.source("left") is Source.UNKNOWN


LET_DOWN = replace(made.trial(made.POSES, hold=6.0, fall_after=12.5), carried=((0.0, 12.5),))  # and it fell
PLANNED = replace(WHOLE, carried=((0.0, WHOLE.steps[-1].end),))
UNSEEN = replace(  # from 5 to 8 s
    WHOLE, carried=((0.0, 5.1), (7.5, 16.0)),
    **{name: getattr(WHOLE, name)[(WHOLE.time < 5.0) | (WHOLE.time > 8.0)] for name in ("time", *ARRAYS)},
)  # fmt: skip
UNSCRIPTED, NO_SCRIPT = replace(WHOLE, steps=()), replace(LET_DOWN, steps=())
TROUBLE = "stopped by the operator"
OLD_MEANING, ZQX = FaultCode.OVER_SPEED.meaning, "letting down: wrong_sign: zqx vw kfj"
VERDICTS = {  # the recording, what happened, why the trial ended early, the sentence, and whether it is good
    "let down as planned": (PLANNED, (), "", "(?!.*let down)It held", True),
    "without a script or a fault": (NO_SCRIPT, (), "", "(?!.*let down)It held", True),
    "without a script": (NO_SCRIPT, (fault_at(12.5),), "", "Right: let down", False),
    "a fault's key": (
        LET_DOWN, (fault_at(12.6, message=ZQX),), "",
        rf"Right: let down at 12.5 s \(over_speed: {REASON}\): .*joint 4 moved 5\d\.\d+ degrees, at up to \d\d+ deg/s"
        r".*Otherwise it held\.$", False,
    ),
    "of an earlier version": (
        LET_DOWN, (fault_at(12.6, fault_text="", message=ZQX),), "", rf".* \(over_speed: {OLD_MEANING}\): ", False,
    ),
    "of a later version": (
        LET_DOWN, (fault_at(12.6, "new_fault", "", ZQX),), "", r".* s \(new_fault: a fault\): ", False,
    ),
    "in a gap": (UNSEEN, (), "", r"Right: let down at 5\.1 s: joint \d moved 0\.\d\d degrees", False),
    "no fault": (LET_DOWN, (fault_at(12.6, "none", "", ZQX),), "", r"Right: let down at 12\.5 s: ", False),
    "a change of load": (
        UNSCRIPTED, (mode_set(7.5, value="one_g"),), "",
        r"Right: moved at 8.0 s after mode = one_g: joint 2 moved 2[12]\.\d\d degrees", False,
    ),
    "the last of two changes": (
        UNSCRIPTED, (setting(7.0, "support", 0.5), mode_set(7.5, value="one_g")), "",
        "Right: moved at 8.0 s after mode = one_g", False,
    ),
    "no change of load": (UNSCRIPTED, (mode_set(7.5, value="zero_g"),), "", "It held. Worst", True),
    "ended early": (PLANNED, (), TROUBLE, f"It held until the trial ended early: {TROUBLE}. Worst: right: ", True),
    "ended before a hold": (
        made.trial(made.POSES[:1], hold=0.5), (), TROUBLE,
        f".*It did not hold. The trial ended early: {TROUBLE}.", False,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("recording", "events", "trouble", "sentence", "is_good"), VERDICTS.values(), ids=VERDICTS)
def test_the_report_leads_with_what_happened(recording, events, trouble, sentence, is_good):
    text, good = analyse(report_of(recording, *events).bag, trouble=trouble).verdict
    assert re.match(sentence, text), text
    assert good is is_good


def test_where_nothing_moved_the_resolution_is_stated():
    codes = np.round(WHOLE.position / made.POSITION_CODE)
    for step in WHOLE.steps:
        within = (WHOLE.time >= step.start) & (WHOLE.time < step.end)
        codes[within] = codes[within][-1] if step.action == "hold" else codes[within]
    report = report_of(replace(WHOLE, position=codes * made.POSITION_CODE))
    code = math.degrees(made.POSITION_CODE)
    assert report.verdict == (f"It held. Right: no measurable movement (below {code:.3f} degrees).", True)
    bound = f"<{60.0 * code / report.arms[0][1].holds[0].duration:.2f}"
    assert " ".join([bound] * 4) in printed(report)


def test_lines_of_the_start_are_left_out_and_markers_are_listed(page_of):
    starting = [reported(0.1 * n, "right/can_bridge", 1, f"checking: waiting for {n}") for n in range(5)]
    starting += [reported(0.6, "right/can_bridge", 0, "OK, active"), reported(0.7, "imu", 1, "WARN that lasts")]
    carried, markers = replace(WHOLE, carried=((1.0, 16.0),)), (Event(2.0, "cramp"),)
    text = page_of(report_of(carried, *starting, fault_at(3.0), markers=markers)).text
    assert "checking" not in text and "OK, active" not in text
    places = [
        text.index(part) for part in ("WARN that lasts", "2.0 s  marker: cramp", f"3.0 s  right/can_bridge: {FAULT}")
    ]
    assert places == sorted(places)


# The wearer, who gives a known share

TIME = np.arange(0.0, 8.0, 0.01)
LENGTH, POSE, BOW = (0.05, 0.13, 0.30, 0.30), (0.2, 0.9, 0.7, 0.6), 0.3
JOINTS = tuple(f"right_{n}" for n in range(4))
TRUNK = np.array([(time, 0.0, 0.0, 0.0, *gravity_in_trunk(BOW, 0.0)) for time in (0.0, 8.0)])
GIVEN: dict[str, Any] = {
    "side": "right", "joint_names": list(JOINTS), "wearer.body_mass": 75.0, "model_error.wearer": 0.02,
    "model_error.torque": [0.02] * 4, "model_error.scale": [0.005] * 4,
}  # fmt: skip


def still(names, pose, effort):
    """Return the recording of an arm that is held still by `effort`, carried from 1 to 7 s."""
    rows = [np.tile(row, (len(TIME), 1)) for row in (pose, np.zeros(len(pose)), effort, effort)]
    return Recording("right", tuple(names), TIME, *rows, carried=((1.0, 7.0),))


def shared(share: float) -> Recording:
    """Return the recording of the paper's arm on a bowed trunk, whose wearer gives `share` of what their arm needs."""
    down, load = Tilt.of("right", BOW).direction, Wearer(75.0).on_links(LENGTH)
    own = gravity_torque(ArmModel(LENGTH, load.cog, load.mass), POSE, down)
    return still(JOINTS, POSE, gravity_torque(configured_arm().robot, POSE, down) + (1.0 - share) * own)


def shared_by_seven(share: float) -> tuple[Recording, dict[str, Any]]:
    """Return such a recording of the arm of seven joints, upright, and the compensator's parameters."""
    given = load(CONFIG / "seven_joints.yaml")["/right/compensator"]
    names, text = given["joint_names"], (CONFIG / "arms" / "seven_joints.urdf").read_text(encoding="utf-8")
    mass, cog = [0.0, 0.0, 1.5, 0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.12, 0.0, 0.1, 0.0, 0.0]
    pose = [0.6, 0.5, 0.3, 0.9, 0.2, 0.3, -0.2]
    return still(names, pose, WornMujocoArm(text, names, [(1.0 - share) * m for m in mass], cog).torque(pose)), {
        **given, "wearer.mass": mass, "wearer.cog": cog, "mode": "zero_g", "support": 1.0,
    }  # fmt: skip


def with_wearer(recording, values, **trunk):
    """Return the report of a recording with the compensator's parameters."""
    text = yaml.safe_dump({"/right/compensator": {"ros__parameters": values}})
    return analyse(made.bag_of(recording, parameters={"/right/compensator": text} if values else {}, **trunk))


@pytest.mark.parametrize(
    ("share", "is_paper"), quick([(0.4, True), (0.3, False)], [(0.0, True), (0.4, True), (0.3, False), (1.0, False)])
)
def test_the_share_of_the_recording_and_of_each_joint_is_found_and_said(share, is_paper, tmp_path):
    recording, values = (shared(share), GIVEN) if is_paper else shared_by_seven(share)
    report = with_wearer(recording, values, **({"trunk": TRUNK} if is_paper else {}))
    part = report.wearers["right"]
    known = np.isfinite(part.joints.value)
    assert part.whole.value == pytest.approx(share, abs=0.005) and known.sum() >= 3
    np.testing.assert_allclose(part.joints.value[known], share, atol=0.005)
    assert part.curve.time[0] >= 1.0 and part.curve.time[-1] <= 7.0  # while the arm was carried
    said, simulated, here = (
        next(wearer_sentences(part, source, recording.joint_names))
        for source in (Source.REAL, Source.SIMULATED, Source.UNKNOWN)
    )
    assert simulated == f"In the simulation, t{said[1:]}" and f"{100 * share:.0f} % of their arm's weight" in said
    assert not is_paper or ("not distinguishable from zero" in said) == (share == 0.0)
    assert "right_wearer.png" in [path.name for path in write(report, tmp_path)]
    page = page_in(tmp_path).text
    assert here.split("(")[0] in page  # as this recording has it
    shown = [name for name, is_known in zip(recording.joint_names, known, strict=True) if is_known]
    assert all(f"{name} {100 * share:.0f} % (±" in page for name in shown)


def test_a_share_needs_a_wearer_the_trunks_tilt_and_something_to_carry():
    for values in ({}, {**GIVEN, "wearer.body_mass": 0.0}):
        report = with_wearer(shared(0.4), values, trunk=TRUNK)
        assert not report.wearers and not any("wearer" in note for note in report.notes)
    report = with_wearer(shared(0.4), GIVEN)
    assert not report.wearers and any("no /imu/data" in note for note in report.notes)
    report = with_wearer(shared(0.4), GIVEN, trunk=TRUNK, events=(setting(3.0, "payload.mass", 2.0),))
    assert not report.wearers and any("payload.mass was changed at 3.0 s" in note for note in report.notes)
    upright = with_wearer(replace(shared(0.4), carried=None), {**GIVEN, "use_imu": False})
    assert upright.wearers["right"].curve.time[0] == 0.0
    hanging = with_wearer(still(JOINTS, (0.0,) * 4, (0.0,) * 4), {**GIVEN, "use_imu": False})
    assert "nothing to carry" in next(wearer_sentences(hanging.wearers["right"], Source.UNKNOWN, JOINTS))


# Of many recordings: a row for each, and one that fails is named

DRIFTS = (1.0, 2.0, 3.0)  # deg/min of the elbow
SUMMARY = partial(cohort.summary, criteria=HoldCriteria(), min_hold=2.0, every=1)


def drifting(per_minute):
    return made.trial(made.POSES, hold=4.0, rate=50.0, drift=np.radians([0.0, 0.0, 0.0, per_minute]) / 60.0)


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """A folder of three trials of one subject, a day each, one that is no recording, and one that is cut."""
    folder, session = tmp_path_factory.mktemp("written") / "trials", json.dumps(asdict(Session("P01")))
    for number, drift in enumerate(DRIFTS):
        with pytest.MonkeyPatch.context() as day:
            day.setattr(made, "START", made.START + number * 86_400 * 10**9)
            content = [made.text_entry("/recorder/session", 0.0, session), *made.messages(drifting(drift))]
            made.write_bag(folder / f"day_{number}" / "bag", content)
    cut = made.write_bag(folder / "cut" / "bag", made.messages(made.trial(made.POSES[:1], hold=4.0, rate=50.0)))
    (cut / "metadata.yaml").unlink()
    made.cut(cut / "bag.mcap", 0.95)  # within the index of its only chunk
    (folder / "damaged").mkdir()
    (folder / "damaged" / "text.mcap").write_text("no recording")
    return folder


def test_a_folder_becomes_one_table_and_page_and_what_fails_is_named(trials, tmp_path, run_tool):
    ended, out = run_tool("report", trials, "--output", tmp_path / "out"), tmp_path / "out"
    text, page = " ".join(ended.out.split()), (out / "cohort.html").read_text(encoding="utf-8")
    assert ended.code == 2 and "SPARC % Verdict" in text and "text.mcap: not an MCAP file" in text
    assert "4 of 4 trials held; recordings not read, or not completely: 1" in text
    assert "text.mcap: not an MCAP file" in page and page.count("<img ") == 1
    rows = csv_rows(out / "cohort.csv")
    assert len(rows) == 4 * len(made.NAMES) + 1
    below = [row for row in rows if row["joint"] == made.NAMES[3]]
    for key, expected, within in (
        ("drift_deg_per_min", DRIFTS, 0.6),
        ("moved_in_step_deg", np.divide(DRIFTS, 15.0), 0.03),
    ):
        np.testing.assert_allclose([float(row[key]) for row in below if row["subject"]], expected, atol=within)
    first = [float(row["range_of_motion_deg"]) for row in rows if "day_0" in row["recording"]]
    np.testing.assert_allclose(np.radians(first), np.ptp(np.vstack((np.zeros(4), made.POSES)), axis=0), atol=0.01)
    assert all(0.0 < float(row["drift_uncertainty_deg_per_min"]) < 1.0 for row in below)
    assert all(-1.8 < float(row["smoothness_sparc"]) < -1.3 for row in below if row["subject"])  # bells of speed
    assert re.search(r" [123]\.\d\d ± 0\.\d\d ", text)  # not 0.00 everywhere


@pytest.mark.thorough
def test_when_a_worker_of_a_cluster_is_killed_no_recording_is_lost_and_none_is_there_twice(tmp_path):
    from distributed import Client, LocalCluster  # a second of imports, which no other test needs

    content = list(made.messages(drifting(1.0)))
    recordings = [made.write_bag(tmp_path / f"more_{number}" / "bag", content) for number in range(8)]
    expected = [row for recording in recordings for row in SUMMARY(str(recording))]
    workers = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(host="127.0.0.1", **workers) as cluster, Client(cluster) as client:
        running = sorted(client.run(os.getpid).values())[:1]

        def done():  # the first recording is finished
            while running:
                os.kill(running.pop(), signal.SIGKILL)

        assert cohort.summaries(recordings, SUMMARY, partial(on_cluster, cluster.scheduler_address), done) == expected


def trial_row(subject, mode, **values):
    """Return a trial of the paper's right arm, as `study.trials_of` does; what is not given is unknown."""
    return {
        **dict.fromkeys(cohort.COLUMNS),
        "subject": subject,
        "protocol": "reaching",
        "arm": "right",
        "source": "real",
        "verdict": "It held.",
        "mode": mode,
        "recording": f"{subject}/{mode}/{values}",
        **values,
    }


def test_conditions_and_their_paired_differences_are_those_that_pandas_and_scipy_find():
    dice, subjects, modes = np.random.default_rng(0), [f"P{n}" for n in range(7)], ("one_g", "zero_g", "other")
    own = dict(zip(subjects, dice.normal(4.0, 1.5, len(subjects)), strict=True))
    rows = [
        trial_row(subject, mode, drift_deg_per_min=own[subject] + effect + dice.normal(0.0, 0.6))
        for subject in subjects
        for mode, effect in zip(modes, (1.0, 0.0, 0.3), strict=True)
        for _ in range(1 + subjects.index(subject) % 3)  # more trials do not count more
        if (subject, mode) != ("P6", "zero_g")
    ]
    table = pandas.DataFrame(rows).pivot_table(index="subject", columns="mode", values="drift_deg_per_min")
    words = {
        "one_g": "right, reaching, One-G",
        "zero_g": "right, reaching, Zero-G",
        "other": "right, reaching, unknown mode",
    }
    found = {row["condition"]: row for row in study.statistics(rows)}
    for mode in modes:
        row, values = found[words[mode]], table[mode].dropna()
        interval = stats.t.interval(0.95, len(values) - 1, values.mean(), stats.sem(values))
        expected = (len(values), values.mean(), values.std(), *interval)
        assert [row[key] for key in ("n", "mean", "sd", "low_95", "high_95")] == pytest.approx(expected)
    by_words = {text: mode for mode, text in words.items()}
    compared = [
        (row, table[[by_words[row["from"]], by_words[row["to"]]]].dropna().to_numpy().T)
        for row in study.differences(rows)
    ]
    tests = [stats.ttest_rel(after, before) for _, (before, after) in compared]
    for (row, _), test in zip(compared, tests, strict=True):
        interval = test.confidence_interval()
        assert [row[key] for key in ("p", "low_95", "high_95")] == pytest.approx([test.pvalue, *interval])
    p, holm = zip(*sorted((row["p"], row["p_holm"]) for row, _ in compared), strict=True)
    assert holm == pytest.approx(np.minimum(1.0, np.maximum.accumulate(np.multiply(p, (3, 2, 1)))))


def test_recordings_of_one_wearer_count_one_by_one_and_are_not_compared():
    rows = [trial_row("P1", mode, wearer_share=share) for mode in ("one_g", "zero_g") for share in (0.2, 0.4)]
    assert [(row["n"], row["mean"]) for row in study.statistics(rows)] == [(2, pytest.approx(30.0))] * 2
    assert not [*study.differences(rows)]


@pytest.mark.usefixtures("without_pictures")
def test_many_recordings_become_one_table_and_one_dataset_and_a_part_of_one_is_refused(trials, tmp_path, run_tool):
    assert run_tool("report", trials, "--csv", "--parquet", "--lerobot", "25", "--output", tmp_path).code == 2
    table = pyarrow.parquet.read_table(tmp_path / "time_series.parquet").to_pandas()
    frames = {bag: read_bag(trials / bag / "bag").to_frame() for bag in ("cut", "day_0", "day_1", "day_2")}
    for name, frame in frames.items():
        rows = table[table.recording == str(trials / name / "bag")].drop(columns="recording")
        pandas.testing.assert_frame_equal(rows.reset_index(drop=True), frame, check_dtype=False)
    text = pandas.read_csv(tmp_path / "time_series.csv", keep_default_na=False, na_values={"command_nm": [""]})
    pandas.testing.assert_frame_equal(text, table, check_dtype=False, rtol=1e-5)
    # The layout of LeRobot v3.0, of which its own package read such a dataset.
    root = tmp_path / "lerobot"
    info = json.loads((root / "meta" / "info.json").read_text())
    episodes = pandas.read_parquet(root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    tasks = pandas.read_parquet(root / "meta" / "tasks.parquet")
    assert info["codebase_version"] == "v3.0" and info["fps"] == 25 and info["total_episodes"] == len(episodes) == 4
    assert tasks.index.tolist() == ["cut", "day_0", "day_1", "day_2"] and tasks.task_index.tolist() == [0, 1, 2, 3]
    begin, actions = 0, []
    for (_, episode), frame in zip(episodes.iterrows(), frames.values(), strict=True):
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        data = pandas.read_parquet(root / info["data_path"].format(**place))
        assert (episode.dataset_from_index, episode.dataset_to_index) == (begin, begin + len(data)) == (
            data["index"].iloc[0], data["index"].iloc[-1] + 1,
        )  # fmt: skip
        assert set(data.columns) == set(info["features"]) and episode.length == len(data)
        np.testing.assert_allclose(np.diff(data.timestamp), 1 / 25, atol=1e-5)
        joint = frame[(frame.joint == made.NAMES[1]) & frame.command_nm.notna()]
        where = joint.time_s.iloc[0] + data.timestamp
        for feature, column in (("observation.state", "position_rad"), ("action", "command_nm")):
            expected = np.interp(where, joint.time_s, joint[column])
            np.testing.assert_allclose(np.stack(data[feature])[:, 1], expected, atol=1e-4)
        actions.append(np.stack(data["action"]))
        begin += len(data)
    told = json.loads((root / "meta" / "stats.json").read_text())["action"]
    whole = np.concatenate(actions)
    for name, expected in (("mean", whole.mean(axis=0)), ("std", whole.std(axis=0)), ("max", whole.max(axis=0))):
        np.testing.assert_allclose(told[name], expected, rtol=1e-4, atol=1e-5)
    again = run_tool("report", trials, "--lerobot", "25", "--output", tmp_path)
    assert again.code == 2 and "a dataset is there already" in again.err
    part = run_tool("report", trials, "--joints", "1", "--video", "a.gif", "--output", tmp_path)
    assert part.code == 2 and "recordings = 5: must be one for --video, --joints" in part.err
