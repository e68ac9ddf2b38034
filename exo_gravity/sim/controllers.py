# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Controllers in the process of the loop that calls them: samples in, efforts out, without messages."""

import random
from collections import deque
from collections.abc import Callable, Sequence

from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.command import NO_EFFORTS, Efforts
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import NO_REASON
from exo_gravity.hardware.control_loop import Controller
from exo_gravity.sim.virtual_time import VirtualClock

LATE = 0.02  # s by which a busy computer is late


class SampleController:
    """Answers the samples of a cycle at once; the next cycle applies the efforts.

    limits: of the arm, which say when a motor is silent: then there is no answer, and the last one grows old.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._newest = NO_EFFORTS

    def efforts(self, latest: float) -> Efforts:
        """Return the newest efforts, without waiting."""
        return self._newest

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Answer the newest sample of each joint, unless a motor is silent."""
        if not any(self._limits.is_silent(now, sample) for sample in samples):
            self._newest = self._efforts_for(now, samples)

    def _efforts_for(self, now: float, samples: Sequence[JointSample]) -> Efforts:
        raise NotImplementedError


class DirectController(SampleController):
    """Lets a compensator answer.

    compensator: it has the clock of the samples.
    limits: as in `SampleController`.
    """

    def __init__(self, compensator: Compensator, limits: Limits) -> None:
        super().__init__(limits)
        self.compensator = compensator
        self.answer = Compensation(None, NO_REASON)  #: the compensator's last one
        self.was_clamped = False  #: whether one of them was, so far

    def _efforts_for(self, now: float, samples: Sequence[JointSample]) -> Efforts:
        position, velocity, effort, _, _, times, *_ = zip(*samples, strict=True)
        self.compensator.applied = effort
        self.answer = answer = self.compensator.step(now, position, velocity)
        self.was_clamped |= bool(answer.clamped)
        return Efforts(answer.effort, min(times), answer.damped, bool(answer.held))


class UnreliableController:
    """A controller on a computer that may be late or stand still, and whose answers may be wrong. They arrive in order.

    clock: of the loop, which stands still too.
    late: share of the cycles in which the loop stands still for LATE, and of the answers that come so late; by chance.

    delay: s by which answers come late. stall: s for which the next cycle stands still.
    change: what makes of each answer what is sent, None for the answer itself; it may raise an exception.
    """

    def __init__(self, controller: Controller, clock: VirtualClock, late: float = 0.0) -> None:
        self.controller = controller
        self.delay = self.stall = 0.0
        self.change: Callable[[Efforts], Efforts] | None = None
        self._clock, self._late, self._random = clock, late, random.Random(0)
        self._answers: deque[tuple[float, Efforts]] = deque()  # on their way, by the time of their arrival
        self._newest = NO_EFFORTS

    def efforts(self, latest: float) -> Efforts:
        """Return the newest efforts that have arrived."""
        if self._random.random() < self._late:
            self._clock.stall(LATE)
        if self.stall:
            self._clock.stall(self.stall)
            self.stall = 0.0
        while self._answers and self._answers[0][0] <= self._clock.monotonic():
            self._newest = self._answers.popleft()[1]
        return self._newest

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Answer the samples, perhaps late."""
        self.controller.take(now, samples)
        due = now + self.delay + (LATE if self._random.random() < self._late else 0.0)
        due = max(due, self._answers[-1][0]) if self._answers else due
        answer = self.controller.efforts(now)
        self._answers.append((due, self.change(answer) if self.change else answer))
