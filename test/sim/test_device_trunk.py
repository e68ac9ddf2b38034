"""The trunk of the simulated device follows the wearer's script, and the arm feels it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.core.trial.script import TrialScript
from exo_gravity.sim import VirtualWearer

from ..support.simulated_device import make_device


@pytest.fixture
def device():
    return make_device()


def perform(device, *steps):
    device.start(VirtualWearer(TrialScript.parse({"name": "trunk", "steps": list(steps)})))


def test_the_trunk_bows_and_stays_bowed(device):
    device.pitch, device.roll = 0.1, -0.06
    perform(device, {"hold": 0.5}, {"bow": 0.5, "over": 1.0}, {"hold": 0.5})
    device.advance(0.4)
    assert (device.pitch, device.trunk_moves) == (0.1, False)
    device.advance(0.6)
    assert device.trunk_moves
    assert device.trunk.pitch == device.pitch == pytest.approx(0.3, abs=0.001)
    assert device.trunk.pitch_rate == pytest.approx(0.4 * 1.875, rel=0.01)
    device.advance(1.0)
    assert (device.pitch, device.roll) == pytest.approx((0.5, -0.06), abs=1e-6)
    assert not device.trunk_moves
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
