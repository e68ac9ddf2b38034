# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Gravity compensation of a simulated arm, without ROS: read the motors, compute the torque, command it.

A plot shows how the torque rises and the arm stays; with a file's name (.png, .pdf, .svg) it is written there instead.
"""

import sys
from math import degrees

import matplotlib.pyplot as plt

from exo_gravity.core import ArmModel, gravity_torque
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim import SimulatedArm, SimulatedDevice, SimulatedMotor

PERIOD = 0.004  # s
POSE = (0.3, 0.8, 0.7, 0.6)  # rad
JOINTS = ("rotation", "abduction", "flexion", "elbow")

# The controller's model. The simulated arm has slightly different masses, as a real arm would.
model = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
motors = [JointMotor(MOTORS[name], can_id) for can_id, name in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"), 1)]
device = SimulatedDevice(SimulatedArm(), [SimulatedMotor(motor) for motor in motors])
device.arm.reset(POSE)

torque = [0.0] * 4
times, poses, torques = [], [], []
for motor in motors:
    device.exchange(motor.can_id, ENTER)
while device.time < 10.0:
    angles = []
    for motor, effort in zip(motors, torque, strict=True):
        _, reply = device.exchange(motor.can_id, motor.command(effort, damping=0.0))
        angles.append(motor.sample(reply, device.time).position)
    torque = gravity_torque(model, angles)
    times.append(device.time)
    poses.append([degrees(angle) for angle in angles])
    torques.append(torque)
    device.advance(PERIOD)
for motor in motors:
    device.exchange(motor.can_id, EXIT)

moved = [abs(degrees(now - before)) for now, before in zip(device.arm.positions, POSE, strict=True)]
print(f"After {device.time:.0f} s each joint is within {max(moved):.2f} degrees of where it was.")

figure, (upper, lower) = plt.subplots(2, sharex=True, layout="constrained")
upper.plot(times, poses, label=JOINTS)
upper.set_ylabel("Position (deg)")
upper.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False)
lower.plot(times, torques)
lower.set(xlabel="Time (s)", ylabel="Torque (Nm)", xlim=(0.0, times[-1]))
plt.savefig(sys.argv[1]) if len(sys.argv) > 1 else plt.show()
