# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Short versions of `make study NAME=ordinary`, where ordinary equipment lets no arm down, and of the IMU report."""

from __future__ import annotations

import numpy as np
import pytest

from bench.imu_report import read_trials, report
from bench.ordinary.__main__ import is_quiet
from bench.ordinary.motors import Electronics, OrdinaryMotor
from bench.ordinary.rows import EQUIPMENT, Row
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor

from ..sim.test_motors import SPEC, TORQUE_CODE, command, reply_to
from ..support.thorough import quick

pytestmark = pytest.mark.thorough

ROWS = (
    (Row("paper", EQUIPMENT[1], False, 100.0, "loop, work of 0.5 and 2 ms"), 0.5),
    (Row("paper", EQUIPMENT[2], True, 100.0, "arrival, 16 ms timer of an FTDI adapter"), 0.5),
    (Row("seven joints", EQUIPMENT[2], False, 100.0, ""), 1.2),  # Nm, of an arm that is twice as heavy
)


@pytest.mark.parametrize(("row", "most"), quick(ROWS[:1], ROWS), ids=lambda value: getattr(value, "name", ""))
def test_ordinary_equipment_carries_an_arm_without_an_alarm(row, most):
    result = row.play(1.0, carried=2.0)
    assert is_quiet(result) and result.starts and not result.refused_samples, result
    assert 0.0 < result.largest_error < most


def entered(*electronics: float) -> OrdinaryMotor:
    motor = OrdinaryMotor(JointMotor(SPEC, 5), Electronics(*electronics))
    motor.receive(ENTER, 0.0, 0.0, 0.0)
    return motor


def test_a_reply_carries_the_torque_applied_when_its_command_arrives_and_the_current_loop_follows():
    motor = entered(0.004, 1e-9)
    assert abs(reply_to(motor, command(torque=2.0)).torque) <= TORQUE_CODE
    motor.advance(0.0, 0.0, 0.004)
    assert reply_to(motor, command(torque=-1.0)).torque == pytest.approx(2.0 * (1.0 - np.exp(-1.0)), abs=TORQUE_CODE)
    motor.receive(EXIT, 0.0, 0.0, 0.0)
    assert motor.torque(0.0, 0.0) == 0.0


def test_the_imus_report_has_a_row_for_each_trial_and_a_column_for_each_method():
    lines = report(list(read_trials())[:1]).splitlines()
    assert len(lines) == 4 and lines[0].startswith("| trial | here | published |")
    assert lines[2].startswith("| 03 undisturbed slow rotation C | 0.")
