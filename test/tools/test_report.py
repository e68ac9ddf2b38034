"""The command `report`, from a bag to the terminal, files and an exit code."""

from __future__ import annotations

import base64
import dataclasses
import io
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from exo_gravity.core.errors import DataError
from exo_gravity.lab.bag.content import Event
from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.report import figures
from exo_gravity.lab.report.trial_report import analyse, print_report, write, write_empty
from exo_gravity.lab.trial.session import Session
from exo_gravity.tools.report import main

from ..support import csv_rows
from ..support import synthetic_bags as made


@pytest.fixture(scope="module")
def held():
    return analyse(made.bag_of(made.trial(made.POSES, hold=4.0, push=made.PUSH)))


@pytest.fixture(scope="module")
def fell():
    return analyse(made.bag_of(made.trial(made.POSES, hold=6.0, fall_after=5.0)))


@pytest.fixture(scope="module")
def folder(held, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write(held, folder)
    return folder


def printed(report):
    console = Console(file=io.StringIO(), width=140)
    print_report(report, console)
    return console.file.getvalue()


def test_an_arm_that_held_is_0_and_one_that_fell_is_1(held, fell):
    assert (held.exit_code, fell.exit_code) == (0, 1)


def test_holds_csv_has_a_row_for_each_hold_and_joint_with_the_numbers_of_the_analysis(held, folder):
    ((recording, trial),) = held.arms
    found = csv_rows(folder / "holds.csv")
    assert len(found) == 4 * len(trial.holds) == 12
    for row in found:
        hold, joint = trial.holds[int(row["hold"]) - 1], recording.joint_names.index(row["joint"])
        assert float(row["pose_deg"]) == pytest.approx(math.degrees(hold.pose[joint]), rel=1e-4)
        rate = 60 * math.degrees(hold.drift_rate[joint])
        assert float(row["drift_deg_per_min"]) == pytest.approx(rate, rel=1e-4)
        assert float(row["torque_error_nm"]) == pytest.approx(hold.torque_error[joint], rel=1e-4)


def test_motions_csv_has_the_push_with_its_peak_in_degrees(folder):
    push = [row for row in csv_rows(folder / "motions.csv") if row["kind"] == "push"]
    np.testing.assert_allclose([float(row["peak_deg"]) for row in push], np.degrees(made.PUSH), atol=0.1)


@pytest.mark.usefixtures("without_pictures")
def test_an_unknown_torque_error_is_an_empty_cell_and_a_dash(held, tmp_path):
    (whole,) = held.bag.recordings
    arrays = (whole.time, whole.position, whole.velocity, whole.effort, np.full_like(whole.command, math.nan))
    report = analyse(made.bag_of(type(whole)(whole.name, whole.joint_names, *arrays, whole.steps)))
    write(report, tmp_path)
    assert {row["torque_error_nm"] for row in csv_rows(tmp_path / "holds.csv")} == {""}
    assert "–" in printed(report)


class Page(HTMLParser):
    """Collects what a page refers to, and checks that its tags are closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.references, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.references += [value for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_the_page_is_well_formed_has_a_title_and_refers_to_nothing_outside_itself(held, folder):
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    assert page.open == []
    assert len(page.references) == 2 and all(ref.startswith("data:image/png;base64,") for ref in page.references)
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "url(" not in text and f"<h1>{held.title}</h1>" in text


def test_the_pictures_in_the_page_are_the_png_files(folder):
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    embedded = [base64.b64decode(ref.partition(",")[2]) for ref in page.references]
    assert embedded == [(folder / f"right_{kind}.png").read_bytes() for kind in ("overview", "drift")]


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
    named = tuple(dataclasses.replace(recording, name=name) for name in arms)
    bag = dataclasses.replace(held.bag, path=Path(path), recordings=named)
    assert dataclasses.replace(held, bag=bag).title[:-1] == title


def test_a_figure_is_large_enough_to_print_and_not_blank(folder):
    picture = matplotlib.image.imread(folder / "right_overview.png")
    assert picture.shape[1] >= 1600 and picture[..., :3].std() > 0.05


@pytest.mark.usefixtures("without_pictures")
def test_the_page_shows_the_verdict_and_each_reason(fell, tmp_path):
    write(fell, tmp_path)
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert "It did not hold." in text and all(sentence in text for sentence in fell.failures)


@pytest.mark.usefixtures("without_pictures")
def test_text_from_a_recording_cannot_become_markup(held, tmp_path):
    texts = {"events": (Event(1.0, "<script>alert(1)</script>"),), "parameters": {"/a": "/a: <b>\n"}}
    write(analyse(made.bag_of(*held.bag.recordings, **texts, notes=("<i>",))), tmp_path)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>" not in text and "<b>\n" not in text and "&lt;script&gt;" in text
    assert "frame [01 02]" in printed(analyse(made.bag_of(*held.bag.recordings, notes=("frame [01 02]",))))


@pytest.fixture(scope="module")
def unscripted():
    """A recording of a real arm: no script, and carried throughout."""
    whole = made.trial(made.POSES, hold=4.0)
    return analyse(made.bag_of(dataclasses.replace(whole, steps=(), carried=((0.0, whole.time[-1]),))))


@pytest.mark.usefixtures("without_pictures")
def test_without_a_script_every_still_phase_is_a_hold_and_the_report_says_so(unscripted, tmp_path):
    ((_, trial),) = unscripted.arms
    assert len(trial.holds) == 2 and unscripted.exit_code == 0
    assert "right: the recording has no trial script" in " ".join(printed(unscripted).split())
    write(unscripted, tmp_path)
    assert "the recording has no trial script" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_recording_that_does_not_show_when_the_arm_was_carried_gets_a_note(held, unscripted):
    assert "its way down may be taken for a slip" in " ".join(printed(held).split())
    assert "letting it down" not in printed(unscripted)


def test_an_unfinished_trial_is_judged_up_to_its_end_and_gets_a_note(held):
    (whole,) = held.bag.recordings
    report = analyse(made.bag_of(dataclasses.replace(whole, carried=((0.0, 15.0),))))
    assert report.exit_code == 0
    assert "let down at 15.0 s, before the script ended" in " ".join(printed(report).split())


@pytest.mark.usefixtures("without_pictures")
def test_a_killed_trial_is_not_said_to_have_been_let_down(tmp_path, capsys):
    """The bag of a trial that is killed while the arm is carried, in its second hold."""
    recording = made.trial(made.POSES, hold=6.0, rate=100.0)
    types = made.STORE.types
    zero = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    pair = types["diagnostic_msgs/msg/KeyValue"](key="state", value="active")
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    entry = types["diagnostic_msgs/msg/DiagnosticStatus"](0, "right/can_bridge", "active", "", [pair])
    data = bytes(made.STORE.serialize_cdr(types[kind](types["std_msgs/msg/Header"](zero, ""), [entry]), kind))
    states = [("/diagnostics", kind, made.START + n * 5 * 10**8, data) for n in range(24)]
    content = sorted([*made.messages(recording), *states], key=lambda item: item[2])
    bag = made.write_bag(tmp_path / "killed", [item for item in content if item[2] < made.START + 12 * 10**9])
    assert main([str(bag), "--output", str(tmp_path / "out")]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "let down at" not in text and " let down " not in text.replace("how the arm was let down", "")
    assert "right: the recording ends at 12.0 s, before the script ended" in text
    assert "It held, as far as it was recorded." in text
    assert "as far as it was recorded" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "let down" not in (tmp_path / "out" / "motions.csv").read_text(encoding="utf-8")


def test_a_finished_trial_gets_no_note(held):
    (whole,) = held.bag.recordings
    assert not analyse(made.bag_of(dataclasses.replace(whole, carried=((0.0, whole.time[-1]),)))).notes


def test_the_verdict_on_a_damaged_recording_is_limited_to_the_readable_part_and_ends_with_2(held):
    damaged = analyse(made.bag_of(*held.bag.recordings, problems=("left: damaged",)))
    assert damaged.exit_code == 2
    assert "It held, as far as the recording could be read." in printed(damaged)


def test_the_table_shows_every_hold_and_the_push(held):
    text = printed(held)
    assert re.findall(r"^ +(\d) +[\d.]+ +[\d.]+ ", text, re.MULTILINE) == ["1", "2", "3"]
    assert re.search(r"push +\S+ +\S+ +2\.\d 14\.\d -8\.\d +5\.\d", text)
    assert "It held." in text


@pytest.fixture(scope="module")
def short_bag(tmp_path_factory):
    """A bag of two holds with some drift in the elbow, 6 degrees per minute."""
    drift = np.array([0.0, 0.0, 0.0, math.radians(6.0) / 60.0])
    recording = made.trial(made.POSES, hold=4.0, rate=100.0, drift=drift)
    return made.write_bag(tmp_path_factory.mktemp("bags") / "short", made.messages(recording))


def test_no_hold_is_reported_with_figures_and_1(tmp_path, capsys):
    moving = made.trial(made.POSES, hold=0.5, rate=100.0)
    bag = made.write_bag(tmp_path / "moving", made.messages(moving, script=False))
    assert main([str(bag), "--output", str(tmp_path / "out")]) == 1
    assert "never still" in capsys.readouterr().out
    assert (tmp_path / "out" / "report.html").exists() and (tmp_path / "out" / "right_overview.png").exists()


def test_the_report_is_written_next_to_its_recording_by_default(short_bag, capsys):
    assert main([str(short_bag)]) == 0
    assert sorted(path.name for path in short_bag.with_name("short_report").iterdir()) == [
        "holds.csv", "motions.csv", "report.html", "right_drift.png", "right_overview.png",
    ]  # fmt: skip


@pytest.mark.usefixtures("without_pictures")
def test_on_request_the_time_series_is_written_with_its_units(short_bag, tmp_path):
    assert main([str(short_bag), "--output", str(tmp_path), "--csv"]) == 0
    rows, (recording,) = csv_rows(tmp_path / "time_series.csv"), read_bag(short_bag).recordings
    assert len(rows) == 4 * len(recording.time)
    head = "subject arm joint time_s step action carried position_rad velocity_rad_per_s torque_nm command_nm"
    assert list(rows[0]) == head.split()
    elbow = [row for row in rows if row["joint"] == recording.joint_names[3]]
    values = (recording.time, recording.position[:, 3], recording.velocity[:, 3], recording.effort[:, 3])
    for name, expected in zip(("time_s", "position_rad", "velocity_rad_per_s", "torque_nm"), values, strict=True):
        np.testing.assert_allclose([float(row[name]) for row in elbow], expected, atol=1e-6)
    assert elbow[0]["command_nm"] == ""  # no command before the first joint state
    assert float(elbow[-1]["command_nm"]) == pytest.approx(recording.command[-1, 3], abs=1e-6)


@pytest.mark.usefixtures("without_pictures")
def test_on_request_each_figure_is_also_a_pdf_or_an_svg_with_text(short_bag, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "overview", lambda *_: labelled)
    monkeypatch.setattr(figures, "drift", lambda *_: labelled)
    labelled = Figure(figsize=(1.0, 1.0))
    labelled.text(0.5, 0.5, "Torque (Nm)")
    assert main([str(short_bag), "--output", str(tmp_path), "--figures", "pdf", "--figures", "svg"]) == 0
    for name in ("right_overview", "right_drift"):
        pdf = (tmp_path / f"{name}.pdf").read_bytes()
        assert pdf.startswith(b"%PDF") and b"/Type3" not in pdf and b"/FontFile2" in pdf
        assert ">Torque (Nm)</text>" in (tmp_path / f"{name}.svg").read_text(encoding="utf-8")


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("option", ["--max-drift=0.3", "--max-rate=5"])
def test_a_limit_on_the_command_line_is_in_degrees(short_bag, tmp_path, option, capsys):
    assert main([str(short_bag), "--output", str(tmp_path), option]) == 1
    assert "right_joint_4 " in capsys.readouterr().out


@pytest.mark.usefixtures("without_pictures")
def test_a_limit_that_is_wide_enough_holds(short_bag, tmp_path):
    assert main([str(short_bag), "--output", str(tmp_path), "--max-drift=0.5", "--max-rate=7"]) == 0


def test_a_folder_that_cannot_be_written_is_named(held, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        write(held, tmp_path / "file" / "report")


@pytest.mark.usefixtures("without_pictures")
def test_a_recording_cut_short_is_reported_and_says_so(short_bag, tmp_path, capsys):
    whole = (short_bag / "short.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    assert main([str(cut), "--output", str(tmp_path / "out")]) in (0, 1)
    assert "cut short" in " ".join(capsys.readouterr().out.split())
    assert len(csv_rows(tmp_path / "out" / "holds.csv")) >= 4


# What stands on top

COMPENSATOR = """/right/compensator:
  ros__parameters: {side: right, mode: zero_g, support: 0.3, wearer.body_mass: 75.0, wearer.sex: female}
"""
SESSION = Session("P01", "pilot", "first visit", "1.2.3")
FAULT = "right/can_bridge: letting down: over_speed: right_elbow_flexion turns too fast"


def report_of(recording, *events, **more):
    """Return the report of a recording with the compensator's parameters and the session."""
    more = {"parameters": {"/right/compensator": COMPENSATOR}, "session": SESSION, **more}
    return analyse(made.bag_of(recording, events=events, **more))


@pytest.fixture(scope="module")
def changed():
    """A trial in Zero-G that goes on in One-G from 9 s on."""
    setting = ("/right/compensator", "mode", "one_g")
    return report_of(made.trial(made.POSES, hold=6.0), Event(9.0, "/right/compensator: mode = one_g", setting))


@pytest.mark.usefixtures("without_pictures")
def test_every_row_says_of_whom_and_under_what_settings_it_is(changed, tmp_path):
    write(changed, tmp_path)
    rows = csv_rows(tmp_path / "holds.csv")
    shared = {"trial": "demo", "subject": "P01", "arm": "right", "side": "right", "support": "0.3", "version": "1.2.3"}
    assert all(row.items() >= shared.items() for row in rows)
    assert [row["mode"] for row in rows] == ["zero_g"] * 4 + ["one_g"] * 4


@pytest.mark.usefixtures("without_pictures")
def test_the_page_begins_with_verdict_subject_settings_and_criteria(changed, tmp_path):
    write(changed, tmp_path)
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    top = ("It held.", "P01", "pilot", "first visit", "Zero-G, One-G from 9.0 s", "30 %", "75 kg, female", "Criteria:")
    places = [text.index(part) for part in (*top, "1.2.3", "Arm: right")]
    assert places == sorted(places)
    assert "no joint moves more than 0.5 degrees, 2 after a push" in text


def test_a_support_that_one_g_does_not_use_is_not_shown(held):
    given = COMPENSATOR.replace("zero_g", "one_g")
    assert "right: One-G, support none in One-G" in printed(
        report_of(*held.bag.recordings, parameters={"/right/compensator": given})
    )


def fall(end, **more):
    """Return a trial of which the arm was let down at `end` s, and fell."""
    whole = made.trial(made.POSES, hold=6.0, fall_after=end)
    return dataclasses.replace(whole, carried=((0.0, end),), **more)


def test_the_report_leads_with_a_fall_and_the_fault_that_caused_it():
    report = report_of(fall(12.5), Event(12.6, FAULT))
    text, good = report.verdict
    lowest = np.abs(np.degrees(made.POSES[1])).max()  # rotates back to 0
    moved = re.search(r"joint 4 moved ([\d.]+) degrees, at up to (\d+) deg/s", text)
    assert not good and text.startswith("Right: let down at 12.5 s (over_speed: right_elbow_flexion turns too fast)")
    assert float(moved[1]) == pytest.approx(lowest, rel=0.01) and int(moved[2]) > 50
    assert text.endswith("Otherwise it held.") and report.exit_code == 0


def test_a_planned_let_down_is_not_the_worst_event():
    whole = made.trial(made.POSES, hold=6.0)
    held = dataclasses.replace(whole, carried=((0.0, whole.steps[-1].end),))
    text, good = report_of(held).verdict
    assert good and "let down" not in text
    unscripted = dataclasses.replace(fall(12.5), steps=())
    assert "let down" not in report_of(unscripted).verdict[0]
    assert "let down" in report_of(unscripted, Event(12.5, FAULT)).verdict[0]


def test_a_motion_after_a_change_of_load_names_the_change():
    setting = ("/right/compensator", "mode", "one_g")
    fell = dataclasses.replace(made.trial(made.POSES, hold=6.0), steps=())
    text, good = report_of(fell, Event(7.5, "/right/compensator: mode = one_g", setting)).verdict
    assert not good and re.match(r"Right: moved at 8.0 s after mode = one_g: joint 2 moved 22\.\d\d degrees", text)


def test_a_parameter_that_is_set_again_to_its_value_is_no_change():
    setting = ("/right/compensator", "mode", "zero_g")
    fell = dataclasses.replace(made.trial(made.POSES, hold=6.0), steps=())
    report = report_of(fell, Event(7.5, "/right/compensator: mode = zero_g", setting))
    assert "after mode" not in report.verdict[0] and "right: Zero-G, support 30 %" in printed(report)


def test_a_trial_that_ended_early_says_why(held):
    report = analyse(held.bag, trouble="stopped by the operator")
    assert report.verdict[0].startswith("It held until the trial ended early: stopped by the operator. Worst: right: ")


def test_a_trial_that_ended_before_its_first_hold_says_why_too():
    moving = made.bag_of(made.trial(made.POSES[:1], hold=0.5))
    text, good = analyse(moving, trouble="stopped by the operator").verdict
    assert not good and "It did not hold. The trial ended early: stopped by the operator." in text


def test_where_nothing_moved_the_resolution_is_stated():
    whole = made.trial(made.POSES, hold=6.0)
    codes = np.round(whole.position / made.POSITION_CODE)
    for step in whole.steps:
        within = (whole.time >= step.start) & (whole.time < step.end)
        codes[within] = codes[within][-1] if step.action == "hold" else codes[within]
    report = report_of(dataclasses.replace(whole, position=codes * made.POSITION_CODE))
    code = math.degrees(made.POSITION_CODE)
    assert f"no joint moved by one position code ({code:.3f} degrees)" in report.verdict[0]
    bound = f"<{60.0 * code / report.arms[0][1].holds[0].duration:.2f}"
    assert " ".join([bound] * 4) in printed(report)


@pytest.mark.usefixtures("without_pictures")
def test_lines_of_the_start_are_left_out_and_markers_are_listed(tmp_path):
    whole = dataclasses.replace(made.trial(made.POSES, hold=6.0), carried=((1.0, 16.0),))
    starting = [Event(0.1 * n, f"right/can_bridge: checking: waiting for {n}") for n in range(5)]
    starting += [Event(0.6, "right/can_bridge: OK, active"), Event(0.7, "imu: WARN that lasts")]
    report = report_of(whole, *starting, Event(3.0, FAULT), markers=(Event(2.0, "cramp"),))
    write(report, tmp_path)
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    listed = re.findall(r"\d\.\d s  [^\n]*", text[text.index("Markers, faults") :])
    assert "checking" not in text and "OK, active" not in text
    assert text.index("WARN that lasts") < text.index("2.0 s  marker: cramp") < text.index(f"3.0 s  {FAULT}"), listed


def test_a_trial_of_which_nothing_was_recorded_has_a_report_too(tmp_path):
    write_empty(tmp_path, "demo", "stopped by the operator")
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert "demo" in text and "Nothing was recorded: stopped by the operator." in text
