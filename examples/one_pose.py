# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque that holds an arm against gravity in one pose: upright and bowed, without and with the wearer's arm.

A plot follows; with a file's name (.png, .pdf, .svg) it is written there instead. The core alone needs no matplotlib.
"""

import sys
from math import radians

import matplotlib.pyplot as plt

from exo_gravity.core import ArmModel, Tilt, Wearer, gravity_torque

JOINTS = ("rotation", "abduction", "flexion", "elbow")
POSE = [radians(angle) for angle in (0, 30, 40, 30)]

robot = ArmModel(
    length=(0.05, 0.13, 0.30, 0.30),  # m
    cog=(0.046, 0.113, 0.237, 0.128),  # m from the joint along the link
    mass=(0.585, 0.468, 0.598, 0.203),  # kg
)
wearer = Wearer(body_mass=75.0).on_links(robot.length)

# One-G compensates the robot alone, Zero-G also the wearer's arm.
arms = {"One-G": robot, "Zero-G": robot.with_wearer(wearer.mass, wearer.cog)}
trunks = {"upright": Tilt.of("right"), "bowed by 20 degrees": Tilt.of("right", pitch=radians(20))}

axis = plt.figure(layout="constrained").subplots()
print(f"{'torque in Nm':<28}" + "".join(f"{joint:>11}" for joint in JOINTS))
for mode, arm in arms.items():
    for posture, trunk in trunks.items():
        torque = gravity_torque(arm, POSE, trunk.direction)
        print(f"{mode + ', ' + posture:<28}" + "".join(f"{value:11.2f}" for value in torque))
        axis.plot(JOINTS, torque, "o" if trunk is trunks["upright"] else "s", label=f"{mode}, {posture}")
axis.set_ylabel("Torque (Nm)")
axis.legend(frameon=False)
plt.savefig(sys.argv[1]) if len(sys.argv) > 1 else plt.show()
