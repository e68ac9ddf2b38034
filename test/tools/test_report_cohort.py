# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`report` of many recordings: a row for each, one that fails is named, one that has not changed is not read again."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pytest

from exo_gravity.lab.bag.writer import repair
from exo_gravity.lab.parallel import on_cluster
from exo_gravity.lab.report import cohort
from exo_gravity.lab.trial.analysis import HoldCriteria, analyse
from exo_gravity.lab.trial.session import Session
from exo_gravity.tools.report import main

from ..support import csv_rows
from ..support import synthetic_bags as made

DRIFTS = (1.0, 2.0, 3.0)  # deg/min of the elbow
DAY = 86_400 * 10**9  # ns
JUDGING = cohort.Judging(HoldCriteria(), 2.0, 1)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder of three trials of one subject, a day each, one that is no recording, and one that is cut."""
    folder, monkeypatch = tmp_path_factory.mktemp("written") / "trials", pytest.MonkeyPatch()
    for number, drift in enumerate(DRIFTS):
        with monkeypatch.context() as day:
            day.setattr(made, "START", made.START + number * DAY)
            session = made.text_entry("/recorder/session", 0.0, json.dumps(asdict(Session("P01"))))
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


@pytest.fixture
def trials(written, tmp_path):
    """A copy of it."""
    return shutil.copytree(written, tmp_path / "trials")


def test_a_folder_becomes_one_table_and_page_and_what_fails_is_named(trials, tmp_path, capsys):
    assert main([str(trials), "--output", str(tmp_path / "out")]) == 2
    text = " ".join(capsys.readouterr().out.split())
    assert "Not reported: " in text and "text.mcap: not an MCAP file" in text
    assert "4 of 4 trials held; recordings not read, or not completely: 1; 0 recordings had not changed" in text
    trend = re.search(
        r"P01, right, unknown mode: change from one of 3 sessions to the next: drift (\S+) ± \S+ deg", text
    )
    assert float(trend[1]) == pytest.approx(1.0, abs=0.4)
    page = (tmp_path / "out" / "cohort.html").read_text(encoding="utf-8")
    assert "text.mcap: not an MCAP file" in page and trend[0] in page and page.count("<img ") == 1
    rows = csv_rows(tmp_path / "out" / "cohort.csv")
    assert len(rows) == 4 * len(made.NAMES) + 1
    elbow = [float(row["drift_deg_per_min"]) for row in rows if row["joint"] == made.NAMES[3] and row["subject"]]
    np.testing.assert_allclose(elbow, DRIFTS, atol=0.6)
    moved = np.degrees(np.ptp(np.vstack((np.zeros(4), made.POSES)), axis=0))
    first = [float(row["range_of_motion_deg"]) for row in rows if "day_0" in row["recording"]]
    np.testing.assert_allclose(first, moved, atol=0.5)
    # Of whom nothing has changed nothing is read: its own summary would not be there. Named twice, it is one trial.
    assert main([str(trials), f"{trials}/.", "--output", str(tmp_path / "out")]) == 2
    assert "4 recordings had not changed" in capsys.readouterr().out
    assert csv_rows(tmp_path / "out" / "cohort.csv") == rows


def test_a_recording_is_read_again_where_its_content_or_the_criteria_change(trials, tmp_path):
    bag, path, rows = trials / "day_0" / "bag", tmp_path / "cache.jsonl", [{"arm": "right", "verdict": "It held."}]
    cache = cohort.Cache(path, JUDGING)
    key = cache.key(bag)
    cache.put(key, rows)
    assert cohort.Cache(path, JUDGING).get(key) == rows
    assert cohort.Cache(path, replace(JUDGING, min_hold=3.0)).key(bag) != key
    file = bag / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    assert cache.key(bag) != key
    with path.open("a") as stream:
        stream.write('["cut')
    assert cohort.Cache(path, JUDGING).get(key) == rows


def test_a_copy_that_was_repaired_is_not_a_second_trial(trials):
    before = cohort.recordings_below(trials)
    copy, _ = repair(trials / "cut" / "bag")
    assert cohort.recordings_below(trials) == before and cohort.recordings_below(copy) == [copy]


@pytest.mark.thorough
def test_when_a_worker_of_a_cluster_is_killed_no_recording_is_lost_and_none_is_there_twice(trials, tmp_path):
    from distributed import Client, LocalCluster  # a second of imports, which no other test needs

    bags = []
    for number in range(8):
        recording = made.trial(made.POSES, hold=4.0, rate=50.0, drift=math.radians(number) / 60.0)
        bags.append(made.write_bag(trials / f"more_{number}" / "bag", made.messages(recording)))
    recordings = cohort.recordings_below(trials)
    assert {*bags} < {*recordings}
    expected = [row for recording in recordings for row in cohort.summary(str(recording), JUDGING)]
    workers = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(host="127.0.0.1", **workers) as cluster, Client(cluster) as client:
        running = sorted(client.run(os.getpid).values())

        def done():
            if running:  # the first recording is finished
                os.kill(running.pop(), signal.SIGKILL)
                running.clear()

        run, cache = partial(on_cluster, cluster.scheduler_address), cohort.Cache(tmp_path / "cache.jsonl", JUDGING)
        rows, known = cohort.summaries(recordings, JUDGING, cache, run, done)
    assert rows == expected and known == 0


def test_a_scheduler_that_does_not_answer_is_one_line(trials, monkeypatch, capsys):
    monkeypatch.setattr("exo_gravity.lab.parallel.CONNECT", "0.1s")
    assert main([str(trials), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("report: ") and "127.0.0.1:9" in line
    assert main([str(trials), "--scheduler", "my cluster"]) == 2
    assert "scheduler = 'my cluster': must be an address" in capsys.readouterr().err


def test_a_move_along_a_bell_of_speed_is_smooth():
    rows = cohort.summary(str(made.START), JUDGING)
    assert rows[0]["problem"] and rows[0]["verdict"] is None
    recording = made.trial(made.POSES, hold=3.0, rate=200.0)
    assert -1.8 < cohort.smoothness(recording, analyse(recording)) < -1.3
    assert math.isnan(cohort.smoothness(recording, analyse(made.measured(made.still(made.POSES[0], 5.0)))))
