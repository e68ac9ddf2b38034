"""Checks that motors apply the torque they were commanded, from the torque in their replies.

A motor that has been switched off, has restarted, missed its ENTER, or obeys another commander still replies, but with
another torque. The expected torque is effort - damping * velocity. Single readings are noisy, so the difference is
smoothed over a few of them.
"""

from __future__ import annotations

from collections.abc import Sequence

from exo_gravity.core.safety.drive import Drive
from exo_gravity.core.safety.faults import Fault, FaultCode
from exo_gravity.core.safety.limits import JointSample, Limits

ABSOLUTE = 0.2  # Nm: 27 torque codes of an AK60-6, above the noise of its current sensor
RELATIVE = 0.25  # of the expected torque
SMOOTHING = 0.02  # s, time constant
PERSISTENCE = 0.01  # s for which the smoothed difference must stay too large
GAP = 0.015  # s without a reply, after which a motor may have restarted: its next replies count at once

TEST_TORQUE = 0.4  # Nm, each way, that shows that a motor is on
TEST_TIME = 0.06  # s, each way
TEST_SHARE = 0.5  # of the test torque that must appear in the replies
TEST_ATTEMPTS = 3


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


class SwitchOnCheck:
    """Checks that all four motors are on: a short push each way, under damping, must appear in their replies.

    effort: (4,) Nm to apply now. done: whether the check has ended. It is made up to TEST_ATTEMPTS times: on a busy
    computer replies may be late.
    """

    def __init__(self, limits: Limits) -> None:
        self.done = False
        self._names = limits.joint_names
        self._torque = [min(TEST_TORQUE, most) for most in limits.max_effort]
        self._rate = limits.max_effort_rate
        self.effort = [0.0] * len(self._torque)
        self._attempts = 0
        self._last_time = [0.0] * len(self._torque)
        self._begin()

    def _begin(self) -> None:
        self._elapsed = 0.0
        self._sums = [[0.0, 0.0] for _ in self._torque]
        self._counts = [[0, 0] for _ in self._torque]

    def step(self, dt: float, joints: Sequence[JointSample], damping: Sequence[float]) -> Fault | None:
        """Advance by `dt` s with the replies to the last commands; return the fault that they show, if any.

        damping: (4,) Nm s/rad, last sent. Its torque is part of the replies, and a light joint moves.
        """
        self._elapsed += dt
        phase, into = divmod(self._elapsed, TEST_TIME)
        if phase >= 2:
            return self._finish(dt)
        for i, joint in enumerate(joints):
            if into > 0.4 * TEST_TIME and joint.time > self._last_time[i]:
                self._counts[i][int(phase)] += 1
                self._sums[i][int(phase)] += joint.effort + damping[i] * joint.velocity
            self._last_time[i] = joint.time
            self._approach(i, self._torque[i] if phase == 0 else -self._torque[i], dt)
        return None

    def _finish(self, dt: float) -> Fault | None:
        for name, torque, sums, counts in zip(self._names, self._torque, self._sums, self._counts, strict=True):
            forward, backward = (total / max(1, count) for total, count in zip(sums, counts, strict=True))
            if forward - backward < TEST_SHARE * 2.0 * torque:
                self._attempts += 1
                if self._attempts < TEST_ATTEMPTS:
                    self._begin()
                    return None
                reason = f"{name}: the motor did not switch on: {torque:g} Nm commanded, {forward:.2f} Nm replied"
                return Fault(FaultCode.TORQUE_NOT_DELIVERED, reason)
        for i in range(len(self.effort)):
            self._approach(i, 0.0, dt)
        self.done = not any(self.effort)
        return None

    def _approach(self, i: int, target: float, dt: float) -> None:
        step = self._rate * dt
        self.effort[i] += max(-step, min(step, target - self.effort[i]))
