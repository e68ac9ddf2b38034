"""What a trial shows while it runs: the step under way, the time left, and of each arm angles, torques and drift.

It reads the lines of JSON that the `recorder` writes ten times a second. Where a simulator carries out the script,
the recorder passes its steps on; at a real arm the script's own clock tells the person what to do.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from exo_gravity.core.trial_script import Step, TrialScript

SETTLING = 0.5  # s after letting go before the live drift is counted from
LEAD = 5.0  # s for a person to get ready once the arm is carried


class Progress:
    """Follows a script through the recorder's lines.

    done: the last step has ended. faults: what the nodes say is wrong. guided: nobody but this clock leads the arm.
    """

    def __init__(
        self, script: TrialScript, guided: bool, console: Console, clock: Callable[[], float] = time.monotonic
    ):
        self.done = False
        self.faults: list[str] = []
        self._script = script
        self._guided = guided
        self._console = console
        self._clock = clock
        self._arms: dict[str, dict[str, Any]] = {}
        self._index = -1  # of the step under way
        self._since = self._heard = clock()
        self._start = math.inf  # of the script, where it is guided
        self._origin: dict[str, list[float]] = {}  # position of each arm when its drift began to count
        self._ending = ""
        self._live = Live(console=console, refresh_per_second=10, get_renderable=self.screen, transient=True)

    def __enter__(self) -> Progress:
        if self._console.is_terminal:
            self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if self._console.is_terminal:
            self._live.__exit__(*error)

    def end(self, text: str) -> None:
        """Show `text` in place of the steps, which count no longer."""
        self._ending = text
        self._console.print(text)

    def take(self, line: str) -> None:
        """Take one line of the recorder's JSON; half a line, which one that is killed leaves, is let go."""
        try:
            content = json.loads(line)
        except json.JSONDecodeError:
            return
        self._heard = self._clock()
        self.faults = content.pop("faults", [])
        self._arms = {name: arm for name, arm in content.items() if "position" in arm}
        if not self._ending:
            self._follow([arm["step"]["step"] for arm in content.values() if "step" in arm])

    @property
    def silence(self) -> float:
        """Time in s since the recorder's last line; 0 before its first."""
        return self._clock() - self._heard if self._arms else 0.0

    def _follow(self, told: list[int]) -> None:
        index, now = self._index, self._clock()
        if not self._guided:
            index = min(told, default=-1)
        elif self._start == math.inf:
            if self._arms and not self.faults:
                self._start = now + LEAD
        elif now >= self._start:
            index = self._script.at(now - self._start)[0]
        if index != self._index:
            self._begin(index)
        elif not self._origin and now - self._since > SETTLING and self._holding:
            self._origin = {name: arm["position"] for name, arm in self._arms.items()}
        self.done = index >= len(self._script.steps)

    def _begin(self, index: int) -> None:
        if self._origin:
            self._console.print(f"     drifted {self._drift():.2f} deg")
        self._index, self._since, self._origin = index, self._clock(), {}
        if index < len(self._script.steps):
            number = f"{index + 1}/{len(self._script.steps)}"
            self._console.print(f"{number:<5}{describe(self._script.steps[index], self._guided)}", soft_wrap=True)

    @property
    def _holding(self) -> bool:
        return 0 <= self._index < len(self._script.steps) and self._script.steps[self._index].action == "hold"

    def _drift(self) -> float:
        """Return the largest change of any joint since it was let go, in degrees."""
        moved = (
            abs(now - then)
            for name, origin in self._origin.items()
            for now, then in zip(self._arms.get(name, {"position": origin})["position"], origin, strict=True)
        )
        return math.degrees(max(moved, default=0.0))

    def screen(self) -> Group:
        """Return what changes: the time left and the drift, what comes next, each arm, and what is wrong."""
        lines = [Text(self._headline(), style="bold")]
        for name, arm in self._arms.items():
            angles, torques = fours(map(math.degrees, arm["position"]), 1), fours(arm["effort"], 2)
            lines.append(Text(f"     {name:<6} deg {angles}    Nm {torques}", no_wrap=True))
        lines += [Text(f"     {fault}", style="yellow") for fault in self.faults]
        return Group(*lines)

    def _headline(self) -> str:
        steps, now = self._script.steps, self._clock()
        if self._ending or self._index >= len(steps):
            return ""
        if self._index >= 0:
            left = max(0.0, steps[self._index].duration - now + self._since)
            then = describe(steps[self._index + 1], self._guided) if self._index + 1 < len(steps) else "done"
            drift = f"drift {self._drift():.2f} deg    " if self._origin else ""
            return f"     {left:.0f} s left    {drift}then: {then}"
        if self._start < math.inf:
            first = describe(steps[0], self._guided)
            return f"     take hold of the arm: in {max(0.0, self._start - now):.0f} s, {first}"
        return "     waiting for the arm to be carried"


def describe(step: Step, guided: bool) -> str:
    """Return what a step asks, for a reader or for the person at the arm."""
    if step.action == "move":
        pose = " ".join(f"{math.degrees(angle):.0f}" for angle in step.value)
        return f"bring the arm to {pose} deg, then let go" if guided else f"the wearer brings the arm to {pose} deg"
    if step.action == "push":
        pushed = "once, briefly" if step.duration < 1.0 else f"for {step.duration:g} s, then let go"
        return f"push the arm {pushed}" if guided else "the wearer pushes the arm"
    return f"hands off for {step.duration:g} s"


def fours(values: Iterable[float], digits: int) -> str:
    """Return numbers in columns."""
    return " ".join(f"{value:{digits + 5}.{digits}f}" for value in values)
