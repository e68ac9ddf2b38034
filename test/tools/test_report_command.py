"""The command `report`: files, exit codes, limits on the command line, missing extras."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from exo_gravity.bag.reader import read_bag
from exo_gravity.core.errors import DataError
from exo_gravity.tools.report import main
from exo_gravity.tools.reporting.trial_report import analyse, write

from ..support import csv_rows
from ..support import synthetic_bags as made


@pytest.fixture(scope="module")
def short_bag(tmp_path_factory):
    """A bag of two holds with some drift in the elbow, 6 degrees per minute."""
    drift = np.array([0.0, 0.0, 0.0, math.radians(6.0) / 60.0])
    recording = made.trial(made.POSES, hold=4.0, rate=100.0, drift=drift)
    return made.write_bag(tmp_path_factory.mktemp("bags") / "short", made.messages(recording))


@pytest.mark.parametrize("option", ["--max-drift", "--max-drift-after-push", "--max-rate", "--min-hold"])
@pytest.mark.parametrize("value", ["nan", "-1", "half"])
def test_a_limit_that_is_not_a_number_of_0_or_more_is_refused(short_bag, capsys, option, value):
    with pytest.raises(SystemExit) as caught:
        main([str(short_bag), f"{option}={value}"])
    assert caught.value.code == 2
    assert f"argument {option}: {value}: must be a number, 0 or more" in capsys.readouterr().err


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


@pytest.mark.parametrize("option", ["--max-drift=0.3", "--max-rate=5"])
def test_a_limit_on_the_command_line_is_in_degrees(short_bag, tmp_path, option, capsys):
    assert main([str(short_bag), "--output", str(tmp_path), option]) == 1
    assert "right_joint_4 " in capsys.readouterr().out


def test_a_limit_that_is_wide_enough_holds(short_bag, tmp_path):
    assert main([str(short_bag), "--output", str(tmp_path), "--max-drift=0.5", "--max-rate=7"]) == 0


def test_a_wrong_file_is_2_and_one_sentence(tmp_path, capsys):
    assert main([str(tmp_path / "nothing")]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and "nothing: no such file" in captured.err


def test_a_folder_that_cannot_be_written_is_named(held, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        write(held, tmp_path / "file" / "report")


def test_a_recording_cut_short_is_reported_and_says_so(short_bag, tmp_path, capsys):
    whole = (short_bag / "short.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    assert main([str(cut), "--output", str(tmp_path / "out")]) in (0, 1)
    assert "cut short" in " ".join(capsys.readouterr().out.split())
    assert len(csv_rows(tmp_path / "out" / "holds.csv")) >= 4


def test_the_holds_of_a_bag_are_those_of_its_arrays(short_bag):
    ((_, trial),) = analyse(read_bag(short_bag)).arms
    assert len(trial.holds) == 2
    np.testing.assert_allclose([hold.pose[:3] for hold in trial.holds], np.array(made.POSES)[:, :3], atol=1e-3)


def test_without_matplotlib_the_report_is_written_without_figures_and_says_so(short_bag, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main([str(short_bag), "--output", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"holds.csv", "motions.csv", "report.html"}
    assert "matplotlib is not installed" in " ".join(capsys.readouterr().out.split())


def test_without_the_bag_library_the_missing_extra_is_named_and_help_still_works(short_bag, capsys, monkeypatch):
    for module in ("exo_gravity.bag.reader", "exo_gravity.bag.storage"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, "rosbags.serde", None)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(SystemExit) as ended:
        main([str(short_bag)])
    assert ended.value.code == 2
    expected = "report: the Python package rosbags is not installed: pip install 'exo_gravity[report]'\n"
    assert capsys.readouterr().err == expected
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
