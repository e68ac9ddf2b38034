"""A trial in real time: starts the nodes, follows the script on the recorder's lines, and stops the nodes.

A trial on the simulated device that fails because this computer was too busy is repeated: nothing is worn, and every
attempt starts all nodes anew. A trial on a real arm is never repeated. Each simulator measures how long it was not run
and how long it got no command: its arm, motors and bus are programs on this computer, so a long gap means that the
computer ran other programs instead.
"""

import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.core.trial.session import Session
from exo_gravity.tools.inputs.parameter_file import load
from exo_gravity.tools.launcher import Launcher, Stopping
from exo_gravity.tools.trials.screen import LEAD, TrialScreen

RECORDER = "/recorder"
START_TIMEOUT = 60.0  # s until the arm must be carried
GRACE = 0.5  # s recorded after the last step
RECORDER_TIMEOUT = 10.0  # s without a line from the recorder
ATTEMPTS = 3
BUSY_CODE = 3
ADVICE = "Close other programs and try again. The arm has no fault."
LONG_GAP = 50.0  # ms; a simulated device loses time after such a stall
# Faults that a busy computer can cause; '' stands for a trial that ended early without a fault. A connected simulated
# motor always replies and the compensator always answers: if they are late, the computer is, also without a long gap.
POSSIBLE = {
    "": "",
    FaultCode.MOTOR_SILENT.value: "the replies of the simulated motors came too late",
    FaultCode.COMMAND_STALE.value: "the efforts came too late",
    FaultCode.COMMAND_WITHDRAWN.value: "",
    FaultCode.SIGN_UNPROVEN.value: "",
    FaultCode.TORQUE_NOT_DELIVERED.value: "",
}

Status = Mapping[str, Mapping[str, Any]]  # of each node on /diagnostics, as in the recorder's live lines


@dataclass(frozen=True)
class TrialEnd:
    """How a trial ended."""

    trouble: str  #: why it ended before the script, or ''
    code: int  #: the exit code for that
    busy: str = ""  #: what was late because this computer was too busy, or ''


def is_guided(params: Path) -> bool:
    """Return whether a person performs the script, because the parameter file has no simulator."""
    return not any(node.endswith("/simulator") for node in load(params))


def prepare(params: Path | None, script: Path, folder: Path, session: Session | None) -> Path:
    """Write the parameter file of one trial into the new `folder`, and return its path.

    It is `params` with the script for each simulator and a recorder of `session`, None for no recorder. Raises
    ParameterError.
    """
    content: dict[str, Any] = yaml.safe_load(params.read_text(encoding="utf-8")) if params else {}
    for node, entry in content.items():
        if node.endswith("/simulator"):
            entry["ros__parameters"]["trial"] = str(script)
    if session:
        of_whom = {name: text for name, text in asdict(session).items() if name != "version"}
        content[RECORDER] = {"ros__parameters": {"output": str(folder / "bag"), "live": True, **of_whom}}
    path = folder / "params.yaml"
    try:
        folder.mkdir(parents=True)
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ParameterError("output", str(folder.parent), f"a writable folder ({error.strerror})") from None
    return path


def run_attempts(
    params: Path, path: Path, script: TrialScript, folder: Path, session: Session, console: Console, stopped: Stopping
) -> TrialEnd:
    """Run `script`, the file at `path`, on nodes in the new `folder`; repeat it if this computer was too busy."""
    bridges = [node.lstrip("/") for node in load(params) if node.endswith("/can_bridge")]
    guided = is_guided(params)
    for attempt in range(1, ATTEMPTS + 1):
        trial = prepare(params, path, folder, session)
        screen = TrialScreen(script, guided, console, bridges, LEAD if guided else None)
        end = run_nodes(trial, script, folder, screen, stopped)
        if not (end.trouble and end.busy) or end.code == 2 or stopped.is_set() or attempt == ATTEMPTS:
            break
        folder.rename(f"{folder}_attempt_{attempt}")
        again = f"attempt {attempt + 1} of {ATTEMPTS}"
        console.print(f"this computer was too busy: {end.busy}; {again}", markup=False, soft_wrap=True)
    return end


