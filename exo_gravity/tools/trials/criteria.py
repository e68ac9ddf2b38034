"""The criteria of a trial: how far the arm may drift, and what counts as a hold."""

from __future__ import annotations

import math

from exo_gravity.core.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.tools.reporting.trial_report import Report

# One position code over a minute is 0.02 degrees, so the rate over a much shorter hold means little.
LONG_HOLD = 30.0  # s
MAX_RATE = 0.2  # deg/min


def hold_durations(script: TrialScript) -> list[float]:
    """Return the durations of the script's holds in s."""
    return [step.duration for step in script.steps if step.action == "hold"]


def criteria_for(script: TrialScript, max_rate: float | None) -> HoldCriteria:
    """Return the criteria for a script; max_rate: deg/min over a hold, None for the default."""
    if max_rate is not None:
        return HoldCriteria(max_rate=math.radians(max_rate) / 60.0)
    rate = MAX_RATE if min(hold_durations(script), default=0.0) >= LONG_HOLD else math.inf
    # A person at a real arm may also hold it still at other times, and only briefly.
    return HoldCriteria(max_rate=math.radians(rate) / 60.0, rated_from=LONG_HOLD)


def shortest_hold(script: TrialScript, guided: bool) -> float:
    """Return the shortest still phase in s that counts as a hold.

    A person holds the arm still for a moment before letting go, and lets go late: at least half a hold remains.
    """
    holds = hold_durations(script)
    return max(MIN_HOLD, min(holds) / 2.0) if guided and holds else MIN_HOLD


def missing_holds(script: TrialScript, report: Report) -> str:
    """Return which arm has fewer holds than the script, or ''.

    A real arm's recording has no script, so a hold in which the arm never came to rest leaves no other trace.
    """
    scripted = len(hold_durations(script))
    for recording, analysis in report.arms:
        if len(analysis.holds) < scripted:
            return f"{recording.name}: {len(analysis.holds)} of {scripted} holds were found"
    return ""
