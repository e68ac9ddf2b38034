# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trial in real time: starts the nodes, follows the script on the recorder's lines, and stops the nodes.

Each simulator measures how long it was not run and how long it got no command: its arm, motors and bus are programs on
this computer, so a long gap means that the computer ran other programs instead. A trial that ended early says so.
"""

import json
import math
import threading
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import params_of
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.descent import DESCENT_TIMEOUT
from exo_gravity.core.vocabulary import NONE
from exo_gravity.lab.bag.content import Session
from exo_gravity.lab.inputs.node_checks import check_nodes, check_start
from exo_gravity.lab.inputs.parameter_file import load, stages, text_of
from exo_gravity.lab.processes import Launcher, Stopping
from exo_gravity.sim.script import Step, TrialScript

SETTLING = 0.5  # s between letting go and the position from which drift is measured
STOPPED = "stopped by the operator"
LEAD = 5.0  # s for a person to get ready when the arm is carried
BRIDGE_TIMEOUT = 5.0  # s from the recorder's first line, in which a bridge that runs already has reported ten times


class TrialScreen:
    """Follows a script through the recorder's lines.

    The screen of a running trial: the current step, the time left, and angles, torques and drift of each arm.

    It reads the lines of JSON that `recorder` prints ten times a second. If a simulator performs the script, its steps
    are in those lines. At a real arm a clock leads the person through the script.

    guided: whether a person performs the script.
    bridges: that must be active before the clock starts; none: all that are seen.
    lead: s from then to the first step, in a script that the clock leads; None if the steps are those of the simulator.
    on_progress: called with the step and the time left in it, s, once the clock has started.
    clock: s.
    """

    def __init__(
        self,
        script: TrialScript,
        guided: bool,
        console: Console,
        bridges: Collection[str] = (),
        lead: float | None = LEAD,
        on_progress: Callable[[int, float], None] = lambda step, left: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.script, self.guided, self.console, self.bridges, self.lead = script, guided, console, bridges, lead
        self.on_progress, self.clock = on_progress, clock
        self.done = False  #: the last step has ended
        self.status: dict[str, dict[str, Any]] = {}  #: of each node on /diagnostics
        self.faults: list[str] = []  #: warnings and errors of the nodes
        self._told: list[str] = []  # of them, printed before the arm is carried
        self._arms: dict[str, dict[str, Any]] = {}
        self._index = -1  # of the current step
        self._step_start = self._last_line = self.clock()
        self._first_line = math.inf
        self._start = math.inf  # of a script that the clock leads
        self._origin: dict[tuple[str, str], float] = {}  # rad, of arm and joint, from which drift is measured
        self._ending = ""
        #: shows `screen` on a terminal, and nothing elsewhere
        self.live = Live(
            console=self.console, auto_refresh=self.console.is_terminal, refresh_per_second=10,
            get_renderable=self.screen, transient=True,
        )  # fmt: skip

    def end(self, text: str) -> None:
        """Print `text`, and stop following the script."""
        self._ending = text
        self.console.print(text)

    def take(self, line: str) -> None:
        """Process one line of the recorder's JSON; ignore half a line, which a killed recorder leaves."""
        try:
            content = json.loads(line)
        except json.JSONDecodeError:
            return
        self._last_line = self.clock()
        self._first_line = min(self._first_line, self._last_line)
        self.status = content.pop("status", {})
        self.faults = content.pop("faults", [])
        self._arms = {name: arm for name, arm in content.items() if "position" in arm}
        if self.guided and self._start == math.inf:
            for fault in (fault for fault in self.faults if fault not in self._told):
                self._told.append(fault)
                self.console.print(f"until the arm is carried: {fault}", markup=False, soft_wrap=True)
        if not self._ending:
            self._follow([arm["step"]["step"] for arm in content.values() if "step" in arm])
            if self._start < math.inf:
                self.on_progress(self._index, self._left)

    @property
    def silence(self) -> float:
        """Time in s since the recorder's last line; 0 before its first."""
        return self.clock() - self._last_line if self._arms else 0.0

    @property
    def is_falling(self) -> bool:
        """Whether an arm is being let down."""
        return State.LETTING_DOWN.value in self._states.values()

    def message_of(self, key: str) -> str:
        """Return the message of the first bridge with a fault or, after its start has ended, a refusal; '' for none."""
        found = (name for name, values in self.status.items() if values.get(key, NONE) != NONE)
        return next((f"{name}: {self.status[name]['message']}" for name in found), "")

    def wait(self, stopped: Stopping, recorder_code: Callable[[], int | None], nodes: Future[Any]) -> str:
        """Wait until the script is done; return '' or why the wait ended earlier."""
        deadline = self.clock() + START_TIMEOUT + (self.lead or 0.0) + self.script.duration
        while not stopped.wait(0.05) and not nodes.done():
            if (code := recorder_code()) is not None:
                return f"the recorder ended with exit code {code} before the trial was done"
            if self.silence > RECORDER_TIMEOUT:
                return f"the recorder has sent no data for {RECORDER_TIMEOUT:g} s"
            # Those that are started may need longer until they report.
            if self.clock() - self._first_line > BRIDGE_TIMEOUT and not self.bridges and not self._states:
                return f"no can_bridge has reported on /diagnostics within {BRIDGE_TIMEOUT:g} s: no arm is carried here"
            if message := self.message_of("fault") or (not self.guided and self.message_of("refusal")):
                return message
            if self.done:
                stopped.wait(GRACE)
                return ""
            if self._start < math.inf and not self._all_active:
                return "an arm is not active any more"
            if self.clock() > deadline:
                return f"the trial did not finish in time: {'; '.join(self.faults) or 'no node reports a fault'}"
        return STOPPED if stopped.is_set() else ""

    @property
    def _step(self) -> Step | None:
        return self.script.steps[self._index] if 0 <= self._index < len(self.script.steps) else None

    @property
    def _left(self) -> float:
        """Time in s until the next step."""
        due = self._step_start + self._step.duration if self._step else self._start
        return max(0.0, due - self.clock())

    @property
    def _states(self) -> dict[str, Any]:
        """The state that each bridge reports, by its name."""
        return {name: values.get("state") for name, values in self.status.items() if name.endswith("can_bridge")}

    @property
    def _all_active(self) -> bool:
        return set(self.bridges) <= {*self._states} and {*self._states.values()} == {State.ACTIVE.value}

    def _follow(self, simulated_steps: list[int]) -> None:
        index, now = self._index, self.clock()
        if self.lead is None:
            index = min(simulated_steps, default=-1)
        elif self._start == math.inf:
            if self._all_active:
                self._start = now + self.lead
        elif now >= self._start:
            index = self.script.at(now - self._start)[0]
        if index != self._index:
            if self._origin:
                self.console.print(f"     drifted {self._drift():.2f} deg")
            if self._index < 0 and (names := next((arm.get("names") for arm in self._arms.values()), ())):
                self.console.print(f"     joints in order: {', '.join(names)}", soft_wrap=True)
            self._index, self._step_start, self._origin = index, now, {}
            if self._step:
                number = f"{index + 1}/{len(self.script.steps)}"
                self.console.print(f"{number:<5}{describe(self._step, self.guided)}", soft_wrap=True)
        elif not self._origin and now - self._step_start > SETTLING and self._step and self._step.action == "hold":
            self._origin = self._angles()
        self.done = index >= len(self.script.steps)

    def _drift(self) -> float:
        """Return the largest drift of any joint since it was let go, in degrees."""
        moved = (abs(now - self._origin.get(joint, now)) for joint, now in self._angles().items())
        return math.degrees(max(moved, default=0.0))

    def _angles(self) -> dict[tuple[str, str], float]:
        """Return the angle of each arm's joints in rad: others may publish joint states there, too."""
        named = {name: zip(arm["names"], arm["position"], strict=False) for name, arm in self._arms.items()}
        return {(name, joint): angle for name, joints in named.items() for joint, angle in joints}

    def screen(self) -> Group:
        """Return the changing part of the screen: time left, drift, next step, each arm, warnings and errors."""
        lines = [Text(self._headline(), style="bold")]
        for name, arm in self._arms.items():
            angles = " ".join(f"{math.degrees(angle):6.1f}" for angle in arm["position"])
            torques = " ".join(f"{torque:7.2f}" for torque in arm["effort"])
            lines.append(Text(f"     {name:<6} deg {angles}    Nm {torques}", no_wrap=True))
        lines += [Text(f"     {fault}", style="yellow") for fault in self.faults]
        return Group(*lines)

    def _headline(self) -> str:
        steps = self.script.steps
        if self._ending or self._index >= len(steps):
            return ""
        if self._index >= 0:
            then = describe(steps[self._index + 1], self.guided) if self._index + 1 < len(steps) else "done"
            drift = f"drift {self._drift():.2f} deg    " if self._origin else ""
            return f"     {self._left:.0f} s left    {drift}then: {then}"
        if self._start < math.inf:
            first = describe(steps[0], self.guided)
            return f"     take hold of the arm: in {self._left:.0f} s, {first}"
        return "     waiting for the arm to be carried"


