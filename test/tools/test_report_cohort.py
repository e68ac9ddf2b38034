"""`report` of many recordings: a row for each, one that fails is named, one that has not changed is not read again."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict

import numpy as np
import pytest

from exo_gravity.lab.report import cohort
from exo_gravity.lab.trial.analysis import HoldCriteria
from exo_gravity.lab.trial.session import Session
from exo_gravity.tools.report import main

from ..support import csv_rows
from ..support import synthetic_bags as made

DRIFTS = (1.0, 2.0, 3.0)  # deg/min of the elbow


@pytest.fixture
def trials(tmp_path):
    """A folder of three trials of one subject, one that is no recording, and one that is cut."""
    folder = tmp_path / "trials"
    session = made.text_entry("/recorder/session", 0.0, json.dumps(asdict(Session("P01"))))
    for number, drift in enumerate(DRIFTS):
        rates = np.radians([0.0, 0.0, 0.0, drift]) / 60.0
        recording = made.trial(made.POSES, hold=4.0, rate=50.0, drift=rates)
        made.write_bag(folder / f"day_{number}" / "bag", [session, *made.messages(recording)])
    cut = folder / "cut" / "bag"
    made.write_bag(cut, made.messages(recording))
    (cut / "metadata.yaml").unlink()
    made.cut(cut / "bag.mcap", 0.6)
    (folder / "damaged").mkdir()
    (folder / "damaged" / "text.mcap").write_text("no recording")
    return folder


def test_a_folder_becomes_one_table_and_what_fails_is_named(trials, tmp_path, capsys):
    assert main([str(trials), "--output", str(tmp_path / "out")]) == 2
    text = " ".join(capsys.readouterr().out.split())
    assert "Not reported: " in text and "text.mcap: not an MCAP file" in text
    assert "5 trials held; 1 recordings failed; 0 had not changed" in text
    trend = re.search(r"P01, right, unknown mode: drift changes by (\S+) deg/min from one of 3 trials", text)
    assert float(trend[1]) == pytest.approx(1.0, abs=0.4)
    rows = csv_rows(tmp_path / "out" / "cohort.csv")
    assert len(rows) == 4 * len(made.NAMES) + 1
    elbow = [float(row["drift_deg_per_min"]) for row in rows if row["joint"] == made.NAMES[3] and row["subject"]]
    np.testing.assert_allclose(elbow, DRIFTS, atol=0.6)
    moved = np.degrees(np.ptp(np.vstack((np.zeros(4), made.POSES)), axis=0))
    first = [float(row["range_of_motion_deg"]) for row in rows if "day_0" in row["recording"]]
    np.testing.assert_allclose(first, moved, atol=0.5)
    # Of whom nothing has changed nothing is read: its own summary would not be there.
    assert main([str(trials), "--output", str(tmp_path / "out")]) == 2
    assert "4 had not changed" in capsys.readouterr().out
    assert csv_rows(tmp_path / "out" / "cohort.csv") == rows


def test_a_recording_is_read_again_where_its_content_or_the_criteria_change(trials, tmp_path):
    bag, path = trials / "day_0" / "bag", tmp_path / "cache.json"
    cache = cohort.Cache(path, HoldCriteria(), 2.0)
    key = cache.key(bag)
    cache.put(key, [{"recording": "elsewhere", "verdict": "It held."}])
    cache.save()
    assert cohort.Cache(path, HoldCriteria(), 2.0).get(key, bag) == [{"recording": str(bag), "verdict": "It held."}]
    assert cohort.Cache(path, HoldCriteria(), 3.0).key(bag) != key
    file = bag / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    assert cache.key(bag) != key
    path.write_text("damaged")
    assert cohort.Cache(path, HoldCriteria(), 2.0).get(key, bag) is None


def test_a_move_along_a_bell_of_speed_is_smooth():
    rows = cohort.summary(str(made.START), HoldCriteria(), 2.0)
    assert rows[0]["problem"] and rows[0]["verdict"] is None
    recording = made.trial(made.POSES, hold=3.0, rate=200.0)
    from exo_gravity.lab.trial.analysis import analyse

    assert -1.8 < cohort.smoothness(recording, analyse(recording)) < -1.3
    assert math.isnan(cohort.smoothness(recording, analyse(made.measured(made.still(made.POSES[0], 5.0)))))
