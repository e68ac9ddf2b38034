# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A worn arm with elastic joints in the real loop: start, proof of signs, a wearer who moves it and lets go."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.drive import State
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_wearer import VirtualWearer

from ..support.simulated_device import SPECS
from ..support.thorough import quick
from .carried_arm import POSE, CarriedArm

PEAK = (9.0, 18.0, 9.0, 9.0)  # Nm
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
    joints = [JointMotor(spec, number) for number, spec in enumerate(SPECS, 1)]
    arm = CarriedArm(joints, [simulated(joint) for joint in joints], PEAK, stiffness=stiffness, play=play)
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
