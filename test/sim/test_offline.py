# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A trial without a bus, in simulated time: its script, its virtual wearer, and the arm, always let down at the end."""

from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core import gravity_torque
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import (
    STEP,
    ArmConfig,
    SimulatedArm,
    SimulatedDevice,
    SimulatedMotor,
    VirtualWearer,
)
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import resting

NAMES = ("rotation", "abduction", "flexion", "elbow")

POSE = [0.1, 0.6, 0.7, 0.5]

SCRIPT = TrialScript.parse({"name": "one", "steps": [{"move": POSE, "over": 2.0}, {"hold": 3.0}]})

MOTORS_AS_MOUNTED = (
    JointMotor(MOTORS["AK60-6"], 1),
    JointMotor(MOTORS["AK80-9"], 2, -1, 0.4),
    JointMotor(MOTORS["AK60-6"], 3, 1, -0.2),
    JointMotor(MOTORS["AK60-6"], 4, -1),
)

LIMITS = Limits(
    NAMES,
    (-1.65, -0.17, -0.78, -0.17),
    (1.65, 3.14, 2.53, 3.14),
    (5.0,) * 4,
    (3.0, 9.0, 3.0, 3.0),
    sign_check_torque=0.0,
)

ONE_G = Settings("right", DEFAULT_LINKS)

BENT = (0.1, -0.06)  # rad

DELAY = 2.5  # s after the motors are switched on, in which they ramp in


def make(true=None, assumed=ONE_G, tilt=BENT, ids=(1, 2, 3, 4), script=SCRIPT):
    """Return a trial of a simulated arm that is as `true`, whose controller has the settings `assumed`.

    tilt: of the trunk, rad; None: it is not measured.
    """
    device = SimulatedDevice(SimulatedArm(true), [SimulatedMotor(motor) for motor in MOTORS_AS_MOUNTED])
    device.pitch, device.roll = tilt or BENT
    motors = [replace(motor, can_id=can_id) for motor, can_id in zip(MOTORS_AS_MOUNTED, ids, strict=True)]
    arm = ArmSetup("right", device, motors, LIMITS, assumed, 125.0, tilt and resting(*tilt))
    return OfflineTrial(arm, script, DELAY)


@pytest.fixture(scope="module")
def done():
    """A trial from start to end, and its recording."""
    trial = make()
    return trial, trial.run()


def held(recording):
    (hold,) = [step for step in recording.steps if step.action == "hold"]
    return recording.position[(recording.time >= hold.start) & (recording.time <= hold.end)]


def test_the_arm_stays_where_the_wearer_released_it_and_is_let_down_at_the_end(done):
    trial, recording = done
    position, end = held(recording), recording.steps[-1].end
    assert trial.trouble == "" and trial.events == []
    np.testing.assert_allclose(position[0], POSE, atol=0.03)
    assert np.ptp(position, axis=0).max() < 0.001
    during = (recording.time > recording.steps[-1].start) & (recording.time < end)
    np.testing.assert_allclose(recording.command[during], recording.effort[during], atol=0.01)
    assert np.abs(recording.velocity[recording.time > end]).max() < 1.0
    assert abs(recording.position[-1, 2]) < 0.2  # friction holds it there
    assert not any(motor.entered for motor in trial.arm.device.motors)


def test_a_stop_lets_the_arm_down_and_keeps_the_recording_which_is_the_same_until_then(done):
    trial = make()
    recording = trial.run(lambda now: now >= 6.0)
    assert np.all(recording.position[: 6 * 125] == done[1].position[: 6 * 125])
    assert trial.trouble == "right: stopped by the operator"
    ((start, end),) = recording.carried
    assert 1.0 < start < 2.0  # the checks take a second without trouble
    assert end == pytest.approx(6.0, abs=0.01)
    assert end + 2.0 < recording.time[-1] < 36.0  # of letting down
    assert not any(motor.entered for motor in trial.arm.device.motors)


