"""Support that adapts: it rises while the arm sinks, and then decays. Why so: docs/wearer_torque.md.

With w (4,) Nm, the torque that carries the wearer's arm,

    speed = sum w . theta' / |w|                   rad/s, upwards, from the joints' angles, low-passed by MEAN
    support' = - RISE * speed / FULL - (support - `support`) / MEMORY

within `support` and 1; the first term stays within -LIFT * RISE and RISE. So lifting takes back part of what sinking
gave: at a support of at most 1, only a person can lift the arm. A motion faster than REACH is a movement, not sinking.
Sinking counts only while the wearer's share lies between 0 and what is left to him. That excludes a hand that presses
the arm down, and motors that are off. While the share is unknown, the support falls to `support`, by RISE per second.

Assistance as needed with forgetting: Wolbrecht, Chan, Reinkensmeyer and Bobrow, IEEE TNSRE 2008.
"""

import math
import operator
from collections.abc import Sequence

from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.compensation.guidance import GUIDANCE
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.lab.observer.momentum import COVER, MAX_GAP, WearerEstimate
from exo_gravity.lab.observer.share import LEAST_WEIGHT, RunningShare

MEAN = 1.0  # s, time constant of the speed
RISE, FULL = 0.04, 0.01  # of the wearer's arm per s, while it sinks at this speed in rad/s, or faster,
LIFT = 0.5  # of that at most, while it is lifted
MEMORY = 60.0  # s, time constant with which a raised support is forgotten
REACH = 0.2  # rad/s of any joint
WIDEST = 0.25  # of the wearer's arm: half the width of the share's 95 % band beyond which it says nothing
LEAST_CHANGE = 0.005  # of the wearer's arm


class SupportAdaptation:
    """How much of the wearer's arm is to be carried, from one estimate of his torque to the next.

    support: 0..1. problem: why it cannot rise, or ''. share: the wearer's share as `RunningShare` returns it, known
    without an adaptation, too.
    """

    def __init__(self) -> None:
        self.support = 0.0
        self.problem = ""
        self.share: tuple[float, float] | None = None
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
    ) -> bool:
        """Take an estimate at `now` s; return whether the compensator is to carry `support` from now on.

        joints: angles (4,) rad and velocities (4,) rad/s. estimate: None if there is none. settings: in use.
        """
        dt, self._time = now - self._time, now
        is_running = 0.0 < dt <= MAX_GAP
        if is_running and joints and estimate:
            self.share = self._running.update(dt, estimate)
        else:
            self._running, self.share = RunningShare(), None
            self._theta, self._speed = None, 0.0
        if settings.mode != "zero_g" or not settings.support_adapts or not is_running:
            self._theta, self._speed = None, 0.0
            self.support, self.problem = settings.support_now, ""
            return False
        sunk = 0.0
        if joints and estimate:
            sunk = self._sunk(dt, joints, estimate.weight, 1.0 - settings.support_now)
        else:
            self.problem = "the wearer's torque is not known"
        fall = RISE if self.problem else (self.support - settings.support) / MEMORY
        self.support = max(settings.support, min(1.0, self.support + dt * (RISE * sunk - fall)))
        if now < self._due or abs(self.support - settings.support_now) < LEAST_CHANGE:
            return False
        self._due = now + GUIDANCE.fade_time  # one guided change after the other
        return True

    def _sunk(self, dt: float, joints: Sequence[Sequence[float]], weight: Torque, asked: float) -> float:
        """Return how fast the arm sinks as a share of FULL, at most 1, and at least -LIFT while it is lifted.

        asked: share of his arm that is left to the wearer.
        """
        theta, velocity = joints
        moved = map(operator.sub, theta, self._theta or theta)
        self._theta, part = theta, dt / (MEAN + dt)
        size = math.hypot(*weight)
        rise = sum(map(operator.mul, weight, moved)) / max(size, LEAST_WEIGHT)
        self._speed = 0.0 if max(map(abs, velocity)) > REACH else self._speed + part * (rise / dt - self._speed)
        self.problem = ""
        if self.share is None:  # the arm hangs
            return 0.0
        share, band = self.share[0], COVER * self.share[1]
        if band > WIDEST:
            self.problem = f"the wearer's share is known to +-{100.0 * band:.0f} % only"
        sunk = max(-LIFT, min(1.0, -self._speed / FULL))
        return sunk if sunk < 0.0 or (not self.problem and -band < share < asked + band) else 0.0
