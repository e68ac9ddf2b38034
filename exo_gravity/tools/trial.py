# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""trial NAME: runs a trial from start to report, on the simulated device or on a real arm.

It starts the nodes of a parameter file and a recorder, follows the script, stops the nodes, and reports the recording.
The folder of the trial holds the parameters, the recording, the nodes' log and the report. Ctrl-C, a fault or the end
of the recorder lets the arm down, and the trial reports what was recorded until then.

With --attach it starts the recorder alone, for arms that are carried already: the operator's panel runs its trials so.
It then prints one JSON object per line: {"folder": PATH}; ten times a second while it records {"step": -1.., "left": s}
after the script {"phase": "reporting"}; last {"problem": TEXT, "stopped": whether that is the operator}, '' for none.

Exit code 0: the arm held. 1: it did not hold, or the trial did not finish. 2: wrong use or wrong file.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from exo_gravity import version
from exo_gravity.core.errors import DataError
from exo_gravity.core.params import params_of
from exo_gravity.lab.bag.content import Session
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.processes import stop_on_signals
from exo_gravity.lab.report import video
from exo_gravity.lab.trial.scripted import analysed, packaged_trials, read_script
from exo_gravity.tools.cli import command, extras


def _run(options: argparse.Namespace) -> int:
    """Run and report a trial; return the exit code. Raises ExoGravityError."""
    params = Path(options.params or packaged_config("sim.yaml"))
    clip = video.requested(options.video, options.video_speed)
    from rich.console import Console

    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import trial_report
    from exo_gravity.lab.trial.run import STOPPED, Trial, check_bridges, run_trial

    console = Console(highlight=False, stderr=bool(options.attach))
    path, script = read_script(options.name)
    session, now = Session(options.subject, options.protocol, options.note, version()), datetime.now()
    folder = Path(options.output).resolve() / session.folder(now) / f"{script.name}_{now:%Y%m%d_%H%M%S}"
    guided = options.attach == "guided" if options.attach else check_bridges(params, options.offline)
    trial = Trial(path, script, None if options.attach else params, guided, session, folder)
    tell: Callable[..., None] = _print_json if options.attach else lambda **values: None
    stopped = stop_on_signals()
    if options.offline:
        with extras("trial", "sim"):
            from exo_gravity.lab.trial.offline import record_offline
        trouble = record_offline(trial, console, stopped.is_set)
    else:
        trial.prepare()
        tell(folder=str(folder))
        trouble = run_trial(trial, console, stopped, lambda step, left: tell(step=step, left=round(left, 1)))
        tell(phase="reporting")
    code = 1
    try:
        bag = read_bag(folder / "bag")
    except DataError:
        if not trouble:
            raise
    else:
        report, trouble = analysed(bag, script, guided, trouble)
        code = int(bool(trouble)) or report.exit_code
        trial_report.write(report, folder)
        if not options.attach:
            trial_report.print_report(report)
        if clip:
            clip(bag, console)
    log = "" if options.offline else ", log"
    console.print(f"Report, recording{log} and parameters: {folder}", markup=False, soft_wrap=True)
    if trouble:
        console.print(f"trial: {trouble}", markup=False, soft_wrap=True)
    tell(problem=trouble, stopped=trouble == STOPPED)
    return code


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
    for param in params_of(Session):
        option(f"--{param.name}", metavar="TEXT", default="", help=param.description)
    where = parser.add_mutually_exclusive_group().add_argument
    where("--offline", action="store_true", help="on the simulated device, without ROS and faster than real time")
    attach = "on arms that are carried already, a person or a simulator moving them; prints JSON"
    where("--attach", choices=("guided", "simulated"), help=attach)
    video.add_arguments(parser)
    return parser.parse_args(args)


main = command("trial", "report", _arguments, _run, failed=1)
