# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated device: arm, motors and wearer, joined by frames alone, without a bus."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import unpack_reply
from exo_gravity.core.motors.frames import ENTER, SET_ZERO
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, VirtualWearer
from exo_gravity.sim.script import TrialScript

from ..support.simulated_device import RAISED, SPECS, command, make_device


@pytest.fixture
def device():
    return make_device()


def test_a_reply_has_the_present_position_and_velocity(device):
    device.arm.reset(RAISED)
    device.advance(0.2)
    for joint in range(4):
        reply = unpack_reply(SPECS[joint], device.exchange(joint + 1, command(joint))[1])
        assert reply.position == pytest.approx(device.arm.positions[joint], abs=2e-4)
        assert reply.velocity == pytest.approx(device.arm.velocities[joint], abs=0.013)


def test_time_advances_in_whole_steps_and_the_remainder_is_kept(device):
    device.advance(0.0104)
    assert device.time == pytest.approx(0.010)
    device.advance(0.0006)
    assert device.time == pytest.approx(0.011)


def test_gravity_torque_through_frames_holds_the_arm(device):
    device.arm.reset(RAISED)
    for can_id in (1, 2, 3, 4):
        device.exchange(can_id, ENTER)
    for joint, torque in enumerate(gravity_torque(device.arm.config.links, RAISED)):
        device.exchange(joint + 1, command(joint, torque))
    device.advance(10.0)
    np.testing.assert_allclose(np.degrees(device.arm.positions), np.degrees(RAISED), atol=0.05)


def test_a_motors_damping_acts_at_every_step():
    links = SimulatedArm().config.links
    weightless = ArmModel(links.length, links.cog, links.mass, gravity=0.0)
    device = make_device(config=ArmConfig(weightless, coulomb_friction=(0,) * 4, viscous_friction=(0,) * 4))
    device.arm.data.qvel[:] = 2.0
    for joint in range(4):
        device.exchange(joint + 1, ENTER)
        device.exchange(joint + 1, command(joint, kd=2.0))
    device.advance(1.0)
    # Not exactly at rest: no 12-bit code commands exactly 0 rad/s.
    assert np.abs(device.arm.velocities).max() < 0.015


def test_a_hand_that_leads_a_light_arm_against_damping_does_not_shake_it(device):
    device.arm.reset(RAISED)
    for joint in range(len(SPECS)):
        device.exchange(joint + 1, ENTER)
        device.exchange(joint + 1, command(joint, kd=5.0))
    reach = [{"move": pose, "over": 0.8} for pose in ([0.3, 1.2, 0.8, 1.2], [0.0, 0.9, 0.3, 0.6])]
    device.start(VirtualWearer(TrialScript.parse({"name": "reach", "steps": reach})))
    velocities = []
    for _ in range(1600):
        device.advance(0.001)
        velocities.append(device.arm.velocities)
    changes = np.diff(velocities, axis=0)
    assert np.abs(changes[1:] - changes[:-1]).max() < 0.5


def test_tilting_the_trunk_moves_the_arm(device):
    device.advance(0.5)
    assert np.abs(device.arm.positions).max() < 1e-6
    device.pitch = 0.6
    device.advance(2.0)
    assert np.abs(device.arm.positions).max() > 0.2


def test_the_wearer_starts_after_the_delay(device):
    device.advance(1.0)
    wearer = VirtualWearer(
        TrialScript.parse({"name": "test", "steps": [{"move": list(RAISED), "over": 2.0}, {"hold": 1.0}]})
    )
    device.start(wearer, delay=0.5)
    device.advance(0.4)
    assert wearer.step is None
    device.advance(2.0)
    assert wearer.step == 0
    np.testing.assert_allclose(device.arm.positions, RAISED, atol=0.03)


@pytest.mark.parametrize(("fault", "of_joint_1"), [("bus_silent", True), ("cut_off", (True, False, False, False))])
def test_a_motor_that_no_frame_reaches_keeps_its_last_command(device, fault, of_joint_1):
    device.exchange(1, ENTER)
    device.exchange(1, command(0, 2.0))
    setattr(device, fault, of_joint_1)
    assert device.exchange(1, command(0, 0.0)) is None
    assert device.motors[0].torque(0.0, 0.0) == pytest.approx(2.0, abs=0.01)
    assert (device.exchange(3, ENTER) is None) is (fault == "bus_silent")


def test_an_encoder_error_shifts_the_angle_that_a_motor_replies(device):
    device.encoder_error = (0.0, 0.698, 0.0, 0.0)
    reply = unpack_reply(SPECS[1], device.exchange(2, command(1))[1])
    assert reply.position == pytest.approx(0.698, abs=0.001)


def test_after_set_zero_a_motor_does_not_reply_for_a_while_of_simulated_time():
    device = make_device(Firmware(zero_silence=0.7))
    assert device.exchange(1, SET_ZERO) is None
    device.advance(0.699)
    assert device.exchange(1, command(0)) is None
    device.advance(0.002)
    assert device.exchange(1, command(0)) is not None


@pytest.mark.parametrize("ids", [(1, 2, 3, 3), (1, 1, 1, 1)])
def test_two_motors_with_the_same_id_are_rejected(ids):
    with pytest.raises(ParameterError, match="can_id"):
        make_device(ids=ids)


def perform(device, *steps):
    device.start(VirtualWearer(TrialScript.parse({"name": "trunk", "steps": list(steps)})))


def test_the_trunk_bows_and_stays_bowed(device):
    device.pitch, device.roll = 0.1, -0.06
    perform(device, {"hold": 0.5}, {"bow": 0.5, "over": 1.0}, {"hold": 0.5})
    device.advance(0.4)
    assert (device.pitch, device.trunk_motion) == (0.1, None)
    device.advance(0.6)
    assert device.trunk_motion
    assert device.trunk.pitch == device.pitch == pytest.approx(0.3, abs=0.001)
    assert device.trunk.pitch_rate == pytest.approx(0.4 * 1.875, rel=0.01)
    device.advance(1.0)
    assert (device.pitch, device.roll) == pytest.approx((0.5, -0.06), abs=1e-6)
    assert not device.trunk_motion
    assert device.trunk[2:] == (0.0,) * 4 + ((0.0,) * 3,)


def test_a_walking_trunk_stays_where_it_was(device):
    device.pitch = 0.1
    perform(device, {"walk": 4.0}, {"hold": 1.0})
    pitches = []
    for _ in range(450):
        device.advance(0.01)
        pitches.append(device.pitch)
    assert np.ptp(pitches) == pytest.approx(math.radians(2.0), rel=0.02)
    assert pitches[-1] == pytest.approx(0.1, abs=1e-6)


def test_a_new_script_ends_the_motion_of_the_old_one(device):
    perform(device, {"walk": 10.0})
    device.advance(2.3)
    assert any(device.trunk.acceleration)
    perform(device, {"hold": 1.0})
    device.advance(0.01)
    assert device.trunk == (device.pitch, device.roll, 0.0, 0.0, 0.0, 0.0, (0.0,) * 3)


def test_the_arm_feels_the_shock_of_sitting_down(device):
    perform(device, {"sit": 2.0})
    device.advance(0.551)  # at the peak of the shock, 1.28 g
    np.testing.assert_allclose(device.arm.model.opt.gravity, (0.0, 0.0, 2.28 * 9.80665), atol=0.1)