def run_nodes(params: Path, script: TrialScript, folder: Path, screen: TrialScreen, stopped: Stopping) -> TrialEnd:
    """Run the nodes of `params` until the script is done, a fault latches or `stopped` is set."""
    last_errors: dict[str, str] = {}
    with (folder / "log.txt").open("w", 1, encoding="utf-8") as log, screen.live:

        def on_line(node: str, line: str) -> None:
            if node == RECORDER and line.startswith("{"):
                screen.take(line)
                return
            log.write(f"{datetime.now():%H:%M:%S.%f} {node.lstrip('/')} {line}\n")
            if line.startswith(("FATAL ", "ERROR ")):
                last_errors[node] = line.partition(" ")[2]

        launcher = Launcher(params, on_line)
        ending = threading.Event()
        dead: list[tuple[str, int] | None] = []
        nodes = threading.Thread(target=lambda: dead.append(launcher.run(ending)))
        nodes.start()
        trouble = follow(screen, script, stopped, lambda: launcher.exit_code(RECORDER), nodes)
        recorder_failed = launcher.exit_code(RECORDER) is not None and launcher.dead() is None
        down_by = time.monotonic() + DESCENT_TIMEOUT
        while nodes.is_alive() and is_falling(screen.status) and screen.silence < 1.0 and time.monotonic() < down_by:
            time.sleep(0.05)  # the recording shows how the arm comes down
        if nodes.is_alive():
            screen.end("letting the arm down and closing the recording")
        ending.set()
        nodes.join()
    busy = "" if stopped.is_set() or recorder_failed else too_busy(screen.status)
    if dead and dead[0]:
        node, code = dead[0]
        why = last_errors.get(node, f"see {folder / 'log.txt'}")
        trouble = f"{node.lstrip('/')} ended with exit code {code}: {why}"
        # The watchdog kills a bridge that has not run for too long.
        busy = busy if node.endswith("/can_bridge") and code == -signal.SIGKILL else ""
        return TrialEnd(trouble, 2 if code == 2 else 1, busy)
    if RECORDER in last_errors and trouble:
        trouble += f": {last_errors[RECORDER]}"
    return TrialEnd(trouble, int(bool(trouble)), busy)


def follow(
    screen: TrialScreen,
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
        if screen.silence > RECORDER_TIMEOUT:
            return f"the recorder has sent no data for {RECORDER_TIMEOUT:g} s"
        if message := fault_of(screen.status)[1]:
            return message
        if screen.done:
            stopped.wait(GRACE)
            return ""
        if screen.is_let_down:
            return "an arm is not active any more"
        if time.monotonic() > deadline:
            return f"the trial did not finish in time: {'; '.join(screen.faults) or 'no node reports a fault'}"
    return "stopped by the operator" if stopped.is_set() else ""


def is_falling(status: Status) -> bool:
    """Return whether an arm is being let down."""
    return any(values.get("state") == State.LETTING_DOWN.value for values in status.values())


def fault_of(status: Status) -> tuple[str, str]:
    """Return the code and the message of the first fault that a bridge reports, or ('', '')."""
    for name, values in status.items():
        if values.get("fault", "none") != "none":
            return str(values["fault"]), f"{name}: {values['message']}"
    return "", ""


def too_busy(status: Status) -> str:
    """Return what was late and, if it is known, by how much; '' if the simulated device ran in time.

    status: of all nodes, after a trial that ended early. A simulated fault is a reason by itself.
    """
    simulators = {name: values for name, values in status.items() if "longest stall (ms)" in values}
    code, _ = fault_of(status)
    if code not in POSSIBLE or any(values["disconnected"] == "yes" for values in simulators.values()):
        return ""
    for name, values in simulators.items():
        stall, silence = float(values["longest stall (ms)"]), float(values["longest silence (ms)"])
        if stall >= LONG_GAP:
            return f"{name} was not run for {stall:.0f} ms"
        if silence >= LONG_GAP:
            return f"{name.removesuffix('simulator')}can_bridge was not run for {silence:.0f} ms"
    return POSSIBLE[code] if simulators else ""
