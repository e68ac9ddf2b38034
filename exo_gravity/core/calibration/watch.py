"""What stops a calibration: a hand on the arm, a blocked, slipping or saturated joint, a moved stand, a silence."""

from __future__ import annotations

from collections.abc import Sequence

from exo_gravity.core.model.tilt import Tilt, angle_between
from exo_gravity.core.numbers import JOINT_COUNT

MAX_ERROR = 0.12  # rad between a joint and the slow reference
FASTEST = 1.0  # rad/s of a joint; a light joint that leaves its friction reaches 0.5
MAX_CORRECTION = 0.5  # Nm, of the controllers, in addition to what is unknown of weight and friction
DEVIATIONS = 3.0  # of the expected torque
UNKNOWN_FRICTION = 1.0  # Nm, until it is measured
PERSISTENCE = 0.25  # s for which a torque must be unexplained
SATURATION = 0.1  # s for which a joint may want more than its max_effort
MAX_GAP = 0.1  # s between two joint states; as long as can_bridge's longest time-out
MAX_TILT = 0.1  # rad by which the stand or the trunk may tilt during the tour
MAX_UNREST = (0.12, 0.25, 0.05)  # Nm, share of friction, share of the torque: between two passes of the same pose


class Watch:
    """Finds the first trouble of a tour, as a sentence that names joint, value and limit; '' while all is well."""

    def __init__(self, names: Sequence[str], max_effort: Sequence[float], tilt: Tilt) -> None:
        self._names = names
        self._max_effort = max_effort
        self._tilt = tilt
        self._unexplained = [0.0] * JOINT_COUNT  # s

    def motion(
        self, dt: float, position: Sequence[float], velocity: Sequence[float], wanted: Sequence[float], tilt: Tilt
    ) -> str:
        """Return what is wrong with the motion: position, wanted (4,) rad, velocity (4,) rad/s, after `dt` s."""
        if dt > MAX_GAP:
            return f"no joint states for {dt * 1000:.0f} ms, the limit is {MAX_GAP * 1000:.0f}: is a motor silent?"
        if (moved := angle_between(tilt.direction, self._tilt.direction)) > MAX_TILT:
            return f"the trunk tilted by {moved:.2f} rad during the measurement, the limit is {MAX_TILT:g}"
        for name, angle, speed, goal in zip(self._names, position, velocity, wanted, strict=True):
            if not abs(goal - angle) <= MAX_ERROR:
                reason = "a hand is on the arm, or the joint is blocked"
                return f"{name}: {abs(goal - angle):.2f} rad off its path, the limit is {MAX_ERROR:g}: {reason}"
            if not abs(speed) <= FASTEST:
                return f"{name}: {speed:.2f} rad/s, the limit is {FASTEST:g}: it slipped or was pushed"
        return ""

    def torque(
        self, dt: float, correction: Sequence[float], uncertain: Sequence[float], friction: Sequence[float]
    ) -> str:
        """Return which joint needs a torque that neither weight nor friction explains.

        correction, uncertain (a standard deviation), friction: (4,) Nm; friction is 0 while it is unknown.
        """
        columns = zip(self._names, correction, uncertain, friction, strict=True)
        for i, (name, torque, deviation, slide) in enumerate(columns):
            limit = MAX_CORRECTION + DEVIATIONS * deviation + (0.5 * slide if slide else UNKNOWN_FRICTION)
            self._unexplained[i] = self._unexplained[i] + dt if abs(torque) > limit else 0.0
            if self._unexplained[i] > PERSISTENCE:
                reason = "is a hand on the arm?"
                return f"{name}: {torque:.2f} Nm beyond its weight and friction, the limit is {limit:.2f}: {reason}"
        return ""

    def saturation(self, saturated: Sequence[float]) -> str:
        """Return which joint has wanted more than its max_effort for too long; saturated: (4,) s."""
        for name, time, most in zip(self._names, saturated, self._max_effort, strict=True):
            if time > SATURATION:
                return f"{name}: saturated: the pose needs more than max_effort = {most:g} Nm"
        return ""

    def unrest(self, change: Sequence[float], effort: Sequence[float], friction: Sequence[float]) -> str:
        """Return which joint's torque changed between two passes of a pose: change, effort, friction (4,) Nm."""
        for name, between, torque, slide in zip(self._names, change, effort, friction, strict=True):
            limit = MAX_UNREST[0] + MAX_UNREST[1] * abs(slide) + MAX_UNREST[2] * abs(torque)
            if between > limit:
                reason = "the arm was touched, or the joint slips"
                return f"{name}: {between:.2f} Nm between two passes of a pose, the limit is {limit:.2f}: {reason}"
        return ""
