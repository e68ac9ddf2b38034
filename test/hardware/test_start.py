# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The start of an arm, in virtual time: signs are proven slowly, exchanged IDs are found, elastic joints carried."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.sim import SimulatedMotor
from exo_gravity.sim.motors.damiao import DamiaoMotor
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_wearer import VirtualWearer

from ..support.simulated_device import joints_of
from ..support.thorough import quick
from .carried_arm import DRIVEN, POSE, CarriedArm, ShippedArm

RIGHT, EXCHANGED = (1, 2, 3, 4), (1, 2, 4, 3)
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


USUAL = joints_of((MIT,) * 4)
IDS = [(EXCHANGED, True), (EXCHANGED, False), (RIGHT, True), (RIGHT, False)]


@pytest.mark.parametrize(("ids", "is_worn"), quick([(EXCHANGED, True), (RIGHT, True)], IDS))
def test_an_arm_with_exchanged_ids_of_shoulder_flexion_and_elbow_is_never_carried(
    ids: Sequence[int], is_worn: bool
) -> None:
    arm = CarriedArm(joints_of((MIT,) * 4, ids), [SimulatedMotor(joint) for joint in USUAL], (3.0, 9.0, 3.0, 3.0))
    if not is_worn:
        arm.device.arm.config = replace(arm.device.arm.config, wearer_mass=(0.0,) * len(ids))
        arm.device.arm.carry(0.0)
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state in (State.ACTIVE, State.FAULT), 60.0)
    if ids == RIGHT:
        assert arm.safety.state is State.ACTIVE
        return
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.JOINTS_EXCHANGED
    assert "shoulder_flexion moved sooner than elbow_flexion" in arm.safety.fault.reason
    arm.run(1.0)
    assert not arm.device.powered
    arm.assert_not_thrown()


REACH = TrialScript.parse(
    {
        "name": "reach, come back, and wait there until the arm is at rest",
        "steps": [
            {"move": [0.3, 1.0, 0.8, 1.0], "over": 1.5},
            {"move": POSE, "over": 1.5},
            {"move": POSE, "over": 2.0},
        ],
    }
)


ELASTIC = ((150.0, 0.0), (150.0, 0.02), (1000.0, 0.0), (1000.0, 0.01))  # Nm/rad, rad


@pytest.mark.parametrize(("stiffness", "play"), quick([(150.0, 0.02)], ELASTIC))
def test_an_elastic_arm_is_carried_without_an_alarm_and_stays_where_its_wearer_leaves_it(
    stiffness: float, play: float
) -> None:
    motors, peak = [SimulatedMotor(joint) for joint in USUAL], (9.0, 18.0, 9.0, 9.0)
    arm = CarriedArm(USUAL, motors, peak, stiffness=stiffness, play=play)
    arm.carry()
    arm.raise_to(POSE)
    arm.device.start(VirtualWearer(REACH))
    arm.run(5.2)
    assert arm.safety.state is State.ACTIVE, arm.safety.fault
    left = np.array(arm.device.arm.positions)
    arm.forget()
    arm.run(2.0)
    assert arm.safety.state is State.ACTIVE, arm.safety.fault
    arm.assert_not_thrown()
    # What the hand held bends the joint, and the link falls through its play.
    assert np.abs(np.array(arm.device.arm.positions) - left).max() < 0.03 + play
