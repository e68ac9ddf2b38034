# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The judge of the outer loop's rows sees assistance that stays, gravity compensation that changes, and motion."""

import numpy as np
import pytest

from exo_gravity.sim.truth import RECORD

from .outer_loop_cases import LEASES, only_the_assistance_ends
from .players import EFFORTS

GRAVITY = (0.1, 3.3, 0.5, 0.2)  # Nm


@pytest.fixture
def records():
    """Half a second of an arm at rest, whose assistance fades from 50 to 100 ms after the fault."""
    records = np.zeros(500, RECORD)
    since = 0.001 * np.arange(500)
    records["time"] = 10.0 + since
    left = np.clip((0.1 - since) / 0.05, 0.0, 1.0)
    records["torque"] = GRAVITY + left[:, None] * EFFORTS
    return records


def test_an_arm_that_loses_only_its_assistance_is_found_safe(records):
    assert only_the_assistance_ends(records) == ""


def test_assistance_that_stays_is_seen(records):
    records["torque"] = np.add(GRAVITY, EFFORTS)
    assert only_the_assistance_ends(records) == "0.25 Nm on top of gravity compensation, 150 ms after the fault"


def test_a_change_of_gravity_compensation_is_seen(records):
    records["torque"][200:, 3] -= 0.2
    assert "0.20 Nm on top of gravity compensation" in only_the_assistance_ends(records)


def test_an_arm_that_moves_is_seen(records):
    records["position"][300:, 1] = 0.1
    assert only_the_assistance_ends(records) == "the arm moved by 0.10 rad"


def test_assistance_that_returns_with_the_next_outer_loop_is_seen(records):
    records["time"] = records["time"][0] + 0.01 * np.arange(500)  # 5 s
    records["torque"] = GRAVITY
    check = next(case.check for case in LEASES if "next one" in case.name)
    records["torque"][0] = np.add(GRAVITY, EFFORTS)
    assert check(records) == ""
    records["torque"][300:303, 1] += 0.2
    assert "0.20 Nm on top of gravity compensation" in check(records)
