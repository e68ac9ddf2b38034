"""The verdict on a trial: whether the arm held, by the criteria for drift.

Drift is judged within any 10 s of a hold, over the whole hold if a rate is given, and from release to the end of a
scripted hold. The last criterion fails an arm that falls at once and then hangs still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.trial.analysis import TrialAnalysis
from exo_gravity.core.trial.recording import Recording


@dataclass(frozen=True)
class HoldCriteria:
    """How far a held arm may drift.

    max_stray, max_stray_after_push: rad within any 10 s of a hold; the second applies to a hold after a push.
    max_rate: rad/s over a hold. max_offset: rad between release and the end of a scripted hold. rated_from: s, the
    shortest hold that is judged by its rate; over a shorter one a single position code is already a large rate.
    """

    max_stray: float = math.radians(0.5)
    max_stray_after_push: float = math.radians(2.0)
    max_rate: float = math.inf
    max_offset: float = math.radians(2.0)
    rated_from: float = 0.0


def failures(recording: Recording, trial: TrialAnalysis, criteria: HoldCriteria) -> list[str]:
    """Return one sentence for each criterion that the arm failed; an empty list if it held."""
    found = []
    if not trial.holds:
        never = "carried" if recording.carried == () else "still for long enough to count as a hold"
        found.append(f"the arm was never {never}")
    for hold in trial.holds:
        stray = criteria.max_stray_after_push if hold.after == "push" else criteria.max_stray
        for joint, name in enumerate(recording.joint_names):
            where = f"{hold.start:.1f}-{hold.end:.1f} s: {name}"
            if hold.stray[joint] > stray:
                found.append(f"{where} strayed {_degrees(hold.stray[joint])} within 10 s, more than {_degrees(stray)}")
            rate = 60.0 * hold.drift_rate[joint]
            if abs(rate) > 60.0 * criteria.max_rate and hold.duration >= criteria.rated_from:
                allowed = _degrees(60.0 * criteria.max_rate)
                found.append(f"{where} drifted {_degrees(rate)} per minute, more than {allowed}")
    for motion in trial.motions:
        peak = np.max(np.abs(motion.peak))
        if motion.kind == "slip" and peak > criteria.max_stray:
            where = f"{motion.start:.1f}-{motion.end:.1f} s: the arm"
            found.append(f"{where} slipped by {_degrees(peak)} during a hold")
    for release in trial.releases:
        where = f"{release.start:.1f}-{release.end:.1f} s: the arm"
        if not release.still:
            found.append(f"{where} was still moving at the end of a hold")
        elif release.after != "push" and np.max(np.abs(release.offset)) > criteria.max_offset:
            found.append(f"{where} moved {_degrees(np.max(np.abs(release.offset)))} from where it was let go")
    return [f"{recording.name}: {sentence}" for sentence in found]


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.2f} degrees"
