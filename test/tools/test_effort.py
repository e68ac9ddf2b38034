"""trial effort: what it prints and writes, offline and on nodes."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import yaml
from rich.console import Console

from exo_gravity.core.compensation.params import COMPENSATOR, settings_of
from exo_gravity.core.effort import Effort
from exo_gravity.core.params import values_of
from exo_gravity.sim.effort_study import TASKS
from exo_gravity.tools import trial
from exo_gravity.tools.inputs.parameter_file import load, packaged_config
from exo_gravity.tools.trials import effort, simulated_effort
from exo_gravity.tools.trials.run import TrialEnd
from exo_gravity.tools.trials.simulated_effort import EffortStudy

from ..support.ports import own_ports

SETTINGS = ("nothing", "One-G", "Zero-G 100 %")
SIMULATED = packaged_config("sim.yaml")
PORTS = own_ports(30_400)


def rows():
    for n, setting in enumerate(SETTINGS):
        for task in TASKS:
            felt = (0.3, 0.2, 0.01) if task.name.startswith("sweep") else None
            yield setting, task.name, Effort(np.full(4, 4.0 - n), np.full(4, 8.0 - n), 1.5, 60.0, felt, 5.0 - n)


def test_it_prints_what_each_setting_saves_and_writes_tables_a_figure_and_a_page(monkeypatch, tmp_path):
    monkeypatch.setattr(EffortStudy, "offline", lambda study: (len(SETTINGS) * len(TASKS), rows()))
    console = Console(record=True, width=200)
    assert effort.run(SIMULATED, tmp_path, offline=True, quick=False, console=console) == 0
    text = console.export_text()
    assert "Zero-G 100 %" in text and "50 %" in text and "0.300 / 0.20" in text
    assert "ARMin" in text and "One-G saves 25 %, Zero-G 50 %" in text
    assert "CyberForce" in text and "Zero-G 3.00 Nm, One-G 4.00 Nm: the same order" in text
    (folder,) = tmp_path.glob("effort_*")
    with (folder / "effort.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(SETTINGS) * len(TASKS)
    assert written[0]["rms_elbow_nm"] == "4.0" and written[2]["inertia_kg_m2"] == "0.3"
    page = (folder / "report.html").read_text()
    assert page.count("<table>") == 4 and "data:image/png;base64" in page and "0.300 / 0.20" in page
    assert (folder / "effort.png").stat().st_size > 10_000


def test_the_study_of_the_packaged_file_has_every_setting_and_a_wearer():
    count, study = EffortStudy.of(SIMULATED, 75.0, quick=False).offline()
    assert count == 14 * len(TASKS)
    setting, task, first = next(study)
    assert (setting, task) == ("nothing", "poses")
    assert first.total > 5.0  # the weight of the arm of 75 kg


def test_each_setting_becomes_the_parameters_of_a_compensator_with_the_same_settings(tmp_path):
    study = EffortStudy.of(SIMULATED, 75.0, quick=False)
    for name, settings in study.settings.items():
        entry = study.parameters(name, tmp_path / "truth.bin")["/right/compensator"]
        (tmp_path / "params.yaml").write_text(yaml.safe_dump({"/right/compensator": entry}))
        given = settings_of(values_of(COMPENSATOR, load(tmp_path / "params.yaml")["/right/compensator"]))
        if settings is None:
            assert not given.arm.gain.any()
            continue
        assert given.terms == settings.terms and (given.mode, given.support) == (settings.mode, settings.support)
        np.testing.assert_allclose(given.arm.mass, settings.arm.mass)


def test_a_weak_arm_reaches_more_of_the_workspace_with_more_support():
    study = EffortStudy.of(SIMULATED, 75.0, quick=False)
    reached = {(name, share): value for name, share, value in study.workspaces()}
    order = ("nothing", "One-G", "Zero-G 25 %", "Zero-G 50 %", "Zero-G 75 %", "Zero-G 100 %")
    for share in (0.25, 0.35, 0.5):
        shares = [reached[name, share] for name in order]
        assert shares == sorted(shares) and shares[-1] > 0.9 > 0.1 > shares[1]
        assert reached["Zero-G 0 %", share] == reached["One-G", share]


def test_a_study_on_a_busy_computer_ends_with_exit_code_3_and_what_it_has(monkeypatch, tmp_path):
    outcomes = [TrialEnd("", 0, ""), TrialEnd("let down", 1, "simulator was not run for 90 ms")]
    monkeypatch.setattr(effort, "run_attempts", lambda *arguments: outcomes.pop(0))
    console = Console(record=True, width=200)
    assert effort.run(SIMULATED, tmp_path, offline=False, quick=True, console=console) == 3
    text = console.export_text()
    assert "setting 2 of 4: One-G" in text and "One-G: this computer was too busy: simulator was not run" in text


@pytest.mark.real_time
def test_on_nodes_the_effort_of_a_reach_is_that_of_the_offline_study(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(simulated_effort, "QUICK_SETTINGS", ("Zero-G 100 %",))
    content = yaml.safe_load(SIMULATED.read_text())
    port = next(PORTS)
    for entry in content.values():
        if "can" in entry["ros__parameters"]:
            entry["ros__parameters"]["can"]["options"]["port"] = port
    params = tmp_path / "sim.yaml"
    params.write_text(yaml.safe_dump(content))
    assert trial.main(["effort", "--quick", "--params", str(params), "--output", str(tmp_path)]) == 0
    (folder,) = tmp_path.glob("effort_*")
    with (folder / "effort.csv").open() as file:
        (live,) = csv.DictReader(file)
    ((_, _, offline),) = EffortStudy.of(SIMULATED, 75.0, quick=True).offline()[1]
    found = [float(live[f"rms_{joint}_nm"]) for joint in ("rotation", "abduction", "flexion", "elbow")]
    np.testing.assert_allclose(found, offline.rms, rtol=0.1)
    assert not list(folder.glob("*/truth.bin")) and (folder / "01" / "bag").is_dir()


@pytest.mark.parametrize("arguments", [["--offline"], []])
def test_without_a_simulator_it_is_refused(tmp_path, capsys, arguments):
    params = str(packaged_config("exo.yaml"))
    assert trial.main(["effort", *arguments, "--params", params, "--output", str(tmp_path)]) == 2
    assert "a file with a simulator" in capsys.readouterr().err and not list(tmp_path.iterdir())
