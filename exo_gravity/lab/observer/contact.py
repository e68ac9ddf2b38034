# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Contacts: a torque that comes faster than a person's does, as at a table's edge."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.numbers import Torque, for_joints
from exo_gravity.lab.observer.momentum import WearerEstimate, low_passed


@dataclass(frozen=True)
class ContactTuning:
    """What counts as a contact."""

    followed: float = 0.1  #: s, time constant of what a person's torque follows
    #: Nm beyond that, (n,): 1.3 times the most that `make study NAME=wearer` saw of reaching wearers
    least: Sequence[float] = (3.0, 5.0, 3.0, 1.5)
    pause: float = 1.0  #: s without another one, after which a contact is a new one


CONTACT = ContactTuning()


class ContactWatch:
    """Counts the contacts of one arm. last: time in s, joint and Nm of the newest, None before the first."""

    def __init__(self, tuning: ContactTuning = CONTACT) -> None:
        self.count = 0
        self.last: tuple[float, int, float] | None = None
        self._tuning = tuning
        self._slow: Torque = ()
        self._time = self._touched = -math.inf  # s

    def update(self, now: float, estimate: WearerEstimate) -> None:
        """Take the estimate at `now` s."""
        tuning = self._tuning
        dt, self._time = now - self._time, now
        if not 0.0 <= dt <= tuning.followed:
            self._slow, dt = estimate.torque, 0.0
        self._slow = low_passed(self._slow, estimate.torque, dt / tuning.followed)
        jumps = list(map(operator.sub, estimate.torque, self._slow))
        columns = zip(jumps, for_joints(tuning.least, len(jumps), max), estimate.distinguishable, strict=True)
        sizes = [abs(jump) / least if shown else 0.0 for jump, least, shown in columns]
        joint = max(range(len(sizes)), key=sizes.__getitem__)
        if sizes[joint] > 1.0:
            if now - self._touched > tuning.pause:
                self.count, self.last = self.count + 1, (now, joint, jumps[joint])
            self._touched = now
