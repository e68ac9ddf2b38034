# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Controllers in the process of the loop that calls them: samples in, efforts out, without messages."""

from collections.abc import Sequence

from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import NO_EFFORTS, Efforts
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import NO_REASON


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
        self.answer = Compensation.withdrawn(NO_REASON)  #: the compensator's last one

    def _efforts_for(self, now: float, samples: Sequence[JointSample]) -> Efforts:
        position, velocity, effort, _, _, times, *_ = zip(*samples, strict=True)
        self.compensator.applied = effort
        self.answer = answer = self.compensator.step(now, position, velocity)
        return Efforts(answer.effort, min(times), answer.damped, bool(answer.held))
