"""A wearer's passive arm on the simulated device: One-G lets it sink, Zero-G holds it, with a smooth transition.

The controller's masses of robot and wearer are a few per cent off the true ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.model.wearer import Wearer
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.offline import ArmSetup, OfflineTrial, resting

RATED = (3.0, 9.0, 3.0, 3.0)
NAMES = ("rotation", "abduction", "flexion", "elbow")
LIMITS = Limits(
    NAMES, (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14), (5.0, 5.0, 5.0, 6.0), RATED, sign_check_torque=0.0
)
MOTORS_OF_ARM = [JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
MASS, COG = Wearer(75.0).on_links(ROBOT.length)
CONTROLLER = Settings("right", ROBOT, mode="zero_g", wearer_mass=MASS, wearer_cog=COG)

# Within the motors' limits with all of a 75 kg wearer's arm.
UPRIGHT, BENT = (0.0, 0.0), (0.06, -0.04)
HELD = [0.2, 0.35, -0.20, 0.9]


def carried(settings, pose, tilt=UPRIGHT, seconds=10.0, after=()):
    """Return a trial in which a hand moves the passive arm to `pose` and releases it."""
    arm = SimulatedArm(ArmConfig(wearer_mass=1.03 * MASS, wearer_cog=COG))
    device = SimulatedDevice(arm, [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])
    device.pitch, device.roll = tilt
    steps = [{"move": pose, "over": 3.0}, *after, {"hold": seconds}]
    script = TrialScript.parse({"name": "release", "steps": steps})
    return OfflineTrial(ArmSetup("right", device, MOTORS_OF_ARM, LIMITS, settings, 250.0, resting(*tilt)), script, 3.0)


def moved(trial):
    """Return the movement of each joint in degrees in the last step of a trial."""
    recording = trial.run()
    hold = recording.steps[-1]
    position = recording.position[(recording.time >= hold.start) & (recording.time <= hold.end)]
    return np.degrees(np.abs(position - position[0]).max(axis=0))


def test_zero_g_holds_the_wearers_arm_for_10_s_within_a_sixth_of_a_degree():
    needed = gravity_torque(ROBOT.with_wearer(MASS, COG), HELD, Tilt.of("right", *BENT).direction)
    assert np.all(np.abs(needed) < RATED)
    trial = carried(CONTROLLER, HELD, BENT)
    assert moved(trial).max() < 0.5 / 3.0
    assert trial.trouble == ""


def test_one_g_lets_the_same_arm_sink():
    assert moved(carried(replace(CONTROLLER, mode="one_g"), HELD, seconds=3.0))[1] > 10.0


def test_a_sweep_of_the_support_changes_the_torque_smoothly_until_it_holds_the_arm_alone():
    pose = [0.3, 0.45, 0.10, 0.4]
    trial = carried(replace(CONTROLLER, support=0.0), pose, seconds=3.0, after=[{"move": pose, "over": 12.0}])
    support = iter(np.linspace(0.1, 1.0, 10))

    def every_second(now):
        if now > 5.0:
            trial.compensator.apply(replace(CONTROLLER, support=next(support, 1.0)))
        return False

    recording = trial.run(every_second)
    sweep = (recording.time > 4.0) & (recording.time < recording.steps[-1].end)
    with_all = gravity_torque(CONTROLLER.arm, pose)
    largest_step = np.abs(np.diff(recording.command[sweep], axis=0)).max()
    assert largest_step < 0.02  # Nm; half of it is the 12-bit code of an angle
    np.testing.assert_allclose(recording.command[sweep][-1], with_all, atol=0.1)
    hold = recording.time > recording.steps[-1].start
    assert np.ptp(np.degrees(recording.position[sweep & hold]), axis=0).max() < 0.5
    assert trial.trouble == ""
