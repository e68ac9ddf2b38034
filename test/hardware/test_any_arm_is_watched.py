# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Torque that gravity cannot account for on arms from URDFs: MuJoCo's torque is explained, a wrong one is not."""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointSample
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.motion_monitor import GRAVITY, MotionMonitor
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.inputs.parameter_file import packaged_config

from ..support.chains import random_chain
from ..support.urdf_oracle import MujocoArm

PERIOD = 0.004


def limits_of(arm: UrdfArm, **changes: object) -> Limits:
    """What `budget` prints for the arm."""
    found, count = arm.skeleton(), len(arm.names)
    rows = {f"{name}_{axis}": tuple(column.round(4)) for name, of in (("axis", found.axes), ("link", found.ways))
            for axis, column in zip("xyz", of.T, strict=True)}  # fmt: skip
    addition = np.minimum(10.0, GRAVITY * found.beside)
    limits = {"max_effort": (500.0,) * count, "position_min": (-3.0,) * count, "position_max": (3.0,) * count}
    moments = {"largest_moment": tuple(found.moments), "largest_addition": tuple(addition)}
    return Limits(arm.names, **{**limits, **moments, **rows, "max_command": (500.0,) * count, **changes})


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7, 9])
def test_what_mujoco_needs_of_any_chain_is_explained_in_any_pose_at_any_tilt(count: int, side: str) -> None:
    text, names = random_chain(count, seed=count)
    arm, truth, random = UrdfArm(text, names, "hand"), MujocoArm(text, names), np.random.default_rng(count)
    monitor, beside = MotionMonitor(limits_of(arm)), GRAVITY * arm.skeleton().beside
    for _ in range(50):
        theta, (pitch, roll) = random.uniform(-3.0, 3.0, count), random.uniform(-1.0, 1.0, 2)
        tilt = Tilt.of(side, pitch, roll)
        monitor.follow(tilt, None)
        low, high = monitor.explained(theta.tolist())
        torque = truth.torque(theta, 9.80665 * np.array(tilt.gravity_in_trunk))
        assert np.all(low - beside - 0.01 <= torque) and np.all(torque <= high + beside + 0.01)


@pytest.mark.parametrize("name", ["elbow", "three_joints", "seven_joints"])
def test_the_torque_of_a_shipped_arm_is_no_fault_and_its_opposite_is(name: str) -> None:
    text = packaged_config(f"arms/{name}.urdf").read_text(encoding="utf-8")
    names = {"elbow": ["elbow"], "three_joints": ["abduction", "flexion", "elbow"]}.get(
        name, ["flexion", "abduction", "rotation", "elbow", "pronation", "wrist_deviation", "wrist_flexion"]
    )
    arm, theta = UrdfArm(text, names, "hand"), [0.5 + 0.1 * n for n in range(len(names))]
    torque = MujocoArm(text, names).torque(theta, (0.0, 0.0, -9.80665))
    samples = tuple(JointSample(angle, 0.0, 0.0, None, None, 0.0) for angle in theta)
    for share, is_fault in ((1.0, False), (0.3, False), (-1.0, True), (3.0, True)):
        monitor, fault = MotionMonitor(limits_of(arm)), None
        for _ in range(100):
            fault = fault or monitor.step(PERIOD, samples, (share * torque).tolist())[1]
        assert bool(fault) is is_fault
        assert fault is None or fault.code is FaultCode.UNEXPLAINED_TORQUE


def test_axes_that_are_no_directions_and_moments_without_a_link_are_refused() -> None:
    text, names = random_chain(3, seed=3)
    arm = UrdfArm(text, names, "hand")
    none = (0.0,) * 3
    with pytest.raises(ParameterError, match=r"largest_moment = .*must be zeros without axis_x"):
        limits_of(arm, axis_x=none, axis_y=none, axis_z=none)
    with pytest.raises(ParameterError, match=rf"axis_x, _y, _z of {names[1]} = .*must be a vector of length 1"):
        limits_of(arm, axis_x=(*limits_of(arm).axis_x[:1], 0.0, 0.0), axis_y=(*limits_of(arm).axis_y[:1], 0.0, 1.0),
                  axis_z=(*limits_of(arm).axis_z[:1], 0.0, 0.0))  # fmt: skip
    with pytest.raises(ParameterError, match=rf"largest_moment of {names[0]} = .*must be 0 for a link without"):
        limits_of(arm, link_x=none, link_y=none, link_z=none)
