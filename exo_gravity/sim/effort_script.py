"""The tasks of the effort study as steps of a trial script, and their efforts from the log of the true motion.

In a study on nodes the virtual wearer of `simulator` performs this script, and `truth` logs his torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.effort import Effort
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.sim.arm import STEP
from exo_gravity.sim.effort import EffortWearer, Sweep, Task, task_effort
from exo_gravity.sim.effort_study import RATE, TASKS
from exo_gravity.sim.truth import RECORD
from exo_gravity.sim.virtual_wearer import VirtualWearer

APPROACH = 2.0  # s to bring the arm to the first pose of a task
NAMED = {task.name: task for task in TASKS}


@dataclass(frozen=True)
class _Running:
    """The task that the wearer performs, in step `index` of the script."""

    index: int
    wearer: EffortWearer


class ScriptedWearer(VirtualWearer):
    """Performs a script with tasks. Raises ParameterError where a task is unknown."""

    def __init__(self, script: TrialScript) -> None:
        super().__init__(script)
        for number, step in enumerate(script.steps):
            if step.action == "task" and step.name not in NAMED:
                raise ParameterError(f"steps[{number}].task", step.name, f"one of {', '.join(NAMED)}")
        self._running: _Running | None = None

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm `elapsed` s after the start of the script."""
        index, since = self.script.at(max(0.0, elapsed))
        if elapsed < 0.0 or index == len(self.script.steps) or self.script.steps[index].action != "task":
            return super().torque(elapsed, theta, velocity)
        if self._running is None or self._running.index != index:
            self._running = _Running(index, EffortWearer(NAMED[self.script.steps[index].name]))
        self.step, self._elapsed = index, elapsed
        return self._running.wearer.torque(since, theta, velocity)


def effort_script(tasks: Sequence[Task | Sweep]) -> dict[str, Any]:
    """Return the script, as in a trial's YAML file, in which the wearer performs `tasks`."""
    steps: list[dict[str, Any]] = []
    for task in tasks:
        steps.append({"move": list(task.at(0.0)[0]), "over": APPROACH})
        steps.append({"task": task.name, "over": task.duration})
    return {"name": "effort", "steps": steps}


def efforts_of_truth(path: Path, script: TrialScript) -> dict[str, Effort]:
    """Return the effort of each task of `script` from the log at `path`; a task that was cut short is left out."""
    records = np.fromfile(path, RECORD)
    every = round(1.0 / (RATE * STEP))
    found = {}
    for number, step in enumerate(script.steps):
        chosen = records[records["step"] == number]
        if step.action == "task" and len(chosen) * STEP > step.duration - 0.5:
            torque, velocity = (chosen[name][::every].astype(float) for name in ("wearer", "velocity"))
            found[step.name] = task_effort(NAMED[step.name], torque, velocity, RATE)
    return found
