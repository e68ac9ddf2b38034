# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A virtual wearer with muscles, who reaches and holds, rests in the device, lifts a share of their arm, and tires.

Their torque is the sum of an impedance about the path that they mean to follow, which muscles and reflexes give at
once, and of what they command: a share of their arm's weight, plus a slow correction. Commands come DELAY late and
through ACTIVATION, with noise in proportion to the torque (signal-dependent noise, Harris and Wolpert 1998).
"""

import bisect
import itertools
import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import NO_TORQUE, Torque
from exo_gravity.sim import STEP, VirtualWearer
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_wearer import path_between

STIFFNESS, DAMPING, INTEGRAL = (15.0, 25.0, 20.0, 8.0), (1.0, 2.0, 1.5, 0.5), (15.0, 25.0, 20.0, 8.0)
DELAY = 0.05  # s from command to muscle
ACTIVATION = 0.04  # s, time constant
NOISE = 0.03  # of the torque,
NOISE_TIME = 0.05  # s, low-passed
STRENGTH = 30.0  # Nm


class Phase(NamedTuple):
    """A pose that is reached in `move` s and held for `hold` s.

    lifted: the shares of their arm that the wearer lifts at the start and the end. rests: they let go while it is held.
    """

    pose: tuple[float, ...]
    move: float
    hold: float
    lifted: tuple[float, float]
    rests: bool = False


class Muscles(VirtualWearer):
    """Goes through `phases`, whatever the trunk's `script` does meanwhile.

    arm: the wearer's own. tilt: called for the trunk's true tilt. log: s, torque (4,) Nm and weight (4,) Nm at every
    step.
    """

    def __init__(
        self, script: TrialScript, phases: Sequence[Phase], arm: ArmModel, tilt: Callable[[], Tilt], seed: int
    ) -> None:
        super().__init__(script, STRENGTH)
        self.phases, self._arm, self._tilt = phases, arm, tilt
        self.log: list[tuple[float, Torque, Torque]] = []
        self._random = random.Random(seed)
        self._late: deque[list[float]] = deque([[0.0] * 4] * round(DELAY / STEP))
        self._active, self._noise, self._sum = [0.0] * 4, [0.0] * 4, [0.0] * 4
        self._from: Sequence[float] = NO_TORQUE
        self._index, self._end = -1, sum(phase.move + phase.hold for phase in phases)

    def idle(self, elapsed: float, duration: float) -> bool:
        """Return False: the muscles always have a torque."""
        return False

    def torque(self, elapsed: float, theta: Sequence[float], velocity: Sequence[float]) -> Torque:
        """Return the wearer's torque (4,) in Nm."""
        super().torque(elapsed, theta, velocity)  # follows the script's steps
        if elapsed < 0.0:
            self._from = tuple(theta)
        if not 0.0 <= elapsed < self._end:
            return NO_TORQUE
        index, since = phase_at(self.phases, elapsed)
        if index != self._index:
            self._from = self.phases[self._index].pose if index else self._from
            if index and self.phases[self._index].rests:
                self._from = tuple(theta)
            self._index = index
        phase = self.phases[index]
        held = min(1.0, max(0.0, since - phase.move - 0.3) / 0.5) if phase.rests else 0.0  # lets go
        lifted = phase.lifted[0] + (phase.lifted[1] - phase.lifted[0]) * min(1.0, since / (phase.move + phase.hold))
        weight = self._arm.torque(theta, self._tilt())
        path = path_between(self._from, phase.pose, since, phase.move)
        wanted, given = [], []
        for n, (position, speed) in enumerate(path):
            error = position - theta[n]
            total = (1.0 - held) * (self._sum[n] + INTEGRAL[n] * error * STEP)
            self._sum[n] = max(-STRENGTH, min(STRENGTH, total))
            wanted.append((1.0 - held) * (lifted * weight[n] + self._sum[n]))
            at_once = (1.0 - held) * STIFFNESS[n] * error
            self._active[n] += STEP / ACTIVATION * (self._late[0][n] - self._active[n])
            step = STEP / NOISE_TIME
            self._noise[n] += -step * self._noise[n] + math.sqrt(2.0 * step) * self._random.gauss(0.0, 1.0)
            whole = at_once + self._active[n] * (1.0 + NOISE * self._noise[n])
            yielding = (1.0 - held) * DAMPING[n] * (speed - velocity[n])  # also beyond their strength
            given.append(max(-STRENGTH, min(STRENGTH, whole)) + yielding)
        self._late.popleft()
        self._late.append(wanted)
        self.log.append((elapsed, tuple(given), weight))
        return tuple(given)


def phase_at(phases: Sequence[Phase], elapsed: float) -> tuple[int, float]:
    """Return the index of the phase at `elapsed` s, the last one after the end, and the time since it began."""
    ends = list(itertools.accumulate(phase.move + phase.hold for phase in phases))
    index = min(bisect.bisect_right(ends, elapsed), len(phases) - 1)
    return index, elapsed - (ends[index - 1] if index else 0.0)
