# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""While the signs of the motors are proven, no joint turns fast: the arms of config, by the truth, in virtual time."""

from __future__ import annotations

from collections import deque

import pytest

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.sim.motors.damiao import DamiaoMotor

from ..support.thorough import quick
from .carried_arm import DRIVEN, ShippedArm

RATE = 100.0  # Hz, the lowest in use: a light joint gains most speed in a cycle
LIGHT = 6  # the seven-joint arm's last joint, 0.002 kg m^2


class LateMotor(DamiaoMotor):
    """A motor whose replies show what it read two commands ago."""

    def __init__(self, joint: JointMotor) -> None:
        super().__init__(joint)
        self._past: deque[tuple[float, float, float]] = deque(maxlen=3)

    def _readings(self, position: float, velocity: float) -> tuple[float, float, float]:
        self._past.append(super()._readings(position, velocity))
        return self._past[0]


class ReversedMotor(DamiaoMotor):
    """A motor whose torque turns the joint the other way."""

    def advance(self, position: float, velocity: float, dt: float) -> float:
        """Return the torque on the joint in Nm; see `DamiaoMotor.advance`."""
        return -super().advance(position, velocity, dt)

    def damps_at_once(self, torque: float) -> bool:
        """Return False: its damping drives."""
        return False


def proven(name: str, kinds: dict[int, type[DamiaoMotor]]) -> ShippedArm:
    """Return an arm whose signs are proven, or that is refused."""
    arm = ShippedArm(name, RATE, kinds)
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state in (State.RAMPING_IN, State.FAULT))
    return arm


PROVEN: list[tuple[str, dict[int, type[DamiaoMotor]]]] = [
    ("sim", {}),
    ("elbow", {}),
    ("three_joints", {}),
    ("seven_joints", {}),
    ("seven_joints", dict.fromkeys(range(LIGHT + 1), LateMotor)),
]


@pytest.mark.parametrize(
    ("name", "kinds"),
    quick([PROVEN[0], PROVEN[-1]], PROVEN),
    ids=["paper's", "elbow", "three joints", "seven joints", "seven joints, late replies"],
)
def test_no_joint_turns_fast_while_its_sign_is_proven(name: str, kinds: dict[int, type[DamiaoMotor]]) -> None:
    arm = proven(name, kinds)
    assert arm.safety.state is State.RAMPING_IN, arm.safety.fault
    assert 0.0 < arm.fastest < DRIVEN


def test_a_light_joint_whose_motor_is_reversed_turns_no_faster() -> None:
    arm = proven("seven_joints", {LIGHT: ReversedMotor})
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.WRONG_SIGN
    arm.run(1.0)
    assert not arm.device.powered
    assert arm.fastest < DRIVEN
