"""trial NAME: runs a trial from start to report, on the simulated device or on a real arm.

It starts the nodes of a parameter file and a recorder, follows the script, stops all, and reports the recording. The
folder of the trial holds the parameters as they were, the recording, the nodes' log, and the report. Ctrl-C, a fault or
the end of the recorder lets the arm down, and what was recorded until then is reported.

Exit code 0: the arm held. 1: it did not, or the trial was not done. 2: wrong use or wrong file.
"""

from __future__ import annotations

import argparse
import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import yaml
from rich.console import Console

from exo_gravity.bag.reader import read_bag
from exo_gravity.core.errors import DataError, ExoGravityError, ParameterError
from exo_gravity.core.trial_analysis import MIN_HOLD
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.core.verdict import HoldCriteria
from exo_gravity.tools.cli.arguments import non_negative
from exo_gravity.tools.inputs.parameter_file import load, packaged_config
from exo_gravity.tools.launcher import Launcher, stop_on_signals
from exo_gravity.tools.reporting import trial_report
from exo_gravity.tools.reporting.trial_report import Report
from exo_gravity.tools.trials.live import Progress
from exo_gravity.tools.trials.offline import run_offline, simulated_trials

START = 60.0  # s until the arm must be carried
GRACE = 0.5  # s recorded beyond the last step
RECORDER = "/recorder"
LATCHED = re.compile(r"(fault|letting down): ")  # in what a bridge says of itself
# One position code over a minute is 0.02 degrees: a rate over less than half of that says little.
LONG_HOLD = 30.0  # s
MAX_RATE = 0.2  # deg/min
SILENCE = 10.0  # s without a word after which the recorder counts as stuck


