"""trial effort: what it prints and writes."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from rich.console import Console

from exo_gravity.core.effort import Effort
from exo_gravity.sim.effort_study import TASKS
from exo_gravity.tools import trial
from exo_gravity.tools.inputs.parameter_file import packaged_config
from exo_gravity.tools.trials import effort, simulated_effort

SETTINGS = ("nothing", "One-G", "Zero-G 100 %")


def rows():
    for n, setting in enumerate(SETTINGS):
        for task in TASKS:
            felt = (0.3, 0.2, 0.01) if task.name.startswith("sweep") else None
            yield setting, task.name, Effort(np.full(4, 4.0 - n), np.full(4, 8.0 - n), 1.5, 60.0, felt)


@pytest.fixture
def results(monkeypatch):
    monkeypatch.setattr(
        simulated_effort, "effort_study", lambda params, body_mass: (len(SETTINGS) * len(TASKS), rows())
    )


def test_it_prints_what_each_setting_saves_and_writes_a_table_and_a_figure(results, tmp_path):
    console = Console(record=True, width=200)
    assert effort.run(packaged_config("sim.yaml"), tmp_path, True, console) == 0
    text = console.export_text()
    assert "Zero-G 100 %" in text and "50 %" in text and "0.300 / 0.20" in text
    (folder,) = tmp_path.glob("effort_*")
    assert (folder / "effort.png").stat().st_size > 10_000
    with (folder / "effort.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(SETTINGS) * len(TASKS)
    assert written[0]["rms_elbow_nm"] == "4.0" and written[2]["inertia_kg_m2"] == "0.3"


def test_the_study_of_the_packaged_file_has_every_setting_and_a_wearer():
    count, study = simulated_effort.effort_study(packaged_config("sim.yaml"), 75.0)
    assert count == 14 * len(TASKS)
    setting, task, first = next(study)
    assert (setting, task) == ("nothing", "poses")
    assert first.total > 5.0  # the weight of the arm of 75 kg


def test_without_offline_and_without_a_simulator_it_is_refused(tmp_path, capsys):
    assert trial.main(["effort", "--output", str(tmp_path)]) == 2
    assert "--offline" in capsys.readouterr().err
    params = str(packaged_config("exo.yaml"))
    assert trial.main(["effort", "--offline", "--params", params, "--output", str(tmp_path)]) == 2
    assert "a file with a simulator" in capsys.readouterr().err
