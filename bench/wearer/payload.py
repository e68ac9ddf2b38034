# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Loads in the hand of random calibrated devices with a relaxed wearer, weighed.

A hand brings the arm to a pose, and lets go of it soon after a weighing has begun: of the empty hand, then of each of
MASSES.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from exo_gravity.core.compensation.compensator import JOINTS, Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.weighing import Weighed, Weighing, refusal
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim.script import TrialScript

from ..device_study import Row
from .devices import Worn
from .study import RATE, WornImu

MASSES = (0.2, 1.0, 2.0)  # kg
POSE = np.array((0.0, 0.15, 0.0, 0.8))  # rad: the upper arm hangs, the elbow is bent
SPREAD = 0.1  # rad, of the pose
DELAY, MOVE, HOLD = 2.0, 2.5, 25.0  # s
RELEASE = 0.5  # s after which the hand lets go of an arm that is weighed
LEAST_ERROR, LARGEST_SHARE = 0.03, 0.05  # kg, and of the mass

Weighings = list[Weighed | None]  # of the empty hand, then of MASSES


class Balance(Compensator):
    """A compensator that weighs at `times`, s after the motors of `trial` are on.

    texts: what each weighing said; results: None for a weighing without one.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self.times: list[float] = []
        self.trial: OfflineTrial | None = None
        self.results: Weighings = []
        self.texts: list[str] = []
        self._weighing: Weighing | None = None

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the answer that the bridge gets."""
        if self.trial and self.times and now >= self.trial._start - DELAY + self.times[0]:
            self.times.pop(0)
            weighing = Weighing(self.settings, JOINTS, RATE, self._weighing.empty if self._weighing else None)
            problem = refusal(self.settings, (), RATE) or self.weigh(weighing)
            assert not problem, problem
            self._weighing = weighing
        answer = super().step(now, theta, velocity)
        if self._weighing and self._weighing.is_over and len(self.texts) < 1 + len(MASSES) - len(self.times):
            self.texts.append(self._weighing.text)
            self.results.append(self._weighing.result)
        return answer


def weigh(worn: Worn) -> Weighings:
    """Weigh the empty hand and each of MASSES; return what was found, None for a weighing without a result."""
    pose = (POSE + np.random.default_rng(worn.seed).uniform(-SPREAD, SPREAD, 4)).tolist()
    rest: list[dict[str, Any]] = [{"move": pose, "over": MOVE}, {"hold": HOLD}]
    steps = [*rest, *(step for mass in MASSES for step in ({"load": mass, "over": 0.1}, *rest))]
    cycle = MOVE + HOLD + 0.1
    settings = replace(worn.settings, support=1.0)
    device, motors = worn.device(), worn.motors
    limits = Limits(JOINTS, max_effort=settings.max_effort, max_velocity=(20.0,) * 4, sign_check_torque=0.0)
    script = TrialScript.parse({"name": "payload", "steps": steps})
    compensator = Balance(settings)
    setup = ArmSetup(worn.side, device, motors, limits, settings, RATE, WornImu(worn))
    trial = OfflineTrial(setup, script, DELAY, compensator)
    first = DELAY + MOVE - RELEASE
    compensator.times = [first + n * cycle for n in range(1 + len(MASSES))]
    compensator.trial = trial
    trial.run()
    return compensator.results


def verdict(found: Sequence[Weighings]) -> list[Row]:
    """Return the rows of the table."""
    rows = []
    for number, mass in enumerate(MASSES, start=1):
        pairs = [(results[0], results[number]) for results in found if len(results) > number]
        errors = [loaded.mass - empty.mass - mass for empty, loaded in pairs if empty and loaded]
        refused = len(found) - len(errors)
        most = max(LEAST_ERROR, LARGEST_SHARE * mass)
        worst = max(map(abs, errors), default=float("nan"))
        within = sum(abs(error) <= most for error in errors)
        shown = f"{1000.0 * worst:.0f} g at most; {within} of {len(errors)} within, {refused} refused"
        rows.append(Row(f"load of {mass:g} kg, error", shown, f"{1000.0 * most:.0f} g", within == len(errors) > 0))
    empty = [results[0] for results in found if results and results[0]]
    rows.append(Row("empty hand", f"{1000.0 * max(abs(one.mass) for one in empty):.0f} g at most", "", True))
    return rows
