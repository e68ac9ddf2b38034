# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""An arm two of whose motors have each other's CAN ID is refused before it is carried, in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.sim import SimulatedMotor

from ..support.simulated_device import joints_of
from ..support.thorough import quick
from .carried_arm import CarriedArm

RATED = (3.0, 9.0, 3.0, 3.0)  # Nm
RIGHT, EXCHANGED = (1, 2, 3, 4), (1, 2, 4, 3)
ON_EACH = pytest.mark.parametrize("is_worn", quick([True], [True, False]), ids=["worn", "bare"])


def started(ids: Sequence[int], is_worn: bool) -> CarriedArm:
    """Return an arm whose parameters have these IDs, carried, or refused."""
    formats = (MIT,) * len(ids)
    arm = CarriedArm(joints_of(formats, ids), [SimulatedMotor(joint) for joint in joints_of(formats)], RATED)
    if not is_worn:
        arm.device.arm.config = replace(arm.device.arm.config, wearer_mass=(0.0,) * len(ids))
        arm.device.arm.carry(0.0)
    arm.enable()
    assert arm.run_until(lambda: arm.safety.state in (State.ACTIVE, State.FAULT), 60.0)
    return arm


@ON_EACH
def test_an_arm_with_exchanged_ids_of_shoulder_flexion_and_elbow_is_never_carried(is_worn: bool) -> None:
    arm = started(EXCHANGED, is_worn)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.JOINTS_EXCHANGED
    assert "shoulder_flexion moved sooner than elbow_flexion" in arm.safety.fault.reason
    arm.run(1.0)
    assert not arm.device.powered
    arm.assert_not_thrown()


@ON_EACH
def test_an_arm_with_the_right_ids_is_carried(is_worn: bool) -> None:
    assert started(RIGHT, is_worn).safety.state is State.ACTIVE
