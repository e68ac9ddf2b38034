"""The virtual wearer: reaches the pose, lets go, leaves alone, pushes."""

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trial_script import TrialScript
from exo_gravity.sim import STEP, ArmConfig, Hand, SimulatedArm, VirtualWearer

POSE = (-0.6, 0.9, 0.8, 0.7)
PUSH = (0.5, 2.0, 1.5, 1.0)
NOTHING = (0.0,) * 4
DEMO = TrialScript.parse(
    {
        "name": "test",
        "steps": [{"move": POSE, "over": 2.0}, {"hold": 1.0}, {"push": PUSH, "over": 0.4}, {"hold": 1.0}],
    }
)


def play(arm, wearer, begin, end, supported=0.0):
    """Let the wearer carry out his script from `begin` to `end`; return his torques (n, 4)."""
    torques = []
    for step in range(round(begin / STEP), round(end / STEP)):
        theta = arm.positions
        torque = wearer.torque(step * STEP, theta, arm.velocities)
        arm.step(np.add(torque, supported * gravity_torque(arm.config.links, theta)))
        torques.append(torque)
    return np.array(torques)


@pytest.mark.parametrize("supported", [0.0, 1.0])
@pytest.mark.parametrize("wearer_mass", [(0.0,) * 4, (0.0, 0.0, 1.5, 1.2)])
def test_the_hand_brings_any_arm_to_the_pose_and_to_rest(supported, wearer_mass):
    arm = SimulatedArm(ArmConfig(wearer_mass=wearer_mass, wearer_cog=(0, 0, 0.16, 0.18)))
    play(arm, VirtualWearer(DEMO), 0.0, 2.0, supported)
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) < 1.0
    assert np.abs(arm.velocities).max() < 0.1


def test_the_hand_lets_go_at_once_and_a_supported_arm_stays():
    arm, wearer = SimulatedArm(), VirtualWearer(DEMO)
    play(arm, wearer, 0.0, 2.0, supported=1.0)
    torques = play(arm, wearer, 2.0, 3.0, supported=1.0)
    assert not torques.any()
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) < 1.0


def test_an_unsupported_arm_falls_when_the_hand_lets_go():
    arm, wearer = SimulatedArm(), VirtualWearer(DEMO)
    play(arm, wearer, 0.0, 3.0)
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) > 20


def test_the_hand_leads_the_arm_along_a_minimum_jerk_path():
    arm, wearer = SimulatedArm(), VirtualWearer(DEMO)
    play(arm, wearer, 0.0, 0.75, supported=1.0)
    # Half of the 1.5 s under way: half the way, at 15/8 of the mean speed.
    np.testing.assert_allclose(arm.positions, np.divide(POSE, 2), atol=np.radians(3))
    np.testing.assert_allclose(arm.velocities, np.multiply(POSE, 15 / 8 / 1.5), rtol=0.2)


def test_the_hand_starts_from_where_the_arm_is():
    torque = VirtualWearer(DEMO).torque(0.0, (0.2, 0.3, 0.4, 0.5), NOTHING)
    assert torque == NOTHING


def test_the_hand_is_no_stronger_than_it_is_said_to_be():
    arm, wearer = SimulatedArm(), VirtualWearer(DEMO, Hand(max_torque=1.0))
    torques = play(arm, wearer, 0.0, 2.0)
    assert np.abs(torques).max() == 1.0
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) > 5


def test_a_push_is_half_a_sine_of_the_torques_asked():
    wearer = VirtualWearer(DEMO)
    for share, elapsed in ((0.0, 3.0), (np.sqrt(0.5), 3.1), (1.0, 3.2), (np.sqrt(0.5), 3.3)):
        np.testing.assert_allclose(wearer.torque(elapsed, POSE, NOTHING), np.multiply(PUSH, share), atol=1e-9)


def test_a_push_moves_the_arm():
    arm, wearer = SimulatedArm(), VirtualWearer(DEMO)
    arm.reset(POSE)
    play(arm, wearer, 3.0, 3.4, supported=1.0)
    assert np.degrees(np.abs(np.subtract(arm.positions, POSE)).max()) > 5


@pytest.mark.parametrize("elapsed", [-0.001, DEMO.duration, 1e6])
def test_the_wearer_does_nothing_before_the_start_and_after_the_end(elapsed):
    assert VirtualWearer(DEMO).torque(elapsed, POSE, (1.0,) * 4) == NOTHING


def test_the_step_under_way_is_told():
    wearer, seen = VirtualWearer(DEMO), []
    for elapsed in (-1.0, 0.0, 2.0, 3.0, 3.5, 4.5):
        wearer.torque(elapsed, POSE, NOTHING)
        seen.append(wearer.step)
    assert seen == [None, 0, 1, 2, 3, 4]


def test_an_impossible_hand_is_refused_by_name():
    with pytest.raises(ParameterError) as caught:
        Hand(stiffness=(60.0, 80.0, 60.0))
    assert caught.value.name == "stiffness"