def test_without_a_tilt_the_arm_is_never_carried_and_the_reason_is_given():
    trial = make(tilt=None)
    assert trial.run().carried == ()
    assert "waited for effort commands" in trial.trouble and "no trunk tilt yet" in trial.trouble


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (b"name: x\nsteps:\n  - {hold: 1.0}\nsteps:\n  - {hold: 2.0}\n", "steps is given twice"),
        (b"name: x\nsteps: [{hold: 1.0, hold: 30.0}]\n", "hold is given twice"),
        (b"\xff\xfe", "decode"),
        (b"[\n" * 1500, "depth"),
        (None, "No such file"),
    ],
)
def test_a_file_that_says_something_twice_or_cannot_be_read_is_refused(text, why, tmp_path):
    path = tmp_path / "trial.yaml"
    if text is not None:
        path.write_bytes(text)
    with pytest.raises(ParameterError, match=why) as caught:
        TrialScript.read(path)
    assert caught.value.name == "trial" and str(path) in str(caught.value)


THERE = (-0.6, 0.9, 0.8, 0.7)

PUSH = (0.5, 2.0, 1.5, 1.0)

NO_TORQUE = (0.0,) * 4

PUSHED = TrialScript.parse(
    {
        "name": "test",
        "steps": [{"move": THERE, "over": 2.0}, {"hold": 1.0}, {"push": PUSH, "over": 0.4}, {"hold": 1.0}],
    }
)


def simulate(arm, wearer, begin, end, supported=0.0):
    """Run the script from `begin` to `end` s and return the wearer's torques (n, 4).

    supported: share of gravity that is compensated.
    """
    torques = []
    for step in range(round(begin / STEP), round(end / STEP)):
        theta = arm.positions
        torque = wearer.torque(step * STEP, theta, arm.velocities)
        arm.step(np.add(torque, supported * gravity_torque(arm.config.links, theta)))
        torques.append(torque)
    return np.array(torques)


@pytest.mark.parametrize(("supported", "wearer_mass"), [(0.0, (0.0, 0.0, 1.5, 1.2)), (1.0, (0.0,) * 4)])
def test_the_hand_moves_any_arm_to_the_pose_and_to_rest_and_releases_it_at_once(supported, wearer_mass):
    arm, wearer = SimulatedArm(ArmConfig(wearer_mass=wearer_mass, wearer_cog=(0, 0, 0.16, 0.18))), VirtualWearer(PUSHED)
    simulate(arm, wearer, 0.0, 2.0, supported)
    assert np.degrees(np.abs(np.subtract(arm.positions, THERE)).max()) < 1.0
    assert np.abs(arm.velocities).max() < 0.1
    assert not simulate(arm, wearer, 2.0, 3.0, supported).any()  # released at once; a supported arm stays
    assert not supported or np.degrees(np.abs(np.subtract(arm.positions, THERE)).max()) < 1.0


def test_the_hand_moves_along_a_minimum_jerk_path_no_stronger_than_it_is_and_pushes_by_a_half_sine():
    arm, wearer = SimulatedArm(), VirtualWearer(PUSHED)
    simulate(arm, wearer, 0.0, 0.75, supported=1.0)
    # Halfway through a motion of 1.5 s: half the distance, at 15/8 of the mean speed.
    np.testing.assert_allclose(arm.positions, np.divide(THERE, 2), atol=np.radians(3))
    np.testing.assert_allclose(arm.velocities, np.multiply(THERE, 15 / 8 / 1.5), rtol=0.2)
    assert np.abs(simulate(SimulatedArm(), VirtualWearer(PUSHED, strength=1.0), 0.0, 2.0)).max() == 1.0
    for share, elapsed in ((0.0, 3.0), (np.sqrt(0.5), 3.1), (1.0, 3.2)):
        np.testing.assert_allclose(wearer.torque(elapsed, THERE, NO_TORQUE), np.multiply(PUSH, share), atol=1e-9)


def test_the_wearer_reports_the_active_step_starts_where_the_arm_is_and_gives_no_torque_before_and_after():
    wearer, seen = VirtualWearer(PUSHED), []
    for elapsed in (-1.0, 0.0, 2.0, 3.0, 3.5, PUSHED.duration + 0.1, 1e6):
        assert wearer.torque(elapsed, (0.2, 0.3, 0.4, 0.5), NO_TORQUE) == NO_TORQUE
        seen.append(wearer.step)
    assert seen == [None, 0, 1, 2, 3, 4, 4]
