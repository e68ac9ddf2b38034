# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer's passive arm on the simulated device: Zero-G holds it.

The controller's masses of robot and wearer are a few per cent off the true ones.
"""

from __future__ import annotations

import numpy as np

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import resting

RATED = (3.0, 9.0, 3.0, 3.0)
NAMES = ("rotation", "abduction", "flexion", "elbow")
LIMITS = Limits(
    NAMES, (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14), (5.0, 5.0, 5.0, 6.0), RATED, sign_check_torque=0.0
)
MOTORS_OF_ARM = [JointMotor(MOTORS[name], n) for n, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
MASS, COG = Wearer(75.0).on_links(ROBOT.length)
CONTROLLER = Settings("right", ROBOT, mode="zero_g", support=1.0, wearer_mass=MASS, wearer_cog=COG)

HELD = [0.2, 0.35, -0.20, 0.9]  # within the motors' limits with all of a 75 kg wearer's arm
BENT = (0.06, -0.04)


def test_zero_g_holds_the_wearers_arm_for_10_s_within_a_sixth_of_a_degree():
    needed = gravity_torque(ROBOT.with_wearer(MASS, COG), HELD, Tilt.of("right", *BENT).direction)
    assert np.all(np.abs(needed) < RATED)
    arm = SimulatedArm(ArmConfig(wearer_mass=1.03 * MASS, wearer_cog=COG))
    device = SimulatedDevice(arm, [SimulatedMotor(motor) for motor in MOTORS_OF_ARM])
    device.pitch, device.roll = BENT
    script = TrialScript.parse({"name": "release", "steps": [{"move": HELD, "over": 3.0}, {"hold": 10.0}]})
    setup = ArmSetup("right", device, MOTORS_OF_ARM, LIMITS, CONTROLLER, 125.0, resting(*BENT))
    trial = OfflineTrial(setup, script, 3.0)
    recording = trial.run()
    hold = recording.steps[-1]
    position = recording.position[(recording.time >= hold.start) & (recording.time <= hold.end)]
    assert np.degrees(np.abs(position - position[0]).max()) < 0.5 / 3.0
    assert trial.trouble == ""
