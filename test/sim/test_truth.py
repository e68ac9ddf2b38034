# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The truth log: what a judge in another process reads of the simulated arm's motion."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor, truth
from exo_gravity.sim.truth import RECORD, TruthLog

from ..support.truth import Truth

JOINTS = [JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
ADVANCE = """
import sys, time
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.truth import TruthLog
device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(JointMotor(MOTORS["AK60-6"], n)) for n in (1, 2, 3, 4)])
device.truth = TruthLog(sys.argv[1])
device.advance(1.0)
print(flush=True)
time.sleep(60)
"""


@pytest.fixture
def device(tmp_path):
    device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(joint) for joint in JOINTS])
    device.truth = TruthLog(tmp_path / "truth.bin")
    return device


def test_every_physics_step_is_logged_with_wall_time_motion_torque_damping_and_motor_state(
    device, tmp_path, monkeypatch
):
    monkeypatch.setattr(truth, "time", SimpleNamespace(time=lambda: 5000.0))
    device.arm.reset((0.0, 1.0, 0.0, 0.0))
    device.exchange(2, JOINTS[1].command(2.0, 1.5))
    device.exchange(2, ENTER)
    device.advance(0.5)
    records = Truth(tmp_path / "truth.bin").since(0.0)
    assert len(records) >= 450
    np.testing.assert_allclose(np.diff(records["time"]), 0.001, atol=1e-5)
    assert abs(records["time"][-1] - 5000.0) < 0.1
    assert records["on"][-1].tolist() == [False, True, False, False]
    assert records["frames"][-1].tolist() == [0, 2, 0, 0]
    assert records["damping"][-1, 1] == pytest.approx(1.5, abs=0.01)
    effort = records["torque"][:, 1] + records["damping"][:, 1] * records["velocity"][:, 1]
    np.testing.assert_allclose(effort, 2.0, atol=0.02)
    np.testing.assert_allclose(np.gradient(records["position"][:, 1], 0.001), records["velocity"][:, 1], atol=0.05)
    np.testing.assert_allclose(records["weight"][-1], device.arm.weight, atol=0.02)


def test_a_reader_sees_the_newest_state_while_the_file_grows(device, tmp_path):
    log = Truth(tmp_path / "truth.bin")
    assert log.newest() is None
    device.exchange(3, ENTER)
    device.advance(0.1)
    assert not log.motors_are_off()
    device.exchange(3, EXIT)
    device.advance(0.1)
    assert log.motors_are_off()
    count = log.count
    device.advance(0.1)
    assert 80 <= log.count - count <= 120


def test_what_was_written_survives_a_kill(tmp_path):
    path = tmp_path / "truth.bin"
    process = subprocess.Popen([sys.executable, "-c", ADVANCE, str(path)], stdout=subprocess.PIPE)
    process.stdout.readline()
    process.kill()
    process.wait()
    process.stdout.close()
    assert path.stat().st_size >= 950 * RECORD.itemsize


def test_a_file_that_cannot_be_created_is_refused(tmp_path):
    with pytest.raises(ParameterError, match="truth"):
        TruthLog(tmp_path / "missing" / "truth.bin")
