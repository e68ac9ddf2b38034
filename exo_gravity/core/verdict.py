"""Whether an arm held: what a trial showed, against limits.

Drift is judged within any 10 s of a hold, over a whole hold where that is asked for, and from letting go to the end of
a scripted hold, so that an arm that fell at once and then hung still did not hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.recording import Recording
from exo_gravity.core.trial_analysis import TrialAnalysis


@dataclass(frozen=True)
class HoldCriteria:
    """How far a held arm may drift: rad within any 10 s, in a pose and after a push has settled; rad/s over a hold.

    max_offset: rad, from where it was let go to where it is at the end of a scripted hold. rated_from: s, the length
    from which on a hold is judged by its rate, since one position code over a short hold is a large rate already.
    """

    max_stray: float = math.radians(0.5)
    max_stray_after_push: float = math.radians(2.0)
    max_rate: float = math.inf
    max_offset: float = math.radians(2.0)
    rated_from: float = 0.0


def failures(recording: Recording, trial: TrialAnalysis, limits: HoldCriteria) -> list[str]:
    """Return one sentence for each way in which the arm did not hold; none if it held."""
    found = []
    if not trial.holds:
        never = "carried" if recording.carried == () else "still for long enough to count as a hold"
        found.append(f"the arm was never {never}")
    for hold in trial.holds:
        stray = limits.max_stray_after_push if hold.after == "push" else limits.max_stray
        for joint, name in enumerate(recording.joint_names):
            where = f"{hold.start:.1f}-{hold.end:.1f} s: {name}"
            if hold.stray[joint] > stray:
                found.append(f"{where} strayed {_degrees(hold.stray[joint])} within 10 s, more than {_degrees(stray)}")
            rate = 60.0 * hold.drift_rate[joint]
            if abs(rate) > 60.0 * limits.max_rate and hold.duration >= limits.rated_from:
                allowed = _degrees(60.0 * limits.max_rate)
                found.append(f"{where} drifted {_degrees(rate)} per minute, more than {allowed}")
    for motion in trial.motions:
        peak = np.max(np.abs(motion.peak))
        if motion.kind == "slip" and peak > limits.max_stray:
            where = f"{motion.start:.1f}-{motion.end:.1f} s: the arm"
            found.append(f"{where} slipped by {_degrees(peak)} while it was left alone")
    for release in trial.releases:
        where = f"{release.start:.1f}-{release.end:.1f} s: the arm"
        if not release.still:
            found.append(f"{where} was not still at the end of a hold")
        elif release.after != "push" and np.max(np.abs(release.offset)) > limits.max_offset:
            found.append(f"{where} went {_degrees(np.max(np.abs(release.offset)))} from where it was let go")
    return [f"{recording.name}: {sentence}" for sentence in found]


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.2f} degrees"
