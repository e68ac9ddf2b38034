"""Contact: the estimate of the wearer's torque changes faster than a person's does, as at a table's edge."""

import math

from exo_gravity.core.model.gravity import NO_TORQUE
from exo_gravity.core.observer.momentum import WearerEstimate

SLOW = 0.1  # s, time constant of what a person's torque follows,
LEAST = (3.0, 5.0, 3.0, 1.5)  # Nm beyond that: 1.3 times the most that `make wearer-study` saw of reaching wearers
PAUSE = 1.0  # s without another one, after which a contact is a new one


class ContactWatch:
    """Counts the contacts of one arm. last: time in s, joint (0..3) and Nm of the newest, None before the first."""

    def __init__(self) -> None:
        self.count = 0
        self.last: tuple[float, int, float] | None = None
        self._slow = NO_TORQUE
        self._time = self._touched = -math.inf  # s

    def update(self, now: float, estimate: WearerEstimate) -> None:
        """Take the estimate at `now` s."""
        dt, self._time = now - self._time, now
        if not 0.0 <= dt <= SLOW:
            self._slow, dt = estimate.torque, 0.0
        pairs = zip(self._slow, estimate.torque, strict=True)
        self._slow = tuple([old + dt / SLOW * (new - old) for old, new in pairs])
        jumps = [new - old for new, old in zip(estimate.torque, self._slow, strict=True)]
        columns = zip(jumps, LEAST, estimate.distinguishable, strict=True)
        sizes = [abs(jump) / least if shown else 0.0 for jump, least, shown in columns]
        joint = max(range(len(sizes)), key=sizes.__getitem__)
        if sizes[joint] > 1.0:
            if now - self._touched > PAUSE:
                self.count, self.last = self.count + 1, (now, joint, jumps[joint])
            self._touched = now
