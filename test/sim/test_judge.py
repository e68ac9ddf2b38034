# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The judge sees each way in which an arm can be let down badly, in made records; the device's own are true."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.sim import truth
from exo_gravity.sim.judge import MAX_SPEED, driven, measure
from exo_gravity.sim.truth import RECORD, TruthLog

from ..support import ROOT
from ..support.simulated_device import joints_of, make_device
from ..support.truth import Truth

FAULT = 10.0  # s
PERIOD = 0.004  # s


@pytest.fixture
def records():
    """A second of an arm that is carried, lowered under damping after a fault, and switched off after 4 s."""
    records = np.zeros(8000, RECORD)
    since = records["time"] = FAULT - 0.1 + 0.001 * np.arange(8000)
    since = since - FAULT
    records["on"] = (since < 4.0)[:, None]
    records["frames"] = (np.arange(8000) // 4)[:, None]
    fade = np.clip(1.0 - np.maximum(since, 0.0) / 2.0, 0.0, 1.0)
    records["damping"][:, :] = np.where((since >= 0.02) & (since < 4.0), 5.0, 0.0)[:, None]
    records["velocity"][:, 1] = np.where((since > 0.0) & (since < 3.0), -0.3, 0.0)
    effort = np.zeros((8000, 4))
    effort[:, 1] = 3.3 * fade
    records["torque"] = effort - records["damping"] * records["velocity"]
    return records


def test_an_arm_that_is_let_down_well_is_found_safe(records):
    response = measure(records, FAULT, PERIOD)
    assert (response.reaction, response.off) == pytest.approx((0.02, 4.0), abs=0.002)
    assert response.top_speed == pytest.approx(0.3)
    assert response.excess == 0.0 and not response.re_enabled
    assert response.energy < 0.001 and response.gap < 0.002


def test_all_motors_that_frames_reach_must_react(records):
    records["damping"][:, 1] = 0.0
    assert measure(records, FAULT, PERIOD, unreached=(1,)).reaction == pytest.approx(0.02, abs=0.002)
    assert measure(records, FAULT, PERIOD, unreached=(0, 1, 2, 3)).reaction is None
    records["damping"][:, [0, 2, 3]] = 0.0
    assert measure(records, FAULT, PERIOD).reaction == pytest.approx(4.0, abs=0.002)  # when they were switched off


def test_switching_off_a_motor_that_applies_torque_is_a_torque_step_and_damping_up_to_the_peak_torque_is_none(records):
    fast = (records["time"] >= FAULT + 1.0) & (records["time"] < FAULT + 1.2)
    records["velocity"][fast, 0], records["torque"][fast, 0] = 3.0, -9.0
    assert measure(records, FAULT, PERIOD).excess == 0.0
    off = records["time"] >= FAULT + 0.5
    records["on"][off] = False
    for field in ("torque", "damping"):
        records[field][off] = 0.0
    response = measure(records, FAULT, PERIOD)
    assert response.largest_step > 2.0 and response.excess > 2.0


def test_several_frames_within_a_millisecond_may_change_the_torque_as_often_and_the_fault_itself_once(records):
    late = records["time"] >= FAULT + 1.0
    records["torque"][~late, 1] += 0.4
    assert measure(records, FAULT, PERIOD).excess > 0.0
    records["frames"][late] += 2
    assert measure(records, FAULT, PERIOD).excess == 0.0
    records["torque"][records["time"] < FAULT + 0.1, 1] += 1.0
    assert measure(records, FAULT, PERIOD).excess > 0.5
    assert measure(records, FAULT, PERIOD, steps_from=0.2).excess == 0.0


def test_speed_counts_from_the_fault_on_also_of_a_fall_after_the_motors_were_switched_off(records):
    records["velocity"][records["time"] < FAULT - 0.05, 2] = 3.0
    assert measure(records, FAULT, PERIOD).top_speed < MAX_SPEED
    records["velocity"][records["time"] >= FAULT + 6.0, 3] = 2.5
    response = measure(records, FAULT, PERIOD)
    assert response.top_speed > MAX_SPEED and response.fastest == 4
    assert measure(records, FAULT, PERIOD, unpowered=(3,)).top_speed < MAX_SPEED


def test_a_motor_that_drives_the_arm_does_work_and_one_that_brakes_does_not(records):
    moved = (records["time"] >= FAULT + 1.0) & (records["time"] < FAULT + 2.0)
    for torque, energy, within in ((2.0, 1.0, 0.01), (-2.0, 0.0, 0.001)):
        records["velocity"][moved, 2], records["torque"][moved, 2] = 0.5, torque
        assert measure(records, FAULT, PERIOD).energy == pytest.approx(energy, abs=within)


@pytest.fixture
def lifted(records):
    """The wearer moves joint 4 at 2 rad/s until 1 s after the fault, and lets go."""
    since = records["time"] - FAULT
    records["wearer"][since < 1.0, 3] = 1.0
    records["velocity"][:, 3] = np.clip(np.where(since < 1.0, 2.0, 2.0 - 4.0 * (since - 1.0)), 0.0, 2.0)
    return records


def test_speed_that_the_wearer_gives_the_arm_does_not_count(lifted):
    response = measure(lifted, FAULT, PERIOD)
    assert response.top_speed <= 0.31
    assert response.driven == 0.0


@pytest.mark.parametrize("torque", [2.0, -2.0])
def test_speed_that_an_arm_gains_after_the_wearer_let_go_counts_and_is_driven_if_its_motor_pulls(lifted, torque):
    since = lifted["time"] - FAULT
    thrown = (since > 1.6) & (since < 1.9)
    lifted["velocity"][thrown, 3] = 0.9
    lifted["torque"][thrown, 3] = torque
    response = measure(lifted, FAULT, PERIOD)
    assert response.top_speed == pytest.approx(0.9)
    assert response.driven == pytest.approx(0.9 if torque > 0.0 else 0.0)


def test_a_motor_that_is_on_again_and_time_in_which_the_device_did_not_run_are_seen(records):
    records["on"][-1, 2] = True
    kept = (records["time"] < FAULT + 1.0) | (records["time"] > FAULT + 1.5)
    response = measure(records[kept], FAULT, PERIOD)
    assert response.off is None and response.re_enabled
    assert response.gap == pytest.approx(0.5, abs=0.01)


def test_only_the_longest_stretch_in_which_a_motor_drives_counts_as_its_energy(records):
    since = records["time"] - FAULT
    for begin, end, speed in ((1.0, 1.5, 0.5), (2.0, 3.0, 0.4), (4.5, 6.5, 0.09)):
        stretch = (since >= begin) & (since < end)
        records["velocity"][stretch, 2] = speed
        records["torque"][stretch, 2] = 2.0
    done = driven(records)
    assert done.energy == pytest.approx(0.8, abs=0.01)
    assert (done.speed, done.joint) == (pytest.approx(0.5), 3)
    assert done.power == pytest.approx(1.0)


def test_damping_that_drives_a_joint_is_seen(records):
    """As that of a motor whose torque is reversed."""
    falling = (records["time"] >= FAULT + 1.0) & (records["time"] < FAULT + 1.5)
    records["velocity"][~falling, 1] = 0.0
    records["torque"][:, 1] = np.where(falling, 5.0 * records["velocity"][:, 1], 0.0)
    done = driven(records)
    assert (done.speed, done.joint) == (pytest.approx(0.3), 2)
    assert done.energy == pytest.approx(0.5 * 1.5 * 0.3, abs=0.01)
    assert done.damping == pytest.approx(1.5 / 9.0)  # Nm, of what an AK80-9 is rated for


def test_of_a_joint_that_falls_the_motor_gave_only_what_it_adds(records):
    since = records["time"] - FAULT
    fall = (since >= 1.0) & (since < 2.0)
    records["velocity"][fall, 2] = 3.0 * (since[fall] - 1.0)
    records["torque"][fall & (since >= 1.5), 2] = 1.0
    assert driven(records).speed == pytest.approx(1.5, abs=0.01)


def test_a_motor_that_carries_less_than_the_weight_does_not_throw_what_others_swing_up(records):
    swung = (records["time"] >= FAULT + 1.0) & (records["time"] < FAULT + 1.2)
    records["velocity"][swung, 2], records["torque"][swung, 2] = 0.9, 0.5
    assert driven(records).speed == pytest.approx(0.9)
    records["weight"][:, 2] = 0.6
    assert driven(records).speed < 0.1
    for weight in (0.4, -0.6):  # what it gives beyond that throws it; gravity helps, and the motor pushes, too
        records["weight"][:, 2] = weight
        assert driven(records).speed == pytest.approx(0.9)


def test_energy_counts_from_a_speed_on(records):
    since = records["time"] - FAULT
    lifted = (since >= 1.0) & (since < 2.0)
    records["velocity"][lifted, 2], records["torque"][lifted, 2] = 0.3, 2.0
    assert driven(records).energy == pytest.approx(0.6, abs=0.01)
    assert driven(records, slow=0.35).energy < 0.001
    assert driven(records, slow=0.35).speed == pytest.approx(0.3)
    records["velocity"][lifted & (since >= 1.5), 2] = 0.4
    assert driven(records, slow=0.35).energy == pytest.approx(0.4, abs=0.01)


def test_on_a_trunk_that_turns_only_energy_beyond_the_weight_counts(records):
    since = records["time"] - FAULT
    lifted = (since >= 1.0) & (since < 2.0)
    records["velocity"][lifted, 2], records["torque"][lifted, 2], records["weight"][lifted, 2] = 0.3, 2.0, 1.9
    assert driven(records).energy == pytest.approx(0.6, abs=0.01)
    assert driven(records, turning=True).energy == pytest.approx(0.03, abs=0.01)


def test_a_stop_that_an_arm_falls_into_gives_speed_and_a_motor_that_threw_it_there_is_blamed(records):
    since = records["time"] - FAULT
    stops = (-1.0,) * 4, (1.0,) * 4
    records["position"][:, 1] = np.where((since >= 1.99) & (since < 2.0), 1.0, 0.0)
    records["velocity"][:, 1] = np.where((since >= 1.0) & (since < 2.0), 3.0, 0.0)  # joint 2 falls, and hits its stop,
    records["torque"][:, 1] = 0.0
    struck = (since >= 1.99) & (since < 2.2)
    records["velocity"][struck, 2], records["torque"][struck, 2] = 2.0, 0.3  # which gives joint 3 its speed
    assert driven(records).speed == pytest.approx(2.0)
    assert driven(records, stops=stops).speed < 0.1
    records["torque"][:, 1] = np.where((since >= 1.0) & (since < 1.99), 3.0, 0.0)
    assert driven(records, stops=stops).speed == pytest.approx(3.0)


def test_a_motor_that_throws_and_catches_by_turns_drives_for_the_whole_time(records):
    since = records["time"] - FAULT
    thrown = (since >= 1.0) & (since < 2.0)
    records["velocity"][thrown, 2] = since[thrown] - 1.0
    records["torque"][thrown, 2] = np.where(np.arange(thrown.sum()) // 4 % 2, -1.0, 1.0)
    assert driven(records).speed == pytest.approx(1.0, abs=0.01)
    assert driven(records).energy == pytest.approx(0.25, abs=0.02)


def test_a_motor_does_not_drive_what_the_wearer_moves(lifted):
    lifted["torque"][:, 3] = np.where(lifted["wearer"][:, 3] > 0.0, 3.0, 0.0)
    assert driven(lifted).energy == measure(lifted, FAULT, PERIOD).energy == 0.0


# The device's own records


ADVANCE = """
import sys, time
from exo_gravity.sim.truth import TruthLog
from test.support.simulated_device import make_device
device = make_device()
device.truth = TruthLog(sys.argv[1])
device.advance(1.0)
print(flush=True)
time.sleep(60)
"""


@pytest.fixture
def logged(tmp_path):
    """A device that logs its truth, and what reads the log."""
    device, path = make_device(), tmp_path / "truth.bin"
    device.truth = TruthLog(path)
    return device, Truth(path)


def test_every_physics_step_is_logged_with_wall_time_motion_torque_damping_and_motor_state(logged, monkeypatch):
    monkeypatch.setattr(truth, "time", SimpleNamespace(time=lambda: 5000.0))
    device, log = logged
    device.arm.reset((0.0, 1.0, 0.0, 0.0))
    device.exchange(2, joints_of((MIT,) * 4)[1].command(2.0, 1.5))
    device.exchange(2, ENTER)
    device.advance(0.5)
    records = log.since(0.0)
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


def test_a_reader_sees_the_newest_state_while_the_file_grows(logged):
    device, log = logged
    assert log.newest() is None
    for data, are_off in ((ENTER, False), (EXIT, True)):
        device.exchange(3, data)
        device.advance(0.1)
        assert log.motors_are_off() is are_off
    assert 160 <= log.count <= 240


def test_what_was_written_survives_a_kill_and_a_file_that_cannot_be_created_is_refused(tmp_path):
    path = tmp_path / "truth.bin"
    with subprocess.Popen([sys.executable, "-c", ADVANCE, str(path)], cwd=ROOT, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.kill()
    assert path.stat().st_size >= 950 * RECORD.itemsize
    with pytest.raises(ParameterError, match="truth"):
        TruthLog(tmp_path / "missing" / "truth.bin")
