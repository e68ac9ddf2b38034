# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The law, against compiled Pinocchio and the Robotics Toolbox, all called from Python on the same arm and poses."""

from collections.abc import Iterator
from functools import partial
from typing import Any, cast

import numpy as np

from exo_gravity.core import gravity_torque
from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import COMPENSATOR, robot_of
from exo_gravity.core.params import values_of
from exo_gravity.hardware.urdf_arm import UrdfArm, read_urdf
from exo_gravity.lab.calibration.moment_model import DescribedModel
from exo_gravity.lab.calibration.tour import TorqueGuess
from exo_gravity.lab.inputs.arms import read_arm
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.lab.inputs.references import pinocchio_model, toolbox_robot

from .table import Row, race

POSES = 100_000
LOOP = 2_000  # of these poses, for the peers, which compute one pose per call


def measure_laws(quick: bool) -> Iterator[Row]:
    """Yield the rows of the law."""
    arm = robot_of(values_of(COMPENSATOR, {}))
    poses = np.random.default_rng(1).uniform(-1.5, 1.5, (POSES, 4))
    pin, model = pinocchio_model(arm)
    model.gravity.linear = np.array((0.0, 0.0, arm.gravity))
    data, robot = model.createData(), toolbox_robot(arm)
    law, tilt = ArmModel.torque, Tilt.of("right")
    pose = poses[0]
    theta = tuple(pose.tolist())
    np.testing.assert_allclose(law(arm, theta, tilt), pin.computeGeneralizedGravity(model, data, pose), atol=1e-12)

    blocks = 11 if quick else 51
    ours, pinocchio, toolbox = race(
        (
            (lambda: law(arm, theta, tilt), 2000),
            (lambda: pin.computeGeneralizedGravity(model, data, pose), 2000),
            (lambda: robot.gravload(pose), 20),
        ),
        blocks,
    )
    yield row("law, one pose: Pinocchio", ours, pinocchio)
    yield row("law, one pose: Robotics Toolbox", ours, toolbox)
    pool, columns = pin.ModelPool(model, 1), np.asfortranarray(poses.T)
    compiled_loop = partial(pin.rneaInParallel, 1, pool, columns, *[np.zeros_like(columns)] * 2)
    np.testing.assert_allclose(gravity_torque(arm, poses), compiled_loop().T, atol=1e-12)
    ours, *peers = race(
        (
            (lambda: gravity_torque(arm, poses), 1),
            (lambda: [pin.computeGeneralizedGravity(model, data, pose) for pose in poses[:LOOP]], 1),
            (compiled_loop, 1),
            (lambda: [robot.gravload(pose) for pose in poses[: LOOP // 100]], 1),
        ),
        blocks,
    )
    names = "Pinocchio in a loop", "Pinocchio's compiled loop, one thread", "Robotics Toolbox in a loop"
    for name, peer, count in zip(names, peers, (LOOP, POSES, LOOP // 100), strict=True):
        yield row(f"law, 100,000 poses, per pose: {name}", ours, peer, POSES, count)
    for file in ("three_joints.yaml", "seven_joints.yaml"):
        yield from _measure_urdf(pin, file, blocks)


def row(name: str, ours: list[float], peer: list[float], poses: int = 1, of_peer: int = 1) -> Row:
    """Return the row of calls that took so many s, and computed so many `poses` each, in us a pose."""
    return Row.of_values(name, np.multiply(1e6 / poses, ours).tolist(), np.multiply(1e6 / of_peer, peer).tolist(), "us")


def _measure_urdf(pin: Any, file: str, blocks: int) -> Iterator[Row]:
    """Yield the rows of the arm from a URDF that a file in config describes.

    Single poses are timed as the control loop computes them, and as a calibration tour does, with moments per joint.
    """
    arm = cast(UrdfArm, read_arm(load(packaged_config(file)), "/right").settings.robot)
    model = pin.buildModelFromXML(read_urdf(load(packaged_config(file))["/right/compensator"]["urdf.file"]))
    model.gravity.linear = np.array((0.0, 0.0, -arm.gravity))
    data, count = model.createData(), len(arm.length)
    poses = np.random.default_rng(1).uniform(-1.5, 1.5, (POSES, count))
    upright = np.tile(Tilt.of("left").direction, (POSES, 1))

    def loop() -> list[Any]:
        return [pin.computeGeneralizedGravity(model, data, pose) for pose in poses[:LOOP]]

    np.testing.assert_allclose(arm.gain * loop(), arm.torques(poses[:LOOP], upright[:LOOP]), atol=1e-12)
    ours, peer = race(((lambda: arm.torques(poses, upright), 1), (loop, 1)), blocks)
    name = f"law of a URDF with {count} joints"
    yield row(f"{name}, 100,000 poses, per pose: Pinocchio in a loop", ours, peer, POSES, LOOP)
    theta, still, tilt = poses[0].tolist(), np.zeros(count), Tilt.of("left")
    hold = TorqueGuess(DescribedModel(arm.scaled([1.0] * count, arm.gravity), uses_imu=True)).torque
    np.testing.assert_allclose(hold(theta, tilt), np.divide(arm.torque(theta, tilt), arm.gain), atol=1e-9)
    loop_pose, peer, tour_pose, regressor = race(
        (
            (lambda: arm.torque(theta, tilt), 500),
            (lambda: pin.computeGeneralizedGravity(model, data, poses[0]), 500),
            (lambda: hold(theta, tilt), 200),
            (lambda: pin.computeJointTorqueRegressor(model, data, poses[0], still, still), 200),
        ),
        blocks,
    )
    yield row(f"{name}, one pose: Pinocchio", loop_pose, peer)
    yield row(f"{name}, one pose, moments of each joint: Pinocchio's regressor", tour_pose, regressor)
