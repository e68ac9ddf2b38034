# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The screen of a running trial: the current step, the time left, and angles, torques and drift of each arm.

It reads the lines of JSON that `recorder` prints ten times a second. If a simulator performs the script, its steps are
in those lines. At a real arm a clock leads the person through the script.
"""

import json
import math
import time
from collections.abc import Callable, Collection
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from exo_gravity.core.safety.command import State
from exo_gravity.core.vocabulary import NONE
from exo_gravity.sim.script import Step, TrialScript

SETTLING = 0.5  # s between letting go and the position from which drift is measured
LEAD = 5.0  # s for a person to get ready when the arm is carried
BRIDGE_TIMEOUT = 5.0  # s from the recorder's first line, in which a bridge that runs already has reported ten times


class TrialScreen:
    """Follows a script through the recorder's lines.

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
        self._arms: dict[str, dict[str, Any]] = {}
        self._index = -1  # of the current step
        self._step_start = self._last_line = self.clock()
        self._first_line = math.inf
        self._start = math.inf  # of a script that the clock leads
        self._origin: dict[str, list[float]] = {}  # position of each arm from which drift is measured
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

    @property
    def has_no_bridge(self) -> bool:
        """Whether no bridge reports although all nodes run already. Those that are started may need longer."""
        is_late = self.clock() - self._first_line > BRIDGE_TIMEOUT
        return is_late and not self.bridges and not self._states

    @property
    def is_let_down(self) -> bool:
        """Whether the clock has started and not every arm is active any more."""
        return self._start < math.inf and not self._all_active

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
            self._index, self._step_start, self._origin = index, now, {}
            if self._step:
                number = f"{index + 1}/{len(self.script.steps)}"
                self.console.print(f"{number:<5}{describe(self._step, self.guided)}", soft_wrap=True)
        elif not self._origin and now - self._step_start > SETTLING and self._step and self._step.action == "hold":
            self._origin = {name: arm["position"] for name, arm in self._arms.items()}
        self.done = index >= len(self.script.steps)

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
    alone = f"{'' if guided else 'the wearer: '}{trunk.get(step.action)}, and leave the arm alone"
    return said.get(step.action, alone)
