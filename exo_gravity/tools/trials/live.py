"""The screen of a running trial: the current step, the time left, and angles, torques and drift of each arm.

It reads the lines of JSON that `recorder` prints ten times a second. If a simulator performs the script, its steps are
in those lines. At a real arm a clock leads the person through the script.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Collection, Iterable
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from exo_gravity.core.safety.drive import State
from exo_gravity.core.trial.script import TRUNK_ACTIONS, Step, TrialScript

SETTLING = 0.5  # s between letting go and the position from which drift is measured
LEAD = 5.0  # s for a person to get ready when the arm is carried


class Progress:
    """Follows a script through the recorder's lines.

    guided: a person performs the script, led by the clock, which starts when all `bridges` are active. done: the last
    step has ended. status: of each node on /diagnostics. faults: warnings and errors of the nodes, as text.
    """

    def __init__(
        self,
        script: TrialScript,
        guided: bool,
        console: Console,
        bridges: Collection[str],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.done = False
        self.status: dict[str, dict[str, Any]] = {}
        self.faults: list[str] = []
        self._script = script
        self._guided = guided
        self._bridges = bridges
        self._console = console
        self._clock = clock
        self._arms: dict[str, dict[str, Any]] = {}
        self._index = -1  # of the current step
        self._step_start = self._last_line = clock()
        self._start = math.inf  # of a guided script
        self._origin: dict[str, list[float]] = {}  # position of each arm from which drift is measured
        self._ending = ""
        self._live = Live(console=console, refresh_per_second=10, get_renderable=self.screen, transient=True)

    def __enter__(self) -> Progress:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def end(self, text: str) -> None:
        """Print `text`, and stop following the script."""
        self._ending = text
        self._console.print(text)

    def take(self, line: str) -> None:
        """Process one line of the recorder's JSON; ignore half a line, which a killed recorder leaves."""
        try:
            content = json.loads(line)
        except json.JSONDecodeError:
            return
        self._last_line = self._clock()
        self.status = content.pop("status", {})
        self.faults = content.pop("faults", [])
        self._arms = {name: arm for name, arm in content.items() if "position" in arm}
        if not self._ending:
            self._follow([arm["step"]["step"] for arm in content.values() if "step" in arm])

    @property
    def silence(self) -> float:
        """Time in s since the recorder's last line; 0 before its first."""
        return self._clock() - self._last_line if self._arms else 0.0

    def _follow(self, simulated_steps: list[int]) -> None:
        index, now = self._index, self._clock()
        if not self._guided:
            index = min(simulated_steps, default=-1)
        elif self._start == math.inf:
            if self._all_active:
                self._start = now + LEAD
        elif now >= self._start:
            index = self._script.at(now - self._start)[0]
        if index != self._index:
            self._begin(index)
        elif not self._origin and now - self._step_start > SETTLING and self._holding:
            self._origin = {name: arm["position"] for name, arm in self._arms.items()}
        self.done = index >= len(self._script.steps)

    @property
    def _all_active(self) -> bool:
        states = {name: values.get("state") for name, values in self.status.items() if name.endswith("can_bridge")}
        return bool(states) and set(self._bridges) <= set(states) and set(states.values()) == {State.ACTIVE.value}

    def _begin(self, index: int) -> None:
        if self._origin:
            self._console.print(f"     drifted {self._drift():.2f} deg")
        self._index, self._step_start, self._origin = index, self._clock(), {}
        if index < len(self._script.steps):
            number = f"{index + 1}/{len(self._script.steps)}"
            self._console.print(f"{number:<5}{describe(self._script.steps[index], self._guided)}", soft_wrap=True)

    @property
    def _holding(self) -> bool:
        return 0 <= self._index < len(self._script.steps) and self._script.steps[self._index].action == "hold"

    def _drift(self) -> float:
        """Return the largest drift of any joint since it was let go, in degrees."""
        moved = (
            abs(now - then)
            for name, origin in self._origin.items()
            for now, then in zip(self._arms.get(name, {"position": origin})["position"], origin, strict=True)
        )
        return math.degrees(max(moved, default=0.0))

    def screen(self) -> Group:
        """Return the changing part of the screen: time left, drift, next step, each arm, warnings and errors."""
        lines = [Text(self._headline(), style="bold")]
        for name, arm in self._arms.items():
            angles, torques = columns(map(math.degrees, arm["position"]), 1), columns(arm["effort"], 2)
            lines.append(Text(f"     {name:<6} deg {angles}    Nm {torques}", no_wrap=True))
        lines += [Text(f"     {fault}", style="yellow") for fault in self.faults]
        return Group(*lines)

    def _headline(self) -> str:
        steps, now = self._script.steps, self._clock()
        if self._ending or self._index >= len(steps):
            return ""
        if self._index >= 0:
            left = max(0.0, steps[self._index].duration - now + self._step_start)
            then = describe(steps[self._index + 1], self._guided) if self._index + 1 < len(steps) else "done"
            drift = f"drift {self._drift():.2f} deg    " if self._origin else ""
            return f"     {left:.0f} s left    {drift}then: {then}"
        if self._start < math.inf:
            first = describe(steps[0], self._guided)
            return f"     take hold of the arm: in {max(0.0, self._start - now):.0f} s, {first}"
        return "     waiting for the arm to be carried"


def describe(step: Step, guided: bool) -> str:
    """Return a step as a sentence: an instruction for the person at the arm, or what the virtual wearer does."""
    if step.action == "move":
        pose = " ".join(f"{math.degrees(angle):.0f}" for angle in step.value)
        return f"bring the arm to {pose} deg, then let go" if guided else f"the wearer brings the arm to {pose} deg"
    if step.action == "push":
        pushed = "once, briefly" if step.duration < 1.0 else f"for {step.duration:g} s, then let go"
        return f"push the arm {pushed}" if guided else "the wearer pushes the arm"
    if step.action in TRUNK_ACTIONS:
        return _of_trunk(step) if guided else f"the wearer: {_of_trunk(step)}"
    return f"hands off for {step.duration:g} s"


def _of_trunk(step: Step) -> str:
    if step.action == "walk":
        return f"walk for {step.duration:g} s, and leave the arm alone"
    if step.action == "sit":
        return "sit down hard, and leave the arm alone"
    angle = math.degrees(step.value[0])
    way = "forward" if step.action == "bow" else "to the right"
    return f"{step.action} to {angle:.0f} deg {way} in {step.duration:g} s, and leave the arm alone"


def columns(values: Iterable[float], digits: int) -> str:
    """Return `values` in columns, with `digits` decimal places."""
    return " ".join(f"{value:{digits + 5}.{digits}f}" for value in values)
