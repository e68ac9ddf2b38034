# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CONTRIBUTING's "Add a motor family": another distribution's entry points, and an arm with its motors is carried."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from ..support import ROOT

OUR_LAB = ROOT / "test" / "support" / "our_lab"


@pytest.fixture(scope="module")
def carried() -> dict[str, Any]:
    """What `test/support/added_motor.py` finds with the distribution `our_lab` installed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(OUR_LAB), os.environ.get("PYTHONPATH", "")))}
    command = [sys.executable, "-m", "test.support.added_motor"]
    output = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    return json.loads(output)


def test_a_laboratory_s_own_motor_needs_no_fork(carried: dict[str, Any]) -> None:
    assert (carried["state"], carried["fault"], carried["on"], carried["off"]) == ("active", None, [True] * 4, True)
    assert not carried["ignored"]
    assert carried["simulated"] == ["OurSimulatedMotor", "SimulatedMotor", "OurSimulatedMotor", "SimulatedMotor"]


def test_all_bounds_follow_from_the_record_of_a_motor(carried: dict[str, Any]) -> None:
    # Less than half a turn of the rotor at the output: 9 degrees.
    assert carried["home_tolerance"] == pytest.approx([0.15, 0.34, 0.15, 0.50])
    assert carried["peak"] == [50.0, 18.0, 50.0, 9.0]
    assert carried["most"] == [100.0, 40.0, 100.0, 40.0]
    assert carried["rotors"] == [4.0e-3, 4.9e-3, 4.0e-3, 8.8e-4]


def test_a_start_with_our_motors_alone_looks_up_no_entry_point(carried: dict[str, Any]) -> None:
    assert carried["is_lazy"]
