"""One trial from start to report.

A trial on the simulated device that fails because this computer was too busy is repeated: nothing is worn, and every
attempt starts all nodes anew. A trial on a real arm is never repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rich.console import Console

from exo_gravity.bag.content import Bag
from exo_gravity.bag.reader import read_bag
from exo_gravity.core.errors import DataError
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.tools.cli import extras
from exo_gravity.tools.launcher import Stopping, stop_on_signals
from exo_gravity.tools.reporting import trial_report
from exo_gravity.tools.trials.busy import ADVICE
from exo_gravity.tools.trials.criteria import criteria_for, missing_holds, shortest_hold
from exo_gravity.tools.trials.real_time import Outcome, run_nodes
from exo_gravity.tools.trials.scripts import is_guided, prepare, read_script
from exo_gravity.tools.video import rendered
from exo_gravity.tools.video.output import Clip, select_backend

ATTEMPTS = 3
BUSY_CODE = 3


@dataclass(frozen=True)
class Session:
    """What the command line requests.

    params: the parameter file. max_rate: deg/min, None for the default. clip: to write after the trial, or None.
    """

    name: str
    params: Path
    output: Path
    offline: bool
    max_rate: float | None
    clip: Clip | None = None


def run(session: Session, console: Console) -> int:
    """Run and report a trial; return the exit code. Raises ExoGravityError."""
    path, script = read_script(session.name)
    stopped = stop_on_signals()
    if session.offline:
        if session.clip:
            select_backend()  # before the simulated device imports MuJoCo
        folder, bag, outcome = _run_offline(session, path, script, console, stopped)
    else:
        folder, bag, outcome = _run_in_real_time(session, path, script, console, stopped)
    trouble, code = outcome.trouble, outcome.code
    if bag is not None:
        guided = is_guided(session.params)
        criteria = criteria_for(script, session.max_rate)
        report = trial_report.analyse(bag, criteria, shortest_hold(script, guided))
        if guided and not trouble:
            trouble = missing_holds(script, report)
            code = int(bool(trouble))
        trial_report.write(report, folder)
        trial_report.print_report(report)
        code = code or report.exit_code
        if session.clip:
            rendered.write(bag, session.clip, console)
    contents = "Report and parameters" if session.offline else "Report, recording, log and parameters"
    console.print(f"{contents}: {folder}", markup=False, soft_wrap=True)
    if outcome.trouble and outcome.busy and code != 2:
        trouble, code = f"this computer was too busy: {outcome.busy}. {ADVICE}", BUSY_CODE
    if trouble:
        console.print(f"trial: {trouble}", markup=False, soft_wrap=True)
    return code


def _new_folder(session: Session, script: TrialScript) -> Path:
    return session.output.resolve() / f"{script.name}_{datetime.now():%Y%m%d_%H%M%S}"


def _run_offline(
    session: Session, path: Path, script: TrialScript, console: Console, stopped: Stopping
) -> tuple[Path, Bag | None, Outcome]:
    with extras("trial", "sim"):
        from exo_gravity.tools.trials.offline import run_offline, simulated_trials

    trials = simulated_trials(session.params, script)
    folder = _new_folder(session, script)
    params = prepare(session.params, path, folder, recorded=False)
    bag, trouble = run_offline(trials, params, console, stopped.is_set)
    return folder, bag, Outcome(trouble, int(bool(trouble)), "")


def _run_in_real_time(
    session: Session, path: Path, script: TrialScript, console: Console, stopped: Stopping
) -> tuple[Path, Bag | None, Outcome]:
    folder = _new_folder(session, script)
    outcome = run_attempts(session.params, path, script, folder, console, stopped)
    try:
        return folder, read_bag(folder / "bag"), outcome
    except DataError:
        if not outcome.trouble:
            raise
        return folder, None, outcome


def run_attempts(
    params: Path, path: Path, script: TrialScript, folder: Path, console: Console, stopped: Stopping
) -> Outcome:
    """Run `script`, the file at `path`, on nodes in the new `folder`; repeat it if this computer was too busy."""
    for attempt in range(1, ATTEMPTS + 1):
        trial = prepare(params, path, folder, recorded=True)
        outcome = run_nodes(trial, script, folder, console, stopped)
        if not (outcome.trouble and outcome.busy) or outcome.code == 2 or stopped.is_set() or attempt == ATTEMPTS:
            break
        folder.rename(f"{folder}_attempt_{attempt}")
        again = f"attempt {attempt + 1} of {ATTEMPTS}"
        console.print(f"this computer was too busy: {outcome.busy}; {again}", markup=False, soft_wrap=True)
    return outcome
