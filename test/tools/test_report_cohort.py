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

from ..support import csv_rows
from ..support import synthetic_bags as made

DRIFTS = (1.0, 2.0, 3.0)  # deg/min of the elbow
DAY = 86_400 * 10**9  # ns
JUDGING = cohort.Judging(HoldCriteria(), 2.0, 1)


def drifting(per_minute):
    """Return the recording of an arm whose elbow drifts by degrees per minute."""
    return made.trial(made.POSES, hold=4.0, rate=50.0, drift=np.radians([0.0, 0.0, 0.0, per_minute]) / 60.0)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder of three trials of one subject, a day each, one that is no recording, and one that is cut."""
    folder, session = tmp_path_factory.mktemp("written") / "trials", json.dumps(asdict(Session("P01")))
    for number, drift in enumerate(DRIFTS):
        with pytest.MonkeyPatch.context() as day:
            day.setattr(made, "START", made.START + number * DAY)
            content = [made.text_entry("/recorder/session", 0.0, session), *made.messages(drifting(drift))]
            made.write_bag(folder / f"day_{number}" / "bag", content)
    cut = made.write_bag(folder / "cut" / "bag", made.messages(drifting(3.0)))
    (cut / "metadata.yaml").unlink()
    made.cut(cut / "bag.mcap", 0.6)
    (folder / "damaged").mkdir()
    (folder / "damaged" / "text.mcap").write_text("no recording")
    return folder


@pytest.fixture
def trials(written, tmp_path):
    """A copy of it."""
    return shutil.copytree(written, tmp_path / "trials")


def test_a_folder_becomes_one_table_and_page_and_what_fails_is_named(trials, tmp_path, run_tool):
    ended, out = run_tool("report", trials, "--output", tmp_path / "out"), tmp_path / "out"
    text, page = " ".join(ended.out.split()), (out / "cohort.html").read_text(encoding="utf-8")
    assert ended.code == 2 and "Not reported: " in text and "text.mcap: not an MCAP file" in text
    assert "4 of 4 trials held; recordings not read, or not completely: 1; 0 recordings had not changed" in text
    changes = r"P01, right, unknown mode: change from one of 3 sessions to the next: drift (\S+) ± \S+ deg"
    trend = re.search(changes, text)
    assert float(trend[1]) == pytest.approx(1.0, abs=0.4)
    assert "text.mcap: not an MCAP file" in page and trend[0] in page and page.count("<img ") == 1
    rows = csv_rows(out / "cohort.csv")
    assert len(rows) == 4 * len(made.NAMES) + 1
    elbow = [float(row["drift_deg_per_min"]) for row in rows if row["joint"] == made.NAMES[3] and row["subject"]]
    np.testing.assert_allclose(elbow, DRIFTS, atol=0.6)
    moved = np.degrees(np.ptp(np.vstack((np.zeros(4), made.POSES)), axis=0))
    first = [float(row["range_of_motion_deg"]) for row in rows if "day_0" in row["recording"]]
    np.testing.assert_allclose(first, moved, atol=0.5)
    # Of whom nothing has changed nothing is read: its own summary would not be there. Named twice, it is one trial.
    again = run_tool("report", trials, f"{trials}/.", "--output", out)
    assert again.code == 2 and "4 recordings had not changed" in again.out
    assert csv_rows(out / "cohort.csv") == rows


def test_a_recording_is_read_again_where_its_content_or_the_criteria_change(trials, tmp_path):
    bag, path, rows = trials / "day_0" / "bag", tmp_path / "cache.jsonl", [{"arm": "right", "verdict": "It held."}]
    cache = cohort.Cache(path, JUDGING)
    key = cache.key(bag)
    cache.put(key, rows)
    with path.open("a") as stream:
        stream.write('["cut')
    assert cohort.Cache(path, JUDGING).get(key) == rows
    assert cohort.Cache(path, replace(JUDGING, min_hold=3.0)).key(bag) != key
    data = bytearray((bag / "bag.mcap").read_bytes())
    data[len(data) // 2] ^= 1
    (bag / "bag.mcap").write_bytes(data)
    assert cache.key(bag) != key


def test_a_copy_that_was_repaired_is_not_a_second_trial(trials):
    before = cohort.recordings_below(trials)
    copy, _ = repair(trials / "cut" / "bag")
    assert cohort.recordings_below(trials) == before and cohort.recordings_below(copy) == [copy]


@pytest.mark.thorough
def test_when_a_worker_of_a_cluster_is_killed_no_recording_is_lost_and_none_is_there_twice(trials, tmp_path):
    from distributed import Client, LocalCluster  # a second of imports, which no other test needs

    for number in range(8):
        made.write_bag(trials / f"more_{number}" / "bag", made.messages(drifting(number)))
    recordings = cohort.recordings_below(trials)
    expected = [row for recording in recordings for row in cohort.summary(str(recording), JUDGING)]
    workers = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(host="127.0.0.1", **workers) as cluster, Client(cluster) as client:
        running = sorted(client.run(os.getpid).values())

        def done():
            if running:  # the first recording is finished
                os.kill(running.pop(), signal.SIGKILL)
                running.clear()

        run, cache = partial(on_cluster, cluster.scheduler_address), cohort.Cache(tmp_path / "cache.jsonl", JUDGING)
        assert cohort.summaries(recordings, JUDGING, cache, run, done) == (expected, 0)


def test_a_scheduler_that_does_not_answer_is_one_line(trials, monkeypatch, run_tool):
    monkeypatch.setattr("exo_gravity.lab.parallel.CONNECT", "0.1s")
    ended = run_tool("report", trials, "--scheduler", "tcp://127.0.0.1:9")
    (line,) = ended.err.splitlines()
    assert ended.code == 2 and line.startswith("report: ") and "127.0.0.1:9" in line


def test_a_move_along_a_bell_of_speed_is_smooth():
    recording = made.trial(made.POSES, hold=3.0, rate=200.0)
    assert -1.8 < cohort.smoothness(recording, analyse(recording)) < -1.3
    assert math.isnan(cohort.smoothness(recording, analyse(made.measured(made.still(made.POSES[0], 5.0)))))
