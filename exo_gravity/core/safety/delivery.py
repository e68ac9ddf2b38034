"""What the torque in the motors' replies shows: whether they deliver what was commanded, and whether they bear it.

A motor that has been switched off, has restarted, missed its ENTER, or obeys another commander still replies, but with
another torque. The expected torque is effort - damping * velocity. Single readings are noisy, so the difference is
smoothed over a few of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from exo_gravity.core.safety.drive import Drive, Fault, FaultCode
from exo_gravity.core.safety.limits import JointSample, Limits

ABSOLUTE = 0.2  # Nm: 27 torque codes of an AK60-6, above the noise of its current sensor
RELATIVE = 0.25  # of the expected torque
SMOOTHING = 0.02  # s, time constant
PERSISTENCE = 0.01  # s for which the smoothed difference must stay too large
GAP = 0.015  # s without a reply, after which a motor may have restarted: its next replies are taken at once
THERMAL_TIME = 60.0  # s; an assumption for motors of this size: the data sheets state none


class DeliveryMonitor:
    """Compares commanded with replied torque, joint by joint. missing: (4,) whether a joint does not deliver."""

    def __init__(self, limits: Limits, peak_effort: Sequence[float]) -> None:
        self._limits = limits
        self._peak = tuple(peak_effort)
        self._received: list[tuple[float, float] | None] = [None] * len(self._peak)  # effort and damping replied to
        self.reset()

    def reset(self) -> None:
        """Forget the past, for example while the motors are off."""
        count = len(self._peak)
        self._difference = [0.0] * count
        self._expected = [0.0] * count
        self._bad_time = [0.0] * count
        self._last_time = [0.0] * count

    @property
    def missing(self) -> tuple[bool, ...]:
        """Whether each joint (4,) does not deliver its torque."""
        return tuple(time >= PERSISTENCE for time in self._bad_time)

    def applied(self, drive: Drive, silent: Sequence[bool]) -> tuple[Sequence[float], Sequence[float]]:
        """Return the effort (4,) Nm and damping (4,) Nm s/rad that the motors apply after `drive` was sent.

        A motor that is `silent` (4,) still applies what it last replied to.
        """
        sent = zip(drive.effort, drive.damping, strict=True)
        known = zip(sent, self._received, silent, strict=True)
        effort, damping = zip(*(old if is_silent and old else new for new, old, is_silent in known), strict=True)
        return effort, damping

    def step(
        self, dt: float, joints: Sequence[JointSample], effort: Sequence[float], damping: Sequence[float]
    ) -> Fault | None:
        """Take the replies `joints` to the last commands, `effort` (4,) Nm and `damping` (4,) Nm s/rad.

        Returns a fault if a joint does not deliver its torque. A joint without a new reply keeps its state.
        """
        share = min(1.0, dt / SMOOTHING)
        for i, joint in enumerate(joints):
            if not joint.time > self._last_time[i]:
                continue
            has_returned = 0.0 < self._last_time[i] < joint.time - GAP
            self._last_time[i] = joint.time
            self._received[i] = effort[i], damping[i]
            expected = effort[i] - damping[i] * joint.velocity
            expected = max(-self._peak[i], min(self._peak[i], expected))
            weight = 1.0 if has_returned else share
            self._difference[i] += weight * (joint.effort - expected - self._difference[i])
            self._expected[i] += weight * (expected - self._expected[i])
            tolerance = ABSOLUTE + RELATIVE * abs(self._expected[i])
            before = max(self._bad_time[i], PERSISTENCE / 2) if has_returned else self._bad_time[i]
            self._bad_time[i] = before + dt if abs(self._difference[i]) > tolerance else 0.0
        for i, bad_time in enumerate(self._bad_time):
            if bad_time >= PERSISTENCE:
                reply = self._expected[i] + self._difference[i]
                reason = f"{self._limits.joint_names[i]}: {self._expected[i]:.2f} Nm commanded, {reply:.2f} Nm replied"
                return Fault(FaultCode.TORQUE_NOT_DELIVERED, reason)
        return None


class MotorLoad:
    """The load of the motors over minutes: RMS torque and power of each joint's motor, which starts cold.

    A motor's heat grows with the square of its torque, so the mean square is averaged over THERMAL_TIME. rated: (n,)
    Nm, which the motors bear for any time.
    """

    def __init__(self, rated: Sequence[float]) -> None:
        self._rated = tuple(rated)
        self._mean_square = [0.0] * len(self._rated)  # Nm^2
        self._time: float | None = None
        self.power: tuple[float, ...] = (0.0,) * len(self._rated)

    def update(self, now: float, joints: Sequence[JointSample]) -> None:
        """Add the readings `joints` (n,), the newest at `now` s. Ten a second are enough.

        A motor that never replied adds nothing. `power` is then torque times speed in W, > 0 where the motor drives.
        """
        share = 0.0 if self._time is None else -math.expm1(-max(0.0, now - self._time) / THERMAL_TIME)
        self._time = now
        self.power = tuple(0.0 if joint.time == -math.inf else joint.effort * joint.velocity for joint in joints)
        for i, joint in enumerate(joints):
            if joint.time > -math.inf:
                self._mean_square[i] += share * (joint.effort**2 - self._mean_square[i])

    @property
    def rms(self) -> tuple[float, ...]:
        """RMS torque (n,) in Nm."""
        return tuple(map(math.sqrt, self._mean_square))

    @property
    def share(self) -> tuple[float, ...]:
        """RMS torque (n,) as a share of rated torque; above 1 the motor overheats if the load stays."""
        return tuple(rms / rated for rms, rated in zip(self.rms, self._rated, strict=True))
