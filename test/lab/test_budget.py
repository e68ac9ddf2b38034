# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque budget, against the known worst pose of each joint and against random poses."""

import functools
import math

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.arm.paper import gravity_torque
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.lab.budget import (
    arm_budget,
    budget,
    joint_figure,
    motor_for,
    motor_torques,
    overload,
    table_lines,
    torque_at,
    workspace,
)
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config

from ..support.thorough import quick
from ..support.urdf_oracle import WornMujocoArm

LINKS = (0.05, 0.13, 0.30, 0.30)
ROBOT = ArmModel(LINKS, (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))
LOAD = Wearer(75.0).on_links(LINKS)
WORN, SLACK = ROBOT.with_wearer(*LOAD), (Springs(), Springs())
LOW, HIGH = (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14)
BUS = {"can.interface": "virtual", "can.channel": "budget"}
RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)


@functools.cache
def needs(support=1.0, tilt=20.0, rated=RATED, peak=PEAK, robot=ROBOT):
    return budget(
        robot, robot.with_wearer(*LOAD), SLACK, support, workspace(LOW, HIGH, math.radians(tilt)), rated, peak
    )


@pytest.mark.parametrize("support", [0.0, 0.4, 1.0])
def test_each_joints_largest_torque_is_that_of_the_straight_horizontal_arm_and_joint_1_feels_a_tilted_trunk(support):
    carrying, tilt = ROBOT.with_wearer(*LOAD, support), math.radians(20.0)
    m1, m2, m3, m4 = (carrying.gravity * moment for moment in carrying.first_moment)
    expected = [0.0, m2 + m3 + m4, m3 + m4, m4]
    assert [joint.torque for joint in needs(support, tilt=0.0)] == pytest.approx(expected, abs=2e-3)
    horizontal = math.sqrt(1 - Tilt.of("left", tilt, tilt).direction[2] ** 2)
    assert needs(support)[0].torque == pytest.approx((m1 + m2 + m3 + m4) * horizontal, abs=2e-3)


def test_no_random_pose_of_either_arm_needs_more_than_the_worst_one_and_the_shares_are_theirs():
    joints, rng = needs(), np.random.default_rng(11)
    pose, tilts = rng.uniform(LOW, HIGH, (20_000, 4)), np.radians(rng.uniform(-20, 20, (20_000, 2)))
    for side in ("left", "right"):
        direction = np.array([Tilt.of(side, *tilt).direction for tilt in tilts])
        torque = np.abs(gravity_torque(WORN, pose, direction))
        assert np.all(torque.max(axis=0) <= [joint.torque + 2e-3 for joint in joints])
        assert [joint.within_rated for joint in joints] == pytest.approx(np.mean(torque <= RATED, axis=0), abs=0.015)
        assert [joint.within_peak for joint in joints] == pytest.approx(np.mean(torque <= PEAK, axis=0), abs=0.015)
    at_worst = np.abs([torque_at(WORN, joint.worst[None])[0] for joint in joints]).diagonal()
    assert at_worst == pytest.approx([joint.torque for joint in joints], abs=5e-3)


def test_a_share_is_below_1_if_a_single_pose_is_overloaded_and_at_the_largest_support_a_joint_needs_its_rated_torque():
    joints = needs()
    (_, joint, *_), (_, within, *_) = (needs(rated=(3, joints[1].torque + margin, 3, 3)) for margin in (-0.01, 0.01))
    assert joint.within_rated < 1.0 and within.within_rated == 1.0
    for number, joint in enumerate(joints):
        assert needs(joint.support)[number].torque == pytest.approx(RATED[number], abs=0.02)


def test_an_arm_that_bends_the_other_way_gets_the_same_support():
    flexion = (-1.65, -0.17, 0.3, -0.17), (1.65, 0.5, 2.53, 3.14)  # gravity always pulls joint 3 in the same direction
    other_way = tuple(-angle for angle in flexion[1]), tuple(-angle for angle in flexion[0])
    one, other = (
        budget(ROBOT, WORN, SLACK, 1.0, workspace(*limits, 0.1), RATED, PEAK)[2] for limits in (flexion, other_way)
    )
    assert other.support == pytest.approx(one.support, abs=2e-3)


