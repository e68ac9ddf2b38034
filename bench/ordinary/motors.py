# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Motors whose current loop lags, whose velocity is filtered, and whose torque is noisy in their replies."""

import math
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import SimulatedMotor
from exo_gravity.sim.motors import simulated

from ..arms import of_family


@dataclass(frozen=True)
class Electronics:
    """What an ordinary motor differs in from an ideal one."""

    #: s, time constant of the current loop. A reply carries the torque that the motor applies when the command arrives.
    current_lag: float
    velocity_filter: float  #: s, time constant of the speed in replies and for damping
    torque_noise: float = 0.0  #: Nm, standard deviation of the torque in one reply


class OrdinaryMotor(SimulatedMotor):
    """An ordinary motor. applied: Nm, that its current loop has reached."""

    def __init__(self, joint: JointMotor, electronics: Electronics) -> None:
        super().__init__(joint)
        self.applied = 0.0
        self._electronics = electronics
        self._speed = 0.0  # rad/s, filtered

    @property
    def steady(self) -> bool:
        """Whether the torque stays constant: not while the current loop follows."""
        return False

    def advance(self, position: float, velocity: float, dt: float) -> float:
        """Let `dt` s pass, and return the torque in Nm; see `SimulatedMotor.advance`."""
        if self.firmware.timeout:  # it counts the time since the last command
            super().advance(position, velocity, dt)
        self._speed -= (velocity - self._speed) * math.expm1(-dt / self._electronics.velocity_filter)
        aim = super().torque(position, self._speed)
        self.applied -= (aim - self.applied) * math.expm1(-dt / self._electronics.current_lag)
        self.applied = self.applied if self.entered else 0.0
        return self.applied

    def torque(self, position: float, velocity: float) -> float:
        """Return the torque in Nm that a reply shows."""
        applied = self.applied if self.entered and not self.unplugged else 0.0
        return applied + self._random.gauss(0.0, self._electronics.torque_noise)

    def damps_at_once(self, torque: float) -> bool:
        """Return False: the current loop follows."""
        return False

    def _state(self, position: float, velocity: float) -> bytes:
        return super()._state(position, self._speed)


def motor_of(joint: JointMotor, electronics: Electronics | None) -> SimulatedMotor:
    """Return the motor of `joint`, an ideal one without `electronics`."""
    if electronics is None:
        return simulated(joint)
    return of_family(OrdinaryMotor, joint.spec.family)(joint, electronics)
