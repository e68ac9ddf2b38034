# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Teach and repeat on a simulated arm, without ROS: a hand leads the weightless arm, then a soft spring leads it back.

The law carries the arm; the term `spring` pulls it along the recorded path with little torque, so that a person in it
can stop or divert it at any time. A plot shows both paths; with a file's name (.png, .pdf, .svg) it is written there
instead.
"""

import sys
from dataclasses import replace
from math import degrees, dist

import matplotlib.pyplot as plt

from exo_gravity.core import ArmModel
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.catalogue import Friction, Spring
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.limits import Limits
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor, VirtualWearer
from exo_gravity.sim.controllers import DirectController
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import VirtualArm

JOINTS = ("rotation", "abduction", "flexion", "elbow")
PERIOD = 0.004  # s
APPROACH = 12.0  # s for the spring to take effect, a guided change, and to bring the arm to the start of the path
LED = [[0.2, 0.6, 0.5, 0.6], [0.3, 0.9, 0.8, 0.9], [0.0, 0.5, 0.4, 0.5]]  # rad, where the hand goes, 2 s each

robot = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
motors = [JointMotor(MOTORS[name], can_id) for can_id, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in motors])
compensator = Compensator(settings := Settings("right", robot, use_imu=False))
limits = Limits(JOINTS, sign_check_torque=0.0)
arm = VirtualArm(device, DirectController(compensator, limits), motors, limits, 1.0 / PERIOD)


def cycle():
    """Run one cycle of the control loop; return the joint angles."""
    arm.loop.cycle()
    return device.arm.positions


arm.enable()
arm.run_until(lambda: arm.safety.state is State.ACTIVE)
script = TrialScript.parse({"name": "teach", "steps": [{"move": pose, "over": 2.0} for pose in LED]})
device.start(VirtualWearer(script), delay=1.0)
poses = [cycle() for _ in range(round((1.0 + script.duration) / PERIOD))]
path = [0.0, *poses[0]]  # rows of s and four angles
path += [number for row, pose in enumerate(poses[::5]) for number in (APPROACH + 0.02 * row, *pose)]

spring = Spring(stiffness=(3.5, 9.0, 6.0, 3.3), pose=path)
COULOMB, VISCOUS = (0.2, 0.4, 0.2, 0.2), (0.0, 0.0, 0.0, 0.0)  # as identified: else the spring must overcome it
friction = Friction(share=0.8, coulomb=COULOMB, viscous=VISCOUS)
compensator.apply(replace(settings, terms=TermSettings(spring=spring, friction=friction)))
for _ in range(round(APPROACH / PERIOD)):
    cycle()
repeated = [cycle() for _ in poses]
errors = [degrees(dist(a, b)) for a, b in zip(poses, repeated, strict=True)]
print(f"The arm repeats the path within {max(errors):.1f} degrees, on average {sum(errors) / len(errors):.1f}.")

axis = plt.figure(layout="constrained").subplots()
times = [PERIOD * row for row in range(len(poses))]
for joint, name in enumerate(JOINTS):
    (line,) = axis.plot(times, [degrees(pose[joint]) for pose in repeated], label=name)
    axis.plot(times, [degrees(pose[joint]) for pose in poses], "--", color=line.get_color())
axis.set(title="Dashed: taught. Solid: repeated.", xlabel="Time (s)", ylabel="Position (deg)")
axis.legend(frameon=False)
plt.savefig(sys.argv[1]) if len(sys.argv) > 1 else plt.show()
