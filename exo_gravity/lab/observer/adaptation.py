# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Support that adapts: it rises while the arm sinks, and then decays. Why so: docs/wearer_torque.md.

With w (n,) Nm, the torque that carries the wearer's arm,

    speed = sum w . theta' / |w|                   rad/s, upwards, from the joints' angles, low-passed by `mean`
    support' = - rise * speed / full - (support - set support) / memory

within the set support and 1; the first term stays within -lift * rise and rise. So lifting takes back part of what
sinking gave: at a support of at most 1, only a person can lift the arm. A motion faster than `reach` is a movement, not
sinking. Sinking counts only while the wearer's share lies between 0 and what is left to them. That excludes a hand that
presses the arm down, and motors that are off. While the share is unknown, the support falls to the set one, by `rise`
per second.

Assistance as needed with forgetting: Wolbrecht, Chan, Reinkensmeyer and Bobrow, IEEE TNSRE 2008.
"""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.support import REQUEST
from exo_gravity.core.numbers import COVER, Torque
from exo_gravity.lab.observer.momentum import OBSERVER, WearerEstimate
from exo_gravity.lab.observer.share import SHARE, RunningShare, Shares


@dataclass(frozen=True)
class AdaptationTuning:
    """How fast the support rises and is forgotten, and what counts as sinking."""

    mean: float = 1.0  #: s, time constant of the speed
    rise: float = 0.04  #: of the wearer's arm per s, while it sinks as fast as `full`, or faster
    full: float = 0.01  #: rad/s
    lift: float = 0.5  #: of `rise` at most, while the arm is lifted
    memory: float = 60.0  #: s, time constant with which a raised support is forgotten
    reach: float = 0.2  #: rad/s of any joint: faster is a movement
    #: of the wearer's arm: half the width of the share's 95 % band beyond which it says nothing
    #: (as much of it as `calibrate wearer` cannot know, 0.23, fits in; that of the body-mass table, 0.29, does not)
    widest: float = 0.28


ADAPTATION = AdaptationTuning()


class SupportAdaptation:
    """How much of the wearer's arm is to be carried, from one estimate of their torque to the next.

    support: 0..1, at present. requested: 0..1, the same as the compensator is asked for it, in steps that leave it time
    for a guided change; None while nothing adapts. problem: why the support cannot rise, or ''. shares: the wearer's,
    None if nothing is estimated; known without an adaptation, too.
    """

    def __init__(self, tuning: AdaptationTuning = ADAPTATION) -> None:
        self.support = 0.0
        self.requested: float | None = None
        self.problem = ""
        self.shares: Shares | None = None
        self._tuning = tuning
        self._running = RunningShare()
        self._time = self._due = -math.inf  # s
        self._theta: Sequence[float] | None = None
        self._speed = 0.0  # rad/s, upwards

    def update(
        self,
        now: float,
        joints: Sequence[Sequence[float]] | None,
        estimate: WearerEstimate | None,
        settings: Settings,
    ) -> None:
        """Take an estimate at `now` s.

        joints: angles (n,) rad and velocities (n,) rad/s, None if they are not known.
        estimate: None if there is none.
        settings: the compensator's parameters.
        """
        dt, self._time = now - self._time, now
        is_running = 0.0 < dt <= OBSERVER.max_gap
        if is_running and joints and estimate:
            self.shares = self._running.update(dt, estimate)
        else:
            self._running, self.shares = RunningShare(), None
            self._theta, self._speed = None, 0.0
        if not settings.is_adaptive or dt > REQUEST.expires:
            self.requested = None
        in_force = max(settings.support, self.requested or 0.0)
        if not settings.is_adaptive or not is_running:
            self._theta, self._speed = None, 0.0
            self.support, self.problem = in_force, ""
            return
        sunk = 0.0
        if joints and estimate:
            sunk = self._sunk(dt, joints, estimate.weight, 1.0 - in_force)
        else:
            self.problem = "the wearer's torque is not known"
        rise = self._tuning.rise
        fall = rise if self.problem else (self.support - settings.support) / self._tuning.memory
        self.support = max(settings.support, min(1.0, self.support + dt * (rise * sunk - fall)))
        self.requested = in_force
        if now >= self._due and abs(self.support - in_force) >= REQUEST.least_change:
            self.requested, self._due = self.support, now + REQUEST.pause

    def _sunk(self, dt: float, joints: Sequence[Sequence[float]], weight: Torque, asked: float) -> float:
        """Return how fast the arm sinks as a share of `full`, at most 1, and at least -`lift` while it is lifted.

        asked: share of their arm that is left to the wearer.
        """
        theta, velocity = joints
        tuning = self._tuning
        moved = map(operator.sub, theta, self._theta or theta)
        self._theta, part = theta, dt / (tuning.mean + dt)
        size = math.hypot(*weight)
        rise = sum(map(operator.mul, weight, moved)) / max(size, SHARE.least_weight)
        is_moved = max(map(abs, velocity)) > tuning.reach
        self._speed = 0.0 if is_moved else self._speed + part * (rise / dt - self._speed)
        self.problem = ""
        share, deviation = self.shares.whole if self.shares else (math.nan, math.nan)
        if math.isnan(share):  # the arm hangs
            return 0.0
        band = COVER * float(deviation)
        if band > tuning.widest:
            self.problem = f"the wearer's share is known to +-{100.0 * band:.0f} % only"
        sunk = max(-tuning.lift, min(1.0, -self._speed / tuning.full))
        return sunk if sunk < 0.0 or (not self.problem and -band < share < asked + band) else 0.0