def read_script(name: str) -> tuple[Path, TrialScript]:
    """Return path and script of a packaged trial, or of a YAML file. Raises ParameterError."""
    path = Path(name) if name.endswith((".yaml", ".yml")) else packaged_config(f"trials/{name}.yaml")
    try:
        return path.resolve(), TrialScript.parse(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError("trial", name, f"a packaged trial or a readable YAML file ({reason})") from None


def prepare(params: Path, script: Path, folder: Path, recorded: bool) -> Path:
    """Write the parameter file of this trial into `folder`: the one given, led by the script, and with a recorder."""
    load(params)  # refuses what is no parameter file
    content = yaml.safe_load(params.read_text(encoding="utf-8"))
    for node, entry in content.items():
        if node.endswith("/simulator"):
            entry["ros__parameters"]["trial"] = str(script)
    if recorded:
        content[RECORDER] = {"ros__parameters": {"output": str(folder / "bag"), "live": True}}
    path = folder / "params.yaml"
    try:
        folder.mkdir(parents=True)
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ParameterError("output", str(folder.parent), f"a folder to write to ({error.strerror})") from None
    return path


def run_nodes(
    params: Path, script: TrialScript, folder: Path, console: Console, stopped: threading.Event
) -> tuple[str, int]:
    """Run the nodes until the script is done; return what went wrong, or '', and the exit code that it asks for."""
    last_words: dict[str, str] = {}
    progress = Progress(script, is_guided(params), console)
    with (folder / "log.txt").open("w", 1, encoding="utf-8") as log, progress:

        def on_line(node: str, line: str) -> None:
            if node == RECORDER and line.startswith("{"):
                progress.take(line)
                return
            log.write(f"{datetime.now():%H:%M:%S.%f} {node.lstrip('/')} {line}\n")
            if line.startswith(("FATAL ", "ERROR ")):
                last_words[node] = line.partition(" ")[2]

        launcher = Launcher(params, on_line)
        ending = threading.Event()
        dead: list[tuple[str, int] | None] = []
        nodes = threading.Thread(target=lambda: dead.append(launcher.run(ending)))
        nodes.start()
        trouble = follow(progress, script, stopped, lambda: _ended(launcher, RECORDER), nodes)
        if nodes.is_alive():
            progress.end("letting the arm down and ending the recording")
        ending.set()
        nodes.join()
    if dead and dead[0]:
        node, code = dead[0]
        why = last_words.get(node, f"{folder / 'log.txt'} says more")
        return f"{node.lstrip('/')} ended with exit code {code}: {why}", 2 if code == 2 else 1
    if RECORDER in last_words and trouble:
        trouble += f": {last_words[RECORDER]}"
    return trouble, int(bool(trouble))


def is_guided(params: Path) -> bool:
    """Return whether a person carries out the script, since no simulator of the parameter file does."""
    return not any(node.endswith("/simulator") for node in load(params))


def _ended(launcher: Launcher, node: str) -> int | None:
    """Return the exit code of a node that was started and has ended, else None."""
    try:
        return launcher.process(node).poll()
    except KeyError:
        return None


def follow(
    progress: Progress,
    script: TrialScript,
    stopped: threading.Event,
    recorder_ended: Callable[[], int | None],
    nodes: threading.Thread,
) -> str:
    """Wait until the script is done, or say what came between."""
    deadline = time.monotonic() + START + script.duration
    while not stopped.wait(0.05) and nodes.is_alive():
        if (code := recorder_ended()) is not None:
            return f"the recorder ended with exit code {code} before the trial was done"
        if progress.silence > SILENCE:
            return f"the recorder has said nothing for {SILENCE:g} s"
        if fault := next((fault for fault in progress.faults if LATCHED.search(fault)), ""):
            return fault
        if progress.done:
            stopped.wait(GRACE)
            return ""
        if time.monotonic() > deadline:
            return f"the trial was not done in time; {'; '.join(progress.faults) or 'nobody said why'}"
    return "stopped by the operator" if stopped.is_set() else ""


def limits_for(script: TrialScript, max_rate: float | None) -> HoldCriteria:
    """Return what the arm is judged by; max_rate: deg/min over a hold, None for what the script's holds can show."""
    if max_rate is None:
        shortest = min((step.duration for step in script.steps if step.action == "hold"), default=0.0)
        max_rate = MAX_RATE if shortest >= LONG_HOLD else math.inf
        # A person at a real arm may keep it still for a moment at any time.
        return HoldCriteria(max_rate=math.radians(max_rate) / 60.0, rated_from=LONG_HOLD)
    return HoldCriteria(max_rate=math.radians(max_rate) / 60.0)


def missed(script: TrialScript, found: Report) -> str:
    """Return which arm was found still less often than the script asked for, or ''.

    Without a script in the recording a hold in which the arm never came to rest leaves no trace but this.
    """
    asked = sum(step.action == "hold" for step in script.steps)
    for recording, trial in found.arms:
        if len(trial.holds) < asked:
            return f"{recording.name}: {len(trial.holds)} of {asked} holds were found"
    return ""


def shortest_hold(script: TrialScript, guided: bool) -> float:
    """Return from which length in s on a stillness counts as a hold.

    A person keeps the arm still for a moment before letting go, and lets go late: half a hold must be left.
    """
    holds = [step.duration for step in script.steps if step.action == "hold"]
    return max(MIN_HOLD, min(holds) / 2.0) if guided and holds else MIN_HOLD


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the trial that the command line asks for and report it; return the exit code. Raises ExoGravityError."""
    path, script = read_script(options.name)
    folder = Path(options.output).resolve() / f"{script.name}_{datetime.now():%Y%m%d_%H%M%S}"
    given = Path(options.params or packaged_config("sim.yaml"))
    stopped = stop_on_signals()
    if options.offline:
        trials = simulated_trials(given, script)
        params = prepare(given, path, folder, recorded=False)
        bag, trouble = run_offline(trials, params, console, stopped.is_set)
        code = int(bool(trouble))
    else:
        params = prepare(given, path, folder, recorded=True)
        trouble, code = run_nodes(params, script, folder, console, stopped)
        try:
            bag = read_bag(folder / "bag")
        except DataError:
            if not trouble:
                raise
            _complain(trouble)
            return code
    guided = is_guided(params)
    found = trial_report.analyse(bag, limits_for(script, options.max_rate), shortest_hold(script, guided))
    if guided and not trouble:
        trouble = missed(script, found)
        code = int(bool(trouble))
    trial_report.write(found, folder)
    trial_report.print_report(found)
    if trouble:
        console.print(f"trial: {trouble}", markup=False, soft_wrap=True)
    contents = "Report and parameters" if options.offline else "Report, recording, log and parameters"
    console.print(f"{contents}: {folder}", markup=False, soft_wrap=True)
    return code or found.exit_code


def _complain(why: object) -> None:
    Console(stderr=True).print(f"trial: {why}", markup=False, highlight=False, soft_wrap=True)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="trial", description="Run a trial from start to report.")
    option = parser.add_argument
    option("name", help="demo, two_poses, thirteen_poses, or a YAML file with a script")
    option("--params", metavar="FILE", help="parameter file (default: the simulated right arm)")
    option("--output", metavar="DIR", default="trials", help="where the trial's folder goes (%(default)s)")
    option("--offline", action="store_true", help="on the simulated device, without ROS and faster than real time")
    option(
        "--max-rate",
        type=non_negative,
        metavar="DEG/MIN",
        help=f"drift allowed over a hold (default: {MAX_RATE:g} if every hold lasts {LONG_HOLD:g} s, else no limit)",
    )
    options = parser.parse_args(args)
    try:
        return run(options, Console(highlight=False))
    except ExoGravityError as error:
        _complain(error)
        return 2 if isinstance(error, ParameterError) else 1
