"""A compensator in the same process as the loop that calls it: samples in, efforts out, without messages."""

from collections.abc import Sequence

from exo_gravity.core.compensation.compensator import Compensation, Compensator
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import NO_EFFORTS, Efforts
from exo_gravity.core.safety.limits import Limits


class DirectController:
    """Answers the samples of a cycle at once; the next cycle applies the efforts.

    compensator: what computes the efforts. It has the clock of the samples.
    limits: of the arm, which say when a motor is silent: then there is no answer, and the last one grows old.
    """

    def __init__(self, compensator: Compensator, limits: Limits) -> None:
        self.compensator = compensator
        self.answer = Compensation.withdrawn("")  #: the compensator's last one
        self._limits = limits
        self._newest = NO_EFFORTS

    def efforts(self, latest: float) -> Efforts:
        """Return the newest efforts, without waiting."""
        return self._newest

    def take(self, now: float, samples: Sequence[JointSample]) -> None:
        """Answer the newest sample of each joint, unless a motor is silent."""
        if any(self._limits.is_silent(now, sample) for sample in samples):
            return
        position, velocity, effort, _, _, times = zip(*samples, strict=True)
        self.compensator.applied = effort
        self.answer = answer = self.compensator.step(now, position, velocity)
        self._newest = Efforts(answer.effort, min(times), answer.damped, bool(answer.held))
