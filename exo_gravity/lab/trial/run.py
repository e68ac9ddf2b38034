# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trial in real time: starts the nodes, follows the script on the recorder's lines, and stops the nodes.

Each simulator measures how long it was not run and how long it got no command: its arm, motors and bus are programs on
this computer, so a long gap means that the computer ran other programs instead. A trial that ended early says so.
"""

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import params_of
from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.lab.inputs.node_checks import check_nodes, check_start
from exo_gravity.lab.inputs.parameter_file import load, stages
from exo_gravity.lab.inputs.ros_yaml import text_of
from exo_gravity.lab.processes import Launcher, Stopping
from exo_gravity.lab.trial.screen import BRIDGE_TIMEOUT, LEAD, TrialScreen
from exo_gravity.lab.trial.session import Session
from exo_gravity.sim.script import TrialScript

RECORDER = "/recorder"
START_TIME = 1.0  # s for a panel to start the virtual wearer, once the recorder runs
START_TIMEOUT = 60.0  # s until the arm must be carried
GRACE = 0.5  # s recorded after the last step
RECORDER_TIMEOUT = 10.0  # s without a line from the recorder
LONG_GAP = 50.0  # ms; a simulated device loses time after such a stall

Status = Mapping[str, Mapping[str, Any]]  # of each node on /diagnostics, as in the recorder's live lines


def is_guided(params: Path) -> bool:
    """Return whether a person performs the script, because the parameter file has no simulator."""
    return not any(node.endswith("/simulator") for node in load(params))


def check_bridges(params: Path, is_offline: bool) -> None:
    """Check that a parameter file has a can_bridge, whose arm a trial follows, and that its nodes can start.

    is_offline: none does, so that another can_bridge may hold the bus. Raises ParameterError, BusError.
    """
    nodes = load(params)
    if not stages(nodes)[0]:
        expected = f"a file with a can_bridge, whose arm a trial follows; it has {', '.join(nodes)}"
        raise ParameterError("params", str(params), expected)
    check_nodes(nodes) if is_offline else check_start(nodes)


@dataclass(frozen=True)
class Trial:
    """Who performs which script on which nodes, and where that is recorded."""

    path: Path  #: of the script
    script: TrialScript
    params: Path | None  #: the parameter file of the nodes; None on arms that are carried already
    guided: bool  #: whether a person performs the script; otherwise the virtual wearer of a simulator does
    session: Session
    folder: Path

    def prepare(self, with_recorder: bool = True) -> Path:
        """Write the trial's own parameter file into the new folder, and return its path. Raises ParameterError."""
        nodes = load(self.params) if self.params else {}
        for node, values in nodes.items():
            if node.endswith("/simulator"):
                values["trial"] = str(self.path)
        if with_recorder:
            of_whom = {param.name: getattr(self.session, param.name) for param in params_of(Session)}
            nodes[RECORDER] = {"output": str(self.folder / "bag"), "live": True, **of_whom}
        path = self.folder / "params.yaml"
        try:
            self.folder.mkdir(parents=True)
            path.write_text(text_of(nodes), encoding="utf-8")
        except OSError as error:
            expected = f"a writable folder ({error.strerror})"
            raise ParameterError("output", str(self.folder.parent), expected) from None
        return path


@dataclass(frozen=True)
class TrialEnd:
    """How a trial ended."""

    trouble: str = ""  #: why it ended before the script, or ''
    code: int = 0  #: the exit code for that


def run_trial(trial: Trial, console: Console, stopped: Stopping, on_progress: Callable[[int, float], None]) -> TrialEnd:
    """Run a trial that is prepared until the script is done, a fault latches or `stopped` is set.

    on_progress: as in `TrialScreen`.
    """
    # On arms that are carried already the clock leads: a simulator's newest step may be that of an earlier trial.
    unguided = START_TIME if trial.params is None else None
    lead = LEAD if trial.guided else unguided
    bridges = [node.lstrip("/") for node in stages(load(trial.params))[0]] if trial.params else []
    screen = TrialScreen(trial.script, trial.guided, console, bridges, lead, on_progress)
    last_errors: dict[str, str] = {}
    path = trial.folder / "log.txt"
    with path.open("w", 1, encoding="utf-8") as log, screen.live, ThreadPoolExecutor(1) as pool:

        def on_line(node: str, line: str) -> None:
            if node == RECORDER and line.startswith("{"):
                screen.take(line)
                return
            log.write(f"{datetime.now():%H:%M:%S.%f} {node.lstrip('/')} {line}\n")
            if line.startswith(("FATAL ", "ERROR ")):
                last_errors[node] = line.partition(" ")[2]

        launcher = Launcher(trial.folder / "params.yaml", on_line)
        ending = threading.Event()
        nodes = pool.submit(launcher.run, ending)
        trouble = follow(screen, stopped, lambda: launcher.exit_code(RECORDER), nodes)
        down_by = time.monotonic() + DESCENT_TIMEOUT
        while screen.is_falling and screen.silence < 1.0 and time.monotonic() < down_by and not nodes.done():
            time.sleep(0.05)  # the recording shows how the arm comes down
        if not nodes.done():
            screen.end("letting the arm down and closing the recording")
        ending.set()
        dead = nodes.result()
    if dead:
        node, code = dead
        trouble = f"{node.lstrip('/')} ended with exit code {code}: {last_errors.get(node, f'see {path}')}"
        return TrialEnd(trouble, 2 if code == 2 else 1)
    if not trouble:
        return TrialEnd()
    recorder = f": {last_errors[RECORDER]}" if RECORDER in last_errors else ""
    return TrialEnd(f"{trouble}{recorder}{stall_of(screen.status)}", 1)


def follow(screen: TrialScreen, stopped: Stopping, recorder_code: Callable[[], int | None], nodes: Future[Any]) -> str:
    """Wait until the script is done; return '' or why the wait ended earlier."""
    deadline = time.monotonic() + START_TIMEOUT + screen.script.duration
    while not stopped.wait(0.05) and not nodes.done():
        if (code := recorder_code()) is not None:
            return f"the recorder ended with exit code {code} before the trial was done"
        if screen.silence > RECORDER_TIMEOUT:
            return f"the recorder has sent no data for {RECORDER_TIMEOUT:g} s"
        if screen.has_no_bridge:
            return f"no can_bridge has reported on /diagnostics within {BRIDGE_TIMEOUT:g} s: no arm is carried here"
        if message := screen.message_of("fault") or (not screen.guided and screen.message_of("refusal")):
            return message
        if screen.done:
            stopped.wait(GRACE)
            return ""
        if screen.is_let_down:
            return "an arm is not active any more"
        if time.monotonic() > deadline:
            return f"the trial did not finish in time: {'; '.join(screen.faults) or 'no node reports a fault'}"
    return "stopped by the operator" if stopped.is_set() else ""


def stall_of(status: Status) -> str:
    """Return, as a clause, which simulator or bridge was not run for long while a simulated trial failed, or ''."""
    for key, node in (("longest stall (ms)", "simulator"), ("longest silence (ms)", "can_bridge")):
        for name, values in status.items():
            if values.get("disconnected") == "no" and float(values[key]) >= LONG_GAP:  # a simulator's
                who = name.replace("simulator", node)
                return f"; {who} was not run for {values[key]} ms: this computer was too busy"
    return ""