def test_strong_motors_support_the_whole_arm_and_none_if_the_robot_alone_needs_more_than_rated_torque():
    assert [joint.support for joint in needs(rated=(50, 50, 50, 50))] == [1.0] * 4
    assert needs(rated=(3, 3.7, 3, 3))[1].support is None
    assert needs(rated=(3, 3.8, 3, 3))[1].support == pytest.approx(0.0, abs=0.005)


def test_the_devices_own_springs_count():
    tensed = Springs((0.0, 0.0, 0.0, 0.5), (0.0, 0.0, 0.0, -1.0)), Springs()
    bounds = workspace(LOW, HIGH, 0.0)
    plain, sprung = (budget(ROBOT, WORN, one, 1.0, bounds, RATED, PEAK)[3] for one in (SLACK, tensed))
    points = np.random.default_rng(2).uniform(LOW, HIGH, (20_000, 4))
    torque = gravity_torque(ROBOT.with_wearer(*LOAD), points)[:, 3] + 0.5 * (points[:, 3] + 1.0)
    assert plain.torque < np.abs(torque).max() <= sprung.torque + 2e-3


def test_motor_for_returns_the_smallest_motor_that_covers_the_torque():
    assert [motor_for(torque) for torque in (2.9, 3.1, 6.1, 8.4, 9.5, 19.6, 50.0)] == [
        "AK60-6", "AK80-6", "AK70-10", "AK80-9", "AK10-9", "AK80-64", None,
    ]  # fmt: skip


def test_overload_names_each_overloaded_joint_and_the_support_that_fits():
    text = overload(("a", "b", "c", "d"), needs())
    assert "b needs 19.6 Nm in its worst pose (rated 9, peak 18)" in text
    assert text.startswith("motors overloaded: a needs") and text.endswith("the largest support that fits is 0.068")
    assert "the robot alone needs too much" in overload("abcd", needs(rated=(3, 3.7, 3, 3)))
    assert overload("abcd", needs(support=0.068)) == ""


def test_a_torque_scale_below_1_and_a_warm_motor_reduce_its_torque_and_a_scale_above_1_does_not_raise_it():
    bridge = values_of(CAN_BRIDGE, {**BUS, "torque_scale": [1.0, 0.5, 1.5, 1.0]})
    rated, peak = motor_torques(bridge)
    assert rated.tolist() == [3.0, 4.5, 3.0, 3.0] and peak.tolist() == [9.0, 9.0, 9.0, 9.0]
    rated, _ = motor_torques(values_of(CAN_BRIDGE, {**BUS, "torque_scale_slope": [-0.001, 0.0, 0.001, -0.001]}))
    assert rated == pytest.approx([3.0 * (1.0 - 0.045), 9.0, 3.0, 3.0 * (1.0 - 0.045)])


@pytest.mark.parametrize("name", quick(["elbow"], ["elbow", "seven_joints"]))
def test_the_budget_of_an_arm_from_a_urdf_is_what_mujoco_needs_in_its_worst_pose(name: str) -> None:
    arm, payload = configured_arm(packaged_config(f"{name}.yaml"), "right"), 0.5 * (name == "elbow")
    found = arm_budget(arm, Wearer(75.0), 1.0, 0.0, payload)
    load = Wearer(75.0).on_links(arm.robot.length, arm.compensator["wearer.links"])
    text = packaged_config(f"arms/{name}.urdf").read_text(encoding="utf-8")
    oracle = WornMujocoArm(text, arm.joint_names, load.mass, load.cog, Payload(payload))
    for number, joint in enumerate(found.joints):
        assert joint.torque == pytest.approx(abs(oracle.torque(joint.worst[:-2])[number]), rel=1e-4, abs=1e-3)
    if name == "elbow":
        needed = [abs(float(oracle.torque([angle])[0])) for angle in np.linspace(arm.low[0], arm.high[0], 500)]
        assert found.joints[0].torque == pytest.approx(max(needed), rel=1e-4)
        assert "1 elbow" in "\n".join(table_lines(found))
        assert len(joint_figure(found, 0).axes) == 2
