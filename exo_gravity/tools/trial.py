"""trial NAME: runs a trial from start to report, on the simulated device or on a real arm.

It starts the nodes of a parameter file and a recorder, follows the script, stops the nodes, and reports the recording.
The folder of the trial holds the parameters, the recording, the nodes' log and the report. Ctrl-C, a fault or the end
of the recorder lets the arm down, and the trial reports what was recorded until then.

With --attach it starts the recorder alone, for arms that are carried already: the operator's panel runs its trials so.
It then prints one JSON object per line: {"folder": PATH}; ten times a second while it records {"step": -1.., "left": s}
after the script {"phase": "reporting"}; last {"problem": TEXT}, '' for none.

Exit code 0: the arm held. 1: it did not hold, or the trial did not finish. 2: wrong use or wrong file. 3: the simulated
device could not run in real time because this computer was too busy.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from exo_gravity import version
from exo_gravity.core.errors import DataError, ExoGravityError, ParameterError
from exo_gravity.core.params import params_of
from exo_gravity.core.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.core.trial.session import Session
from exo_gravity.tools.cli import extras
from exo_gravity.tools.inputs.parameter_file import packaged_config
from exo_gravity.tools.launcher import Stopping, stop_on_signals
from exo_gravity.tools.reporting import video

if TYPE_CHECKING:
    from rich.console import Console

    from exo_gravity.bag.content import Bag
    from exo_gravity.tools.reporting.trial_report import Report
    from exo_gravity.tools.trials.run import TrialEnd

# One position code over a minute is 0.02 degrees, so the rate over a much shorter hold means little.
LONG_HOLD = 30.0  # s
MAX_RATE = 0.2  # deg/min
START_TIME = 1.0  # s for a panel to start the virtual wearer, once the recorder runs


def packaged_trials() -> dict[str, Path]:
    """Return the scripts that come with the package, by name."""
    folder = packaged_config("trials/demo.yaml").parent
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def read_script(name: str) -> tuple[Path, TrialScript]:
    """Return path and content of a packaged script or of a YAML file. Raises ParameterError."""
    packaged = packaged_trials()
    if name not in packaged and not name.endswith((".yaml", ".yml")):
        raise ParameterError("trial", name, f"{', '.join(packaged)} or a YAML file with a script")
    path = packaged.get(name, Path(name))
    try:
        return path.resolve(), TrialScript.parse(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError("trial", name, f"a readable YAML file ({reason})") from None


def criteria_for(script: TrialScript) -> HoldCriteria:
    """Return the criteria for a script: if every hold is long enough, they limit the drift rate."""
    rate = MAX_RATE if min(_hold_durations(script), default=0.0) >= LONG_HOLD else math.inf
    # A person at a real arm may also hold it still at other times, and only briefly.
    return HoldCriteria(max_rate=math.radians(rate) / 60.0, rated_from=LONG_HOLD)


def shortest_hold(script: TrialScript, guided: bool) -> float:
    """Return the shortest still phase in s that is a hold.

    A person holds the arm still for a moment before letting go, and lets go late: at least half a hold remains.
    """
    holds = _hold_durations(script)
    return max(MIN_HOLD, min(holds) / 2.0) if guided and holds else MIN_HOLD


def missing_holds(script: TrialScript, report: "Report") -> str:
    """Return which arm has fewer holds than the script, or ''.

    A real arm's recording has no script, so a hold in which the arm never came to rest leaves no other trace.
    """
    scripted = len(_hold_durations(script))
    for recording, analysis in report.arms:
        if len(analysis.holds) < scripted:
            return f"{recording.name}: {len(analysis.holds)} of {scripted} holds were found"
    return ""


def _hold_durations(script: TrialScript) -> list[float]:
    return [step.duration for step in script.steps if step.action == "hold"]


def _run(options: argparse.Namespace, params: Path, clip: video.Clip | None, console: "Console") -> int:
    """Run and report a trial; return the exit code. Raises ExoGravityError."""
    from exo_gravity.bag.reader import read_bag
    from exo_gravity.tools.reporting import trial_report
    from exo_gravity.tools.trials.run import ADVICE, BUSY_CODE, TrialEnd, is_guided, prepare, run_attempts

    path, script = read_script(options.name)
    session, now = Session(options.subject, options.protocol, options.note), datetime.now()
    stopped = stop_on_signals()
    folder = Path(options.output).resolve() / session.folder(now) / f"{script.name}_{now:%Y%m%d_%H%M%S}"
    guided = options.attach == "guided" if options.attach else is_guided(params)
    bag: Bag | None = None
    if options.offline:
        if clip:
            os.environ["MUJOCO_GL"] = video.backend()  # before the simulated device imports MuJoCo
        with extras("trial", "sim"):
            from exo_gravity.tools.trials.offline import record_offline, simulated_trials
        trials = simulated_trials(params, script)
        given = prepare(params, path, folder, None)
        trouble = record_offline(trials, given, replace(session, version=version()), console, stopped.is_set)
        end = TrialEnd(trouble, int(bool(trouble)))
    elif options.attach:
        end = _attached(guided, path, script, folder, session, console, stopped)
    else:
        end = run_attempts(params, path, script, folder, session, console, stopped)
    try:
        bag = read_bag(folder / "bag")
    except DataError:
        if not end.trouble:
            raise
    trouble, code = end.trouble, end.code
    if bag is not None:
        report = trial_report.analyse(bag, criteria_for(script), shortest_hold(script, guided), trouble)
        if guided and not trouble:
            trouble = missing_holds(script, report)
            code = int(bool(trouble))
        trial_report.write(report, folder)
        if not options.attach:
            trial_report.print_report(report)
        code = code or report.exit_code
        if clip:
            video.write(bag, clip, console)
    else:
        trial_report.write_empty(folder, script.name, trouble)
    log = "" if options.offline else ", log"
    console.print(f"Report, recording{log} and parameters: {folder}", markup=False, soft_wrap=True)
    if end.trouble and end.busy and code != 2:
        trouble, code = f"this computer was too busy: {end.busy}. {ADVICE}", BUSY_CODE
    if trouble:
        console.print(f"trial: {trouble}", markup=False, soft_wrap=True)
    if options.attach:
        _print_json(problem=trouble)
    return code


def _attached(
    guided: bool,
    path: Path,
    script: TrialScript,
    folder: Path,
    session: Session,
    console: "Console",
    stopped: Stopping,
) -> "TrialEnd":
    """Run the script on arms that are carried already; a fault is then never excused by a busy computer."""
    from exo_gravity.tools.trials.run import TrialEnd, prepare, run_nodes
    from exo_gravity.tools.trials.screen import LEAD, TrialScreen

    params = prepare(None, path, folder, session)
    _print_json(folder=str(folder))
    # The clock leads, because a simulator's newest step may be that of an earlier trial.
    screen = TrialScreen(
        script, guided, console, lead=LEAD if guided else START_TIME,
        on_progress=lambda step, left: _print_json(step=step, left=round(left, 1)),
    )  # fmt: skip
    end = run_nodes(params, script, folder, screen, stopped)
    _print_json(phase="reporting")
    return TrialEnd(end.trouble, end.code)


def _print_json(**values: object) -> None:
    try:
        print(json.dumps(values), flush=True)
    except BrokenPipeError:  # the panel has died: the trial goes on, and is reported
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="trial", description="Run a trial from start to report.")
    option = parser.add_argument
    option("name", help=f"{', '.join(packaged_trials())}, or a YAML file with a script")
    option("--params", metavar="FILE", help="parameter file (default: the simulated right arm)")
    option("--output", metavar="DIR", default="trials", help="where to create the trial's folder (%(default)s)")
    option("--offline", action="store_true", help="on the simulated device, without ROS and faster than real time")
    attach = "on arms that are carried already, a person or a simulator moving them; prints JSON"
    for param in params_of(Session):
        option(f"--{param.name}", metavar="TEXT", default="", help=param.description)
    option("--attach", choices=("guided", "simulated"), help=attach)
    video.add_arguments(parser)
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    try:
        options = _arguments(args)
        params = Path(options.params or packaged_config("sim.yaml"))
        clip = video.requested(options.video, options.video_speed)
        with extras("trial", "report"):
            from rich.console import Console

            return _run(options, params, clip, Console(highlight=False, stderr=bool(options.attach)))
    except ExoGravityError as error:
        print(f"trial: {error}", file=sys.stderr)
        return 2 if isinstance(error, ParameterError) else 1