def describe(step: Step, guided: bool) -> str:
    """Return a step as a sentence: an instruction for the person at the arm, or what the virtual wearer does."""
    angles, time = " ".join(f"{math.degrees(angle):.0f}" for angle in step.value), f"for {step.duration:g} s"
    pushed = "once, briefly" if step.duration < 1.0 else f"{time}, then let go"
    over = f"{angles} deg {'forward' if step.action == 'bow' else 'to the right'} in {step.duration:g} s"
    bring, then = ("bring", ", then let go") if guided else ("the wearer brings", "")
    said = {
        "hold": f"hands off {time}",
        "move": f"{bring} the arm to {angles} deg{then}",
        "push": f"push the arm {pushed}" if guided else "the wearer pushes the arm",
    }
    loaded = step.action == "load" and step.value[0]
    trunk = {
        "walk": f"walk {time}", "sit": "sit down hard", "bow": f"bow to {over}", "lean": f"lean to {over}",
        "load": f"take {loaded:g} kg into the hand" if loaded else "let go of the load",
    }  # fmt: skip
    return said.get(step.action, f"{'' if guided else 'the wearer: '}{trunk.get(step.action)}, and leave the arm alone")


RECORDER = "/recorder"
START_TIME = 1.0  # s for a panel to start the virtual wearer, once the recorder runs
START_TIMEOUT = 60.0  # s until the arm must be carried
GRACE = 0.5  # s recorded after the last step
RECORDER_TIMEOUT = 10.0  # s without a line from the recorder
LONG_GAP = 50.0  # ms; a simulated device loses time after such a stall


