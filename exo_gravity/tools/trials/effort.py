"""trial effort: how hard the arm is to move, under every setting of the compensator.

A virtual wearer moves the simulated arm through 13 poses, a reach task and a sine sweep of each joint: on nodes that
are started anew for each setting, or with --offline without ROS and faster. Tables, a figure, CSV files and an HTML
page show the effort of each setting.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import yaml
from rich.console import Console
from rich.progress import track

from exo_gravity.core.trial.script import TrialScript
from exo_gravity.tools.cli import extras, require_ros
from exo_gravity.tools.launcher import stop_on_signals
from exo_gravity.tools.reporting import effort_table
from exo_gravity.tools.reporting.effort_page import write_page
from exo_gravity.tools.reporting.effort_table import EffortResults
from exo_gravity.tools.trials.run import ADVICE, BUSY_CODE, run_attempts

with extras("trial", "sim"):
    from exo_gravity.tools.trials.simulated_effort import EffortStudy

NAME = "effort"
BODY_MASS = 75.0  # kg, of a wearer that the parameter file does not give


def run(params: Path, output: Path, offline: bool, quick: bool, console: Console) -> int:
    """Run the study and write its results; return the exit code. Raises ParameterError."""
    study = EffortStudy.of(params, BODY_MASS, quick)
    if not offline:
        require_ros("trial")
    when = datetime.now()
    folder = output.resolve() / f"{NAME}_{when:%Y%m%d_%H%M%S}"
    folder.mkdir(parents=True)
    results = EffortResults({}, {})
    for setting, share, reached in study.workspaces():
        results.workspaces[setting, share] = reached
    trouble, code = "", 0
    if offline:
        _offline(study, results, console)
    else:
        trouble, code = _on_nodes(study, results, folder, console)
    if results.efforts:
        how = "simulated offline" if offline else "on nodes, from the simulated arm's true motion"
        _write(results, folder, when, how, console)
    if trouble:
        console.print(f"trial: {trouble}", markup=False, soft_wrap=True)
    return code


def _offline(study: EffortStudy, results: EffortResults, console: Console) -> None:
    """Add the efforts of all settings."""
    count, rows = study.offline()
    quiet = not console.is_terminal
    for setting, task, effort in track(rows, "effort", count, console=console, transient=True, disable=quiet):
        results.efforts[setting, task] = effort


def _on_nodes(study: EffortStudy, results: EffortResults, folder: Path, console: Console) -> tuple[str, int]:
    """Run the nodes once for each setting, and add its efforts; return why it ended early, or '', and the exit code."""
    stopped = stop_on_signals()
    path, script = folder / "script.yaml", TrialScript.parse(study.script)
    path.write_text(yaml.safe_dump(study.script, default_flow_style=None, width=120), encoding="utf-8")
    minutes = len(study.settings) * (script.duration + 10.0) / 60.0
    console.print(f"{len(study.settings)} settings, about {minutes:.0f} minutes")
    for number, setting in enumerate(study.settings, start=1):
        console.print(f"setting {number} of {len(study.settings)}: {setting}", markup=False)
        run_folder = folder / f"{number:02d}"
        truth, params = run_folder / "truth.bin", folder / f"{number:02d}.yaml"
        params.write_text(yaml.safe_dump(study.parameters(setting, truth), width=120), encoding="utf-8")
        outcome = run_attempts(params, path, script, run_folder, console, stopped)
        found = study.efforts(truth) if truth.exists() else {}
        truth.unlink(missing_ok=True)  # 8 MB a minute
        results.efforts.update({(setting, task): effort for task, effort in found.items()})
        if outcome.trouble:
            busy = outcome.busy and outcome.code != 2
            why = f"this computer was too busy: {outcome.busy}. {ADVICE}" if busy else outcome.trouble
            return f"{setting}: {why}", BUSY_CODE if busy else outcome.code
    return "", 0


def _write(results: EffortResults, folder: Path, when: datetime, how: str, console: Console) -> None:
    for content in effort_table.contents(results):
        console.print(effort_table.rich_table(content))
    for sentence in effort_table.comparisons(results):
        console.print(sentence, markup=False, soft_wrap=True)
    effort_table.write_csv(results, folder)
    write_page(results, folder, when, how)
    console.print(f"Tables, figure and report.html: {folder}", markup=False, soft_wrap=True)
