# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What happens to arms on CAN happens to an elbow and to seven joints: by the same bounds, on what the motors did."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from exo_gravity.core.safety.drive import State

from ..support.copies import prepared
from ..support.thorough import quick
from .carried_arm import REAL_RATE, JudgedArm, ShippedArm, cut, stall

POSES = {"elbow": [1.0], "seven_joints": [0.4, 0.3, 0.1, 0.6, 0.1, 0.2, -0.1]}  # rad


@prepared
def raised_arm(name: str) -> ShippedArm:
    """Return the arm, carried, in its pose of `POSES`."""
    arm = ShippedArm(name, REAL_RATE)
    arm.carry()
    arm.raise_to(POSES[name])
    return arm


LOST = {
    "all motors restart in 80 ms": cut(0.08),
    "supply cut for 3 s": cut(3.0),
    "motor 1 loses its power for 1 s": cut(1.0, 0),
}
EVENTS: dict[str, Callable[[JudgedArm], None]] = {
    "let down": lambda arm: arm.safety.disable(arm.now),
    "loop stalls for 60 ms": stall(0.06),
    "loop stalls for 300 ms": stall(0.3),
    **LOST,
}


CASES = list(itertools.product(POSES, EVENTS))
# Seven joints take eight times as long as the elbow.
QUICK = [case for case in CASES if case[0] == "elbow"]


@pytest.mark.parametrize(("name", "event"), quick(QUICK, CASES))
def test_whatever_happens_the_motors_of_other_arms_drive_no_joint(name: str, event: str) -> None:
    arm = raised_arm(name)
    arm.go_through(EVENTS[event], is_loss=event in LOST)
    assert arm.safety.state is State.ACTIVE or not arm.device.powered
