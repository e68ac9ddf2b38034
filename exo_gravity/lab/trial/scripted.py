# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What is asked of a trial by its script: how long and how still the arm must be held."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.sim.script import TrialScript

if TYPE_CHECKING:
    from exo_gravity.lab.bag.content import Bag
    from exo_gravity.lab.report.trial_report import Report

# One position code over a minute is 0.02 degrees, so the rate over a much shorter hold means little.
LONG_HOLD = 30.0  # s
MAX_RATE = 0.2  # deg/min


def packaged_trials() -> dict[str, Path]:
    """Return the scripts that come with the package, by name."""
    folder = packaged_config("trials/demo.yaml").parent
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def read_script(name: str) -> tuple[Path, TrialScript]:
    """Return path and content of a packaged script or of a YAML file. Raises ParameterError."""
    packaged = packaged_trials()
    if name not in packaged and not name.endswith((".yaml", ".yml")):
        raise ParameterError("trial", name, f"{', '.join(packaged)} or a YAML file with a script")
    path = packaged.get(name, Path(name))
    return path.resolve(), TrialScript.read(path)


def analysed(bag: "Bag", script: TrialScript, guided: bool, trouble: str) -> tuple["Report", str]:
    """Return the report of a trial, and what is wrong with the trial, by default its `trouble`.

    If every hold of the script is long enough, the drift rate is limited too.
    """
    from exo_gravity.lab.report import trial_report  # by packages that only trials with a report need

    holds = [step.duration for step in script.steps if step.action == "hold"]
    rate = MAX_RATE if min(holds, default=0.0) >= LONG_HOLD else math.inf
    # A person at a real arm may also hold it still at other times, and only briefly.
    criteria = HoldCriteria(max_rate=math.radians(rate) / 60.0, rated_from=LONG_HOLD)
    # A person holds the arm still for a moment before letting go, and lets go late: at least half a hold remains.
    min_hold = max(MIN_HOLD, min(holds) / 2.0) if guided and holds else MIN_HOLD
    report = trial_report.analyse(bag, criteria, min_hold, trouble)
    # A real arm's recording has no script, so a hold in which the arm never came to rest leaves no other trace.
    found = {recording.name: len(analysis.holds) for recording, analysis in report.arms}
    missing = [f"{arm}: {count} of {len(holds)} holds were found" for arm, count in found.items() if count < len(holds)]
    if not guided or trouble or not missing:
        return report, trouble
    return replace(report, notes=(*report.notes, *missing)), missing[0]
