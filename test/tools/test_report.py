# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The command `report`, from a bag to the terminal, files and an exit code."""

from __future__ import annotations

import base64
import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Event, NodeStatus
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.report import figures, html
from exo_gravity.lab.report.trial_report import STAMPS, analyse, print_report, write, write_empty
from exo_gravity.lab.trial.session import Session
from exo_gravity.tools.report import main

from ..support import csv_rows
from ..support import synthetic_bags as made


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
    drift = np.array([0.0, 0.0, 0.0, math.radians(6.0) / 60.0])
    recording = made.trial(made.POSES, hold=4.0, rate=100.0, drift=drift)
    return made.write_bag(tmp_path_factory.mktemp("bags") / "short", made.messages(recording))


def printed(report):
    console = Console(file=io.StringIO(), width=140)
    print_report(report, console)
    return " ".join(console.file.getvalue().split())


class Page(HTMLParser):
    """The report's page in `folder`: what it refers to, and its text. Its tags are closed in order."""

    def __init__(self, folder):
        super().__init__()
        self.open, self.references, self.text = [], [], ""
        self.source = (folder / "report.html").read_text(encoding="utf-8")
        self.feed(self.source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.references += [value for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def page_of(tmp_path, without_pictures):
    """A function that writes a report without pictures, and returns its page."""

    def page_of(report):
        write(report, tmp_path)
        return Page(tmp_path)

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


def test_the_terminal_shows_every_hold_and_the_push(held):
    console = Console(file=io.StringIO(), width=140)
    print_report(held, console)
    text = console.file.getvalue()
    assert re.findall(r"^ +(\d) +[\d.]+ +[\d.]+ ", text, re.MULTILINE) == ["1", "2", "3"]
    assert re.search(r"push +\S+ +\S+ +2\.\d 14\.\d -8\.\d +5\.\d", text)


def test_an_unknown_torque_error_is_an_empty_cell_and_a_dash(held, tmp_path, page_of):
    (whole,) = held.bag.recordings
    report = analyse(made.bag_of(replace(whole, command=np.full_like(whole.command, math.nan))))
    page_of(report)
    assert {row["torque_error_nm"] for row in csv_rows(tmp_path / "holds.csv")} == {""}
    assert "–" in printed(report)


def test_the_page_refers_to_nothing_outside_itself_and_its_pictures_are_the_png_files(held, folder):
    page = Page(folder)
    assert "url(" not in page.source and f"<h1>{held.title}</h1>" in page.source
    embedded = [base64.b64decode(ref.removeprefix("data:image/png;base64,")) for ref in page.references]
    assert embedded == [(folder / "right_overview.png").read_bytes()]  # the joints stayed: no drift to draw
    picture = matplotlib.image.imread(folder / "right_overview.png")
    assert picture.shape[1] >= 1600 and picture[..., :3].std() > 0.05


@pytest.mark.parametrize(
    ("path", "arms", "title"),
    [
        ("trials/two_poses_20231114_221320/bag", ("right",), "two poses, right arm, 2023-11-1"),
        ("trials/demo_20231114_221320", ("left", "right"), "demo, left and right arms, 2023-11-1"),
        ("rosbag2_monday", ("arm",), "rosbag2 monday, arm, 2023-11-1"),
        ("monday.mcap", ("right",), "monday, right arm, 2023-11-1"),
    ],
)
def test_the_title_is_the_trials_name_the_arms_and_the_date(held, path, arms, title):
    (recording,) = held.bag.recordings
    named = tuple(replace(recording, name=name) for name in arms)
    bag = replace(held.bag, path=Path(path), recordings=named)
    assert replace(held, bag=bag).title[:-1] == title


def test_text_from_a_recording_cannot_become_markup(held, page_of):
    texts = {"events": (Event(1.0, "<script>alert(1)</script>"),), "parameters": {"/a": "/a: <b>\n"}}
    source = page_of(analyse(made.bag_of(*held.bag.recordings, **texts, notes=("<i>",)))).source
    assert "<script>" not in source and "<b>\n" not in source and "&lt;script&gt;" in source
    assert "frame [01 02]" in printed(analyse(made.bag_of(*held.bag.recordings, notes=("frame [01 02]",))))


# The command


def test_the_report_is_written_next_to_its_recording_by_default_and_a_folder_that_cannot_be_is_named(short_bag, held):
    assert main([str(short_bag)]) == 0
    written = {path.name for path in short_bag.with_name("short_report").iterdir()}
    assert written == {"holds.csv", "motions.csv", "report.html", "right_drift.png", "right_overview.png"}
    (short_bag.parent / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        write(held, short_bag.parent / "file" / "report")


@pytest.mark.usefixtures("without_pictures")
def test_on_request_the_time_series_and_each_figure_as_pdf_and_svg_with_text_are_written(
    short_bag, tmp_path, monkeypatch
):
    labelled = Figure(figsize=(1.0, 1.0))
    labelled.text(0.5, 0.5, "Torque (Nm)")
    for name in ("overview", "drift"):
        monkeypatch.setattr(figures, name, lambda *_: labelled)
    formats = ("--figures", "pdf", "--figures", "svg")
    assert main([str(short_bag), "--output", str(tmp_path), "--csv", *formats]) == 0
    for name in ("right_overview", "right_drift"):
        pdf = (tmp_path / f"{name}.pdf").read_bytes()
        assert pdf.startswith(b"%PDF") and b"/Type3" not in pdf and b"/FontFile2" in pdf
        assert ">Torque (Nm)</text>" in (tmp_path / f"{name}.svg").read_text(encoding="utf-8")
    rows, (recording,) = csv_rows(tmp_path / "time_series.csv"), read_bag(short_bag).recordings
    assert len(rows) == 4 * len(recording.time)
    elbow = [row for row in rows if row["joint"] == recording.joint_names[3]]
    values = (recording.time, recording.position[:, 3], recording.velocity[:, 3], recording.effort[:, 3])
    names = ("time_s", "position_rad", "velocity_rad_per_s", "torque_nm")
    for name, expected in zip(names, values, strict=True):
        np.testing.assert_allclose([float(row[name]) for row in elbow], expected, atol=1e-6)
    assert elbow[0]["command_nm"] == ""  # no command before the first joint state
    assert float(elbow[-1]["command_nm"]) == pytest.approx(recording.command[-1, 3], abs=1e-6)


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("limits", "code"), [(["--max-drift=0.3"], 1), (["--max-rate=5"], 1), (["--max-drift=0.5", "--max-rate=7"], 0)]
)
def test_a_limit_on_the_command_line_is_in_degrees(short_bag, tmp_path, limits, code, capsys):
    assert main([str(short_bag), "--output", str(tmp_path), *limits]) == code
    assert ("right_joint_4 " in capsys.readouterr().out) == bool(code)


# What was recorded in part


def test_a_name_with_brackets_is_that_of_its_folder_and_no_pattern(tmp_path, capsys):
    for name in ("run[1]", "run1"):
        (tmp_path / name).mkdir()
    assert main([str(tmp_path / "run[1]")]) == 2
    assert "run[1]: must be a rosbag2 folder" in capsys.readouterr().err


def test_a_recording_without_a_hold_is_reported_with_figures_and_1(page_of, tmp_path):
    report = analyse(made.bag_of(replace(made.trial(made.POSES, hold=0.5, rate=100.0), steps=())))
    assert report.exit_code == 1 and "never still" in page_of(report).text
    assert (tmp_path / "right_overview.png").exists()


def with_carried(report, end=None):
    """The report of the recording with the span in which the arm was carried, by default all of it."""
    (whole,) = report.bag.recordings
    return analyse(made.bag_of(replace(whole, carried=((0.0, end or whole.time[-1]),))))


def test_what_limits_the_verdict_is_noted(held, page_of):
    assert "when the arm was carried" in printed(held)
    assert not with_carried(held).notes
    unfinished = with_carried(held, 15.0)
    assert unfinished.exit_code == 0 and "15.0 s, before the script ended" in printed(unfinished)
    (whole,) = held.bag.recordings
    unscripted = with_carried(replace(held, bag=made.bag_of(replace(whole, steps=()))))
    assert len(unscripted.arms[0][1].holds) == 3 and unscripted.exit_code == 0
    assert "no trial script" in printed(unscripted) and "no trial script" in page_of(unscripted).text
    damaged = analyse(made.bag_of(whole, problems=("left: damaged",)))
    assert damaged.exit_code == 2 and damaged.verdict[0].startswith("It held, as far as")
    assert "left: damaged" in printed(damaged)


@pytest.mark.usefixtures("without_pictures")
def test_a_killed_trial_is_not_said_to_have_been_let_down(tmp_path, capsys):
    """The bag of a trial that is killed while the arm is carried, in its second hold."""
    states = [made.status(0.5 * n, "active", state="active") for n in range(24)]
    content = [*made.messages(made.trial(made.POSES, hold=6.0, rate=100.0)), *states]
    bag = made.write_bag(tmp_path / "killed", [item for item in content if item[2] < made.START + 12 * 10**9])
    assert main([str(bag), "--output", str(tmp_path / "out")]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "let down at" not in text and " let down " not in text.replace("how the arm was let down", "")
    assert "the recording ends at 12.0 s, before the script ended" in text
    assert "as far as it was recorded" in text and "as far as it was recorded" in Page(tmp_path / "out").text
    assert "let down" not in (tmp_path / "out" / "motions.csv").read_text(encoding="utf-8")


def test_a_trial_of_which_nothing_was_recorded_has_a_report_too(tmp_path):
    write_empty(tmp_path, "demo", "stopped by the operator")
    assert "demo" in Page(tmp_path).text and "Nothing was recorded: stopped by the operator." in Page(tmp_path).text


# What stands on top

COMPENSATOR = """/right/compensator:
  ros__parameters: {side: right, mode: zero_g, support: 0.3, wearer.body_mass: 75.0, wearer.sex: female}
"""
REASON = "right_elbow_flexion turns too fast"
FAULT = f"right/can_bridge: letting down: over_speed: {REASON}"
WHOLE = made.trial(made.POSES, hold=6.0, rate=250.0)


def report_of(recording, *events, given=COMPENSATOR, **more):
    """Return the report of a recording with the compensator's parameters and the session."""
    session = Session("P01", "pilot", "first visit", "1.2.3")
    parameters = {"/right/compensator": given}
    return analyse(made.bag_of(recording, events=events, parameters=parameters, session=session, **more))


def reported(seconds, node, level, message, fault="none", fault_text=""):
    """Return the event of a status on /diagnostics."""
    return Event(seconds, f"{node}: {message}", status=NodeStatus(node, level, message, fault, fault_text))


def fault_at(seconds):
    return reported(seconds, "right/can_bridge", 2, f"letting down: over_speed: {REASON}", "over_speed", REASON)


def mode_set(seconds, mode):
    return Event(seconds, f"/right/compensator: mode = {mode}", ("/right/compensator", "mode", mode))


def test_rows_and_page_say_of_whom_under_what_settings_and_by_what_criteria(page_of, tmp_path):
    page = page_of(report_of(WHOLE, mode_set(9.0, "one_g")))
    rows = csv_rows(tmp_path / "holds.csv")
    shared = {"trial": "demo", "subject": "P01", "arm": "right", "side": "right", "version": "1.2.3"}
    assert all(row.items() >= shared.items() for row in rows)
    carried = [(row["mode"], row["support"]) for row in rows]
    assert carried == [("zero_g", "0.3")] * 4 + [("one_g", "")] * 4  # One-G does not use the support
    top = ("It held.", "P01", "pilot", "first visit", "Zero-G, One-G from 9.0 s", "30 %", "75 kg, female", "Criteria:")
    places = [page.text.index(part) for part in (*top, "1.2.3", "Arm: right")]
    assert places == sorted(places)
    one_g = COMPENSATOR.replace("zero_g", "one_g")  # it does not use the support
    assert "One-G, support none" in printed(report_of(WHOLE, given=one_g))


BRIDGE = """/right/can_bridge:
  ros__parameters: {{can.interface: {}, can.channel: {}}}
"""
SAID = {"simulated": "Simulated: programs made", "real": "Recorded on a real arm", "unknown": "does not say whether"}


@pytest.mark.parametrize(
    ("bridge", "source"),
    [(("virtual", "stage"), "simulated"), (("socketcan", "can0"), "real"), (("socketcan", "vcan0"), "unknown")],
)
def test_page_rows_figures_and_terminal_say_where_the_numbers_come_from(tmp_path, bridge, source, monkeypatch):
    stamped = []
    monkeypatch.setattr(html, "stamp", lambda figure, text: stamped.append(text))
    monkeypatch.setattr(html, "png_of", lambda *_: b"")
    report = analyse(made.bag_of(WHOLE, parameters={"/right/can_bridge": BRIDGE.format(*bridge)}))
    write(report, tmp_path)
    text = Page(tmp_path).text
    assert text.index(SAID[source]) < text.index(report.held)
    assert {row["source"] for row in csv_rows(tmp_path / "holds.csv")} == {source}
    assert set(report.bag.columns()["source"]) == {source}
    assert set(stamped) == {STAMPS[Source(source)]}
    assert f"source: {source}" in printed(report)


def test_what_the_nodes_say_of_the_source_is_believed_before_the_parameters(tmp_path):
    entries = [*made.messages(WHOLE), made.status(0.5, "active", state="active", source="real")]
    bag = read_bag(made.write_bag(tmp_path / "bag", entries))
    assert bag.source("right") is Source.REAL and bag.source("left") is Source.UNKNOWN


def test_only_joints_that_moved_are_drawn_and_the_others_are_a_line(tmp_path, page_of):
    away = np.array([0.0, 0.0, 0.0, math.radians(6.0) / 60.0])
    report = analyse(made.bag_of(made.trial(made.POSES, hold=6.0, rate=100.0, drift=away)))
    figure = figures.drift(*report.arms[0], report.criteria)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert [title for title in titles if title] == ["joint 4"]
    text = page_of(report).text
    assert re.search(r"none of joint 1, joint 2, joint 3 moved more than 0\.0\d\d degrees", text)
    assert "no joint moved more than 0.0" in page_of(analyse(made.bag_of(WHOLE))).text


def test_the_report_of_an_arm_that_did_not_hold_leads_with_it_and_each_reason(page_of):
    report = report_of(made.trial(made.POSES, hold=6.0, fall_after=5.0))
    text = page_of(report).text
    assert report.exit_code == 1 and "It did not hold." in text
    assert report.failures and all(sentence in text for sentence in report.failures)


def let_down(end, **more):
    """Return a trial of which the arm was let down at `end` s, and fell."""
    return replace(made.trial(made.POSES, hold=6.0, fall_after=end), carried=((0.0, end),), **more)


def test_the_report_leads_with_a_fall_and_the_fault_that_caused_it_unless_it_was_planned():
    report = report_of(let_down(12.5), fault_at(12.6))
    text, good = report.verdict
    lowest = np.abs(np.degrees(made.POSES[1])).max()  # rotates back to 0
    moved = re.search(r"joint 4 moved ([\d.]+) degrees, at up to (\d+) deg/s", text)
    assert not good and text.startswith("Right: let down at 12.5 s (over_speed: right_elbow_flexion turns too fast)")
    assert float(moved[1]) == pytest.approx(lowest, rel=0.01) and int(moved[2]) > 50
    assert text.endswith("Otherwise it held.") and report.exit_code == 0
    planned = report_of(replace(WHOLE, carried=((0.0, WHOLE.steps[-1].end),))).verdict
    assert planned[1] and "let down" not in planned[0]
    unscripted = let_down(12.5, steps=())
    assert "let down" not in report_of(unscripted).verdict[0]
    assert "let down" in report_of(unscripted, fault_at(12.5)).verdict[0]


@pytest.mark.parametrize(
    ("fault", "fault_text", "named"),
    [
        ("over_speed", REASON, f" (over_speed: {REASON})"),
        ("over_speed", "", f" (over_speed: {FaultCode.OVER_SPEED.meaning})"),  # a recording of an earlier version
        ("new_fault", "", " (new_fault: a fault)"),  # of a later one
        ("none", "", ""),
    ],
)
def test_the_fault_that_a_report_names_comes_from_its_key_whatever_the_sentence_says(fault, fault_text, named):
    said = "letting down: wrong_sign: zqx vw kfj"
    report = report_of(let_down(12.5), reported(12.6, "right/can_bridge", 2, said, fault, fault_text))
    assert report.verdict[0].startswith(f"Right: let down at 12.5 s{named}: ")


def test_a_motion_after_a_change_of_load_names_the_change_but_not_one_to_the_same_value():
    unscripted = replace(WHOLE, steps=())
    text, good = report_of(unscripted, mode_set(7.5, "one_g")).verdict
    assert not good and re.match(r"Right: moved at 8.0 s after mode = one_g: joint 2 moved 2[12]\.\d\d degrees", text)
    report = report_of(unscripted, mode_set(7.5, "zero_g"))
    assert "after mode" not in report.verdict[0] and "right: Zero-G, support 30 %" in printed(report)


def test_a_trial_that_ended_early_says_why_also_before_its_first_hold(held):
    trouble = "stopped by the operator"
    early = analyse(held.bag, trouble=trouble).verdict
    assert early[0].startswith(f"It held until the trial ended early: {trouble}. Worst: right: ")
    text, good = analyse(made.bag_of(made.trial(made.POSES[:1], hold=0.5)), trouble=trouble).verdict
    assert not good and f"It did not hold. The trial ended early: {trouble}." in text


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
    carried = replace(WHOLE, carried=((1.0, 16.0),))
    text = page_of(report_of(carried, *starting, fault_at(3.0), markers=(Event(2.0, "cramp"),))).text
    assert "checking" not in text and "OK, active" not in text
    assert text.index("WARN that lasts") < text.index("2.0 s  marker: cramp") < text.index(f"3.0 s  {FAULT}")