def check_bridges(params: Path, is_offline: bool) -> bool:
    """Check that a parameter file has a can_bridge, whose arm a trial follows, and that its nodes can start.

    Returns whether a person performs the script, because the file has no simulator.

    is_offline: none does, so that another can_bridge may hold the bus. Raises ParameterError, BusError.
    """
    nodes = load(params)
    if not stages(nodes)[0]:
        expected = f"a file with a can_bridge, whose arm a trial follows; it has {', '.join(nodes)}"
        raise ParameterError("params", str(params), expected)
    check_nodes(nodes) if is_offline else check_start(nodes)
    return not any(node.endswith("/simulator") for node in nodes)


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
            raise ParameterError("output", str(self.folder.parent), f"a writable folder ({error.strerror})") from None
        return path


def run_trial(trial: Trial, console: Console, stopped: Stopping, on_progress: Callable[[int, float], None]) -> str:
    """Run a trial that is prepared until the script is done, a fault latches or `stopped` is set.

    on_progress: as in `TrialScreen`.

    Returns '' or why it ended before the script. Raises ParameterError if a node refused its parameters or bus.
    """
    # On arms that are carried already the clock leads: a simulator's newest step may be that of an earlier trial.
    lead = LEAD if trial.guided else START_TIME if trial.params is None else None
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
        trouble = screen.wait(stopped, lambda: launcher.exit_code(RECORDER), nodes)
        down_by = time.monotonic() + DESCENT_TIMEOUT
        while screen.is_falling and screen.silence < 1.0 and time.monotonic() < down_by and not nodes.done():
            time.sleep(0.05)  # the recording shows how the arm comes down
        if not nodes.done():
            screen.end(f"{'letting the arm down and ' if trial.params else ''}closing the recording")
        ending.set()
    if dead := nodes.result():
        node, code = dead
        trouble = f"{node.lstrip('/')} ended with exit code {code}: {last_errors.get(node, f'see {path}')}"
        if code == 2:
            raise ParameterError("params", str(trial.params), f"a file whose nodes start ({trouble})")
        return trouble
    if trouble in ("", STOPPED):
        return trouble
    recorder = f": {last_errors[RECORDER]}" if RECORDER in last_errors else ""
    return f"{trouble}{recorder}{stall_of(screen.status)}"


def stall_of(status: Mapping[str, Mapping[str, Any]]) -> str:
    """Return, as a clause, which simulator or bridge was not run for long while a simulated trial failed, or ''.

    status: of each node on /diagnostics, as in the recorder's live lines.
    """
    for key, node in (("longest stall (ms)", "simulator"), ("longest silence (ms)", "can_bridge")):
        for name, values in status.items():
            if values.get("disconnected") == "no" and float(values[key]) >= LONG_GAP:  # a simulator's
                who = name.replace("simulator", node)
                return f"; {who} was not run for {values[key]} ms: this computer was too busy"
    return ""
