# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the torque in the motors' replies shows: whether they deliver what was commanded, and whether they bear it.

A motor that has been switched off, has restarted, missed its ENTER, or obeys another commander still replies, but with
another torque. The expected torque is effort - damping * velocity. An ordinary reply is one command old, behind a
current loop of up to 8 ms, late by a batch of its adapter or a stall of the computer, or answers the command before a
lost one: it lies between the least and the most that the commands of the last `DELIVERY.span` asked for. What exceeds
these by more than a tolerance is evidence; it is summed over the replies, so that noise of 0.15 Nm cancels and a lost
frame adds nothing.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import Fault, FaultCode
from exo_gravity.core.safety.limits import Limits

THERMAL_TIME = 60.0  # s; an assumption for motors of this size: the data sheets state none


@dataclass(frozen=True)
class Delivery:
    """How much a replied torque may differ from the commanded one."""

    least: float = 0.25  #: Nm
    share: float = 0.25  #: of the expected torque, in addition
    span: float = 0.03  #: s of the loop before the last reply, whose commands a reply may answer
    #: Nm s, excess times the period of a reply; one reply adds at most half. No false alarm in 2 hours at 0.15 Nm of
    #: noise and 100 Hz: docs/safety_case.md
    evidence: float = 0.0075
    noted: int = 256  #: commands, at most, while a motor is silent

    def excess(self, replied: float, expected: float) -> float:
        """Return by how much in Nm a replied torque differs from the expected one beyond the tolerance."""
        return abs(replied - expected) - self.least - self.share * abs(expected)


DELIVERY = Delivery()


class DeliveryMonitor:
    """Compares commanded with replied torque, joint by joint. missing: (n,) whether a joint does not deliver."""

    def __init__(self, limits: Limits, peak_effort: Sequence[float]) -> None:
        self._limits = limits
        self._peak = tuple(peak_effort)
        self._newest = [-math.inf] * len(self._peak)  # s, of the last reply
        self.reset()

    def reset(self) -> None:
        """Forget the past, for example while the motors are off."""
        self._time = 0.0  # s that the loop has run
        self._replied = [0.0] * len(self._peak)  # s of it, at the last reply
        self._evidence = [0.0] * len(self._peak)  # Nm s
        # Torque in Nm that each command asked for, and when.
        self._expected: list[deque[tuple[float, float]]] = [deque(maxlen=DELIVERY.noted) for _ in self._peak]

    @property
    def missing(self) -> tuple[bool, ...]:
        """Whether each joint (n,) does not deliver its torque."""
        return tuple(evidence >= DELIVERY.evidence for evidence in self._evidence)

    def step(
        self, dt: float, joints: Sequence[JointSample], effort: Sequence[float], damping: Sequence[float]
    ) -> Fault | None:
        """Take the replies to the last commands; return a fault if a joint does not deliver its torque.

        A joint without a new reply keeps its evidence.

        dt: s that the loop ran since the last replies.
        joints: (n,) the replies.
        effort: (n,) Nm, commanded.
        damping: (n,) Nm s/rad, commanded.
        """
        self._time += dt
        fault = None
        for i, joint in enumerate(joints):
            expected, peak = self._expected[i], self._peak[i]
            expected.append((max(-peak, min(peak, effort[i] - damping[i] * joint.velocity)), self._time))
            if not joint.time > self._newest[i]:
                continue
            while expected[0][1] < self._replied[i] - DELIVERY.span:
                expected.popleft()
            self._newest[i], self._replied[i] = joint.time, self._time
            least, most = min(expected)[0], max(expected)[0]
            nearest = max(least, min(most, joint.effort))
            added = min(DELIVERY.evidence / 2, DELIVERY.excess(joint.effort, nearest) * dt)
            self._evidence[i] = max(0.0, min(DELIVERY.evidence, self._evidence[i] + added))
            if self._evidence[i] >= DELIVERY.evidence and not fault:
                reason = f"{nearest:.2f} Nm commanded, {joint.effort:.2f} Nm replied"
                fault = Fault.of_joint(FaultCode.TORQUE_NOT_DELIVERED, self._limits.joint_names[i], reason)
        return fault


class MotorLoad:
    """The load of the motors over minutes: RMS torque and power of each joint's motor, which starts cold.

    A motor's heat grows with the square of its torque, so the mean square is averaged over THERMAL_TIME. rated: (n,)
    Nm, which the motors bear for any time.
    """

    def __init__(self, rated: Sequence[float]) -> None:
        self._rated = tuple(rated)
        self._mean_square = [0.0] * len(self._rated)  # Nm^2
        self._time = math.inf

    def update(self, now: float, joints: Sequence[JointSample]) -> list[tuple[float, float, float]]:
        """Add the readings `joints` (n,), the newest at `now` s, and return three figures of each motor.

        They are power (W, > 0 where the motor drives), RMS torque (Nm), and its share of rated torque: above 1 the
        motor overheats if the load stays. Ten a second are enough. A motor that never replied adds nothing.
        """
        share = -math.expm1(-max(0.0, now - self._time) / THERMAL_TIME)
        self._time = now
        loads = []
        for i, joint in enumerate(joints):
            if joint.time > -math.inf:
                self._mean_square[i] += share * (joint.effort**2 - self._mean_square[i])
            power = joint.effort * joint.velocity if joint.time > -math.inf else 0.0
            rms = math.sqrt(self._mean_square[i])
            loads.append((power, rms, rms / self._rated[i]))
        return loads
