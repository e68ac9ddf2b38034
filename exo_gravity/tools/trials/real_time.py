"""A trial in real time: starts the nodes of a parameter file, follows the script, and stops the nodes."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rich.console import Console

from exo_gravity.core.trial.script import TrialScript
from exo_gravity.tools.inputs.parameter_file import load
from exo_gravity.tools.launcher import Launcher, Stopping
from exo_gravity.tools.trials.busy import fault_of, too_busy
from exo_gravity.tools.trials.live import Progress
from exo_gravity.tools.trials.scripts import RECORDER, is_guided

START_TIMEOUT = 60.0  # s until the arm must be carried
GRACE = 0.5  # s recorded after the last step
RECORDER_TIMEOUT = 10.0  # s without a line from the recorder


@dataclass(frozen=True)
class Outcome:
    """How the nodes ended.

    trouble: why the trial ended before the script, or ''. code: the exit code for it. busy: what was late because this
    computer was too busy, or ''.
    """

    trouble: str
    code: int
    busy: str


def run_nodes(params: Path, script: TrialScript, folder: Path, console: Console, stopped: Stopping) -> Outcome:
    """Run the nodes of `params` until the script is done, a fault latches or `stopped` is set."""
    last_errors: dict[str, str] = {}
    guided = is_guided(params)
    bridges = [node.lstrip("/") for node in load(params) if node.endswith("/can_bridge")]
    progress = Progress(script, guided, console, bridges)
    with (folder / "log.txt").open("w", 1, encoding="utf-8") as log, progress:

        def on_line(node: str, line: str) -> None:
            if node == RECORDER and line.startswith("{"):
                progress.take(line)
                return
            log.write(f"{datetime.now():%H:%M:%S.%f} {node.lstrip('/')} {line}\n")
            if line.startswith(("FATAL ", "ERROR ")):
                last_errors[node] = line.partition(" ")[2]

        launcher = Launcher(params, on_line)
        ending = threading.Event()
        dead: list[tuple[str, int] | None] = []
        nodes = threading.Thread(target=lambda: dead.append(launcher.run(ending)))
        nodes.start()
        trouble = follow(progress, script, stopped, lambda: _exit_code(launcher, RECORDER), nodes)
        recorder_failed = _exit_code(launcher, RECORDER) is not None and launcher.dead() is None
        if nodes.is_alive():
            progress.end("letting the arm down and closing the recording")
        ending.set()
        nodes.join()
    busy = "" if stopped.is_set() or recorder_failed else too_busy(progress.status)
    if dead and dead[0]:
        node, code = dead[0]
        why = last_errors.get(node, f"see {folder / 'log.txt'}")
        trouble = f"{node.lstrip('/')} ended with exit code {code}: {why}"
        # The watchdog kills a bridge that has not run for too long.
        busy = busy if node.endswith("/can_bridge") and code == -signal.SIGKILL else ""
        return Outcome(trouble, 2 if code == 2 else 1, busy)
    if RECORDER in last_errors and trouble:
        trouble += f": {last_errors[RECORDER]}"
    return Outcome(trouble, int(bool(trouble)), busy)


def _exit_code(launcher: Launcher, node: str) -> int | None:
    """Return the exit code of a node that was started and has ended, else None."""
    try:
        return launcher.process(node).poll()
    except KeyError:
        return None


def follow(
    progress: Progress,
    script: TrialScript,
    stopped: Stopping,
    recorder_code: Callable[[], int | None],
    nodes: threading.Thread,
) -> str:
    """Wait until the script is done; return '' or why the wait ended earlier."""
    deadline = time.monotonic() + START_TIMEOUT + script.duration
    while not stopped.wait(0.05) and nodes.is_alive():
        if (code := recorder_code()) is not None:
            return f"the recorder ended with exit code {code} before the trial was done"
        if progress.silence > RECORDER_TIMEOUT:
            return f"the recorder has sent no data for {RECORDER_TIMEOUT:g} s"
        if message := fault_of(progress.status)[1]:
            return message
        if progress.done:
            stopped.wait(GRACE)
            return ""
        if time.monotonic() > deadline:
            return f"the trial did not finish in time: {'; '.join(progress.faults) or 'no node reports a fault'}"
    return "stopped by the operator" if stopped.is_set() else ""
