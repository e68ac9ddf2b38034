# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The two references: gravity torques by independent libraries, from the same masses and Table 1 of the paper.

The Robotics Toolbox's `gravload` runs a recursive Newton-Euler algorithm over the Denavit-Hartenberg parameters;
Pinocchio's `computeGeneralizedGravity` runs one over spatial inertias. They share no code with `core.arm.paper` or
with each other.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.numbers import JOINT_COUNT

# Table 1 of the paper, standard Denavit-Hartenberg; a is the link's length, d is 0.
ALPHA = (-math.pi / 2, math.pi / 2, 0.0, 0.0)
OFFSET = (0.0, -math.pi / 2, 0.0, 0.0)

# RMSE of joints 2 to 4 over 1,053 positions, which the paper publishes in "Results from Simulation".
PAPER_ANALYTICAL = (6.06e-16, 4.06e-16, 8.03e-17)  # Nm
PAPER_ANFIS = (1.71e-3, 1.32e-3, 3.15e-4)  # Nm
PAPER_SECONDS = 380.0  # s, training of one joint

Reference = Callable[[np.ndarray, np.ndarray], np.ndarray]  # theta (n, 4), direction (n, 3) -> Nm (n, 4)


def gravload(arm: ArmModel) -> Reference:
    """Return the torque by the Robotics Toolbox: theta (n, 4) rad and gravity's direction (n, 3) -> (n, 4) Nm."""
    arm.check_masses("gravload")
    robot = toolbox_robot(arm)
    # Releases differ in the sign of `gravity`; in all of them the default means weight along -z.
    g = arm.gravity * -math.copysign(1.0, robot.gravity[2])

    def torque(theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        unscaled = np.array([robot.gravload(q, gravity) for q, gravity in zip(theta, g * direction, strict=True)])
        return np.asarray(arm.gain * unscaled)

    return torque


def toolbox_robot(arm: ArmModel) -> Any:
    """Return the arm as the Robotics Toolbox's DHRobot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)  # of its sources, which the first import compiles
        from roboticstoolbox import DHRobot, RevoluteDH

    return DHRobot(
        [
            # The toolbox measures a centre of gravity from the link's far end.
            RevoluteDH(a=a, alpha=alpha, offset=offset, m=m, r=(d - a, 0, 0), I=np.zeros((3, 3)), Jm=0, B=0, G=1)
            for a, alpha, offset, m, d in zip(arm.length, ALPHA, OFFSET, arm.mass, arm.cog, strict=True)
        ]
    )


def pinocchio(arm: ArmModel) -> Reference:
    """Return the torque by Pinocchio: theta (n, 4) rad and gravity's direction (n, 3) -> (n, 4) Nm."""
    arm.check_masses("Pinocchio")
    pin, model = pinocchio_model(arm)
    data = model.createData()

    def torque(theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        result = np.empty_like(theta)
        for i, gravity in enumerate(arm.gravity * direction):
            model.gravity.linear = gravity
            result[i] = pin.computeGeneralizedGravity(model, data, theta[i])
        return np.asarray(arm.gain * result)

    return torque


def pinocchio_model(arm: ArmModel) -> tuple[Any, Any]:
    """Return the module `pinocchio` and the arm as its Model."""
    import pinocchio as pin

    model = pin.Model()
    parent, placement = 0, pin.SE3.Identity()
    for joint in range(JOINT_COUNT):
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"joint_{joint + 1}")
        rotated = pin.SE3(pin.utils.rotate("z", OFFSET[joint]), np.zeros(3))
        at_cog = rotated * pin.SE3(np.eye(3), np.array((arm.cog[joint], 0.0, 0.0)))
        inertia = pin.Inertia(float(arm.mass[joint]), np.zeros(3), np.zeros((3, 3)))
        model.appendBodyToJoint(parent, inertia, at_cog)
        placement = rotated * pin.SE3(pin.utils.rotate("x", ALPHA[joint]), np.array((arm.length[joint], 0.0, 0.0)))
    return pin, model


REFERENCES = {"gravload": gravload, "Pinocchio": pinocchio}
