# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque budget, against the known worst pose of each joint and against random poses, and the command `budget`."""

import functools
import math
import re

import matplotlib.image
import numpy as np
import pytest

from exo_gravity.core.arm.interface import Payload
from exo_gravity.core.arm.paper import gravity_torque
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.limits import CAN_BRIDGE
from exo_gravity.lab.budget import arm_budget, budget, motor_for, motor_torques, overload, torque_at, workspace
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config

from ..support import ROBOT
from ..support.thorough import quick
from ..support.urdf_oracle import WornMujocoArm

LOAD = Wearer(75.0).on_links(ROBOT.length)
WORN, SLACK = ROBOT.with_wearer(*LOAD), (Springs(), Springs())
LOW, HIGH = (-1.65, -0.17, -0.78, -0.17), (1.65, 3.14, 2.53, 3.14)
RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)


def own_budget(springs=SLACK, support=1.0, tilt=20.0, low=LOW, high=HIGH, rated=RATED):
    return budget(ROBOT, WORN, springs, support, workspace(low, high, math.radians(tilt)), rated, PEAK)


needs = functools.cache(own_budget)


@pytest.mark.parametrize("support", quick([0.4], [0.0, 0.4, 1.0]))
def test_each_joints_largest_torque_is_that_of_the_straight_horizontal_arm_and_joint_1_feels_a_tilted_trunk(support):
    carrying, tilt = ROBOT.with_wearer(*LOAD, support), math.radians(20.0)
    m1, m2, m3, m4 = (carrying.gravity * moment for moment in carrying.first_moment)
    expected = [0.0, m2 + m3 + m4, m3 + m4, m4]
    assert [joint.torque for joint in needs(support=support, tilt=0.0)] == pytest.approx(expected, abs=2e-3)
    horizontal = math.sqrt(1 - Tilt.of("left", tilt, tilt).direction[2] ** 2)
    assert needs(support=support)[0].torque == pytest.approx((m1 + m2 + m3 + m4) * horizontal, abs=2e-3)


def test_no_random_pose_of_either_arm_needs_more_than_the_worst_one_and_the_shares_are_theirs():
    joints, rng = needs(), np.random.default_rng(11)
    pose, tilts = rng.uniform(LOW, HIGH, (20_000, 4)), np.radians(rng.uniform(-20, 20, (20_000, 2)))
    for side in ("left", "right"):
        torque = np.abs(gravity_torque(WORN, pose, np.array([Tilt.of(side, *tilt).direction for tilt in tilts])))
        assert np.all(torque.max(axis=0) <= [joint.torque + 2e-3 for joint in joints])
        assert [joint.within_rated for joint in joints] == pytest.approx(np.mean(torque <= RATED, axis=0), abs=0.015)
        assert [joint.within_peak for joint in joints] == pytest.approx(np.mean(torque <= PEAK, axis=0), abs=0.015)
    at_worst = np.abs([torque_at(WORN, joint.worst[None])[0] for joint in joints]).diagonal()
    assert at_worst == pytest.approx([joint.torque for joint in joints], abs=5e-3)


def test_an_arm_that_bends_the_other_way_gets_the_same_support_and_the_devices_own_springs_count():
    low, high = (-1.65, -0.17, 0.3, -0.17), (1.65, 0.5, 2.53, 3.14)  # gravity always pulls joint 3 the same way
    one = own_budget(low=low, high=high)[2]
    other = own_budget(low=[-angle for angle in high], high=[-angle for angle in low])[2]
    assert other.support == pytest.approx(one.support, abs=2e-3)
    tensed = Springs((0.0, 0.0, 0.0, 0.5), (0.0, 0.0, 0.0, -1.0)), Springs()
    plain, sprung = (own_budget(springs, tilt=0.0)[3].torque for springs in (SLACK, tensed))
    points = np.random.default_rng(2).uniform(LOW, HIGH, (20_000, 4))
    assert plain < np.abs(gravity_torque(WORN, points)[:, 3] + 0.5 * (points[:, 3] + 1.0)).max() <= sprung + 2e-3


def test_strong_motors_support_the_whole_arm_and_none_if_the_robot_alone_needs_more_than_rated_torque():
    assert [joint.support for joint in needs(rated=(50, 50, 50, 50))] == [1.0] * 4
    assert needs(rated=(3, 3.7, 3, 3))[1].support is None
    assert needs(rated=(3, 3.8, 3, 3))[1].support == pytest.approx(0.0, abs=0.005)
    assert "b needs 19.6 Nm in its worst pose (rated 9, peak 18)" in overload("abcd", needs())
    assert "the robot alone needs too much" in overload("abcd", needs(rated=(3, 3.7, 3, 3)))
    assert overload("abcd", needs(support=0.068)) == ""


def test_motor_for_returns_the_smallest_motor_that_covers_the_torque():
    assert [motor_for(torque) for torque in (2.9, 3.1, 6.1, 8.4, 9.5, 19.6, 50.0)] == [
        "AK60-6", "AK80-6", "AK70-10", "AK80-9", "AK10-9", "AK80-64", None,
    ]  # fmt: skip


def test_a_torque_scale_below_1_and_a_warm_motor_reduce_its_torque_and_a_scale_above_1_does_not_raise_it():
    bus = {"can.interface": "virtual", "can.channel": "budget"}
    rated, peak = motor_torques(values_of(CAN_BRIDGE, {**bus, "torque_scale": [1.0, 0.5, 1.5, 1.0]}))
    assert rated.tolist() == [3.0, 4.5, 3.0, 3.0] and peak.tolist() == [9.0, 9.0, 9.0, 9.0]
    rated, _ = motor_torques(values_of(CAN_BRIDGE, {**bus, "torque_scale_slope": [-0.001, 0.0, 0.001, -0.001]}))
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


# The command


@pytest.fixture
def told(run_tool, params_with, tmp_path):
    """A function that runs budget on a packaged file with `changes` {node: {parameter: value}}."""

    def told(*words, file="sim.yaml", **changes):
        params = params_with(file, {f"/right/{node}": values for node, values in changes.items()})
        return run_tool("budget", "--params", params, "--output", tmp_path / "out", *words)

    return told


def rows_of(text):
    return [line.split() for line in text.splitlines() if re.match(r" *\d .*AK", line)]


@pytest.mark.usefixtures("without_pictures")
def test_full_zero_g_of_75_kg_is_reported_as_beyond_the_papers_motors_and_by_how_much(told):
    ended = told("--body-mass", 75)
    assert ended.code == 1 and "75 kg is beyond the motors of /right" in ended.text
    assert rows_of(ended.text)[1][2:6] == ["AK80-9", "9", "18", "19.63"] and rows_of(ended.text)[1][-1] == "AK80-64"
    assert "within rated torque everywhere is 0.068" in ended.text
    # The file's own wearer is the default.
    weak = told(can_bridge={"torque_scale": [1.0, 0.75, 1.0, 1.0]}, compensator={"wearer.body_mass": 75.0})
    assert rows_of(weak.text)[1][2:6] == ["AK80-9", "6.75", "13.5", "19.63"]
    both = told("--body-mass", 60, file="sim_both.yaml")  # mirrored arms share one table
    assert "/right and /left at support 1" in both.text and len(rows_of(both.text)) == 4


@pytest.mark.usefixtures("without_pictures")
def test_an_arm_that_nobody_wears_has_the_figures_of_the_arm_alone(told):
    three = functools.partial(told, file="three_joints.yaml")
    alone = [row[5] for row in rows_of(three("--body-mass", 70, "--support", 0).text)]
    for words, links in (((), [2, 3]), (("--body-mass", 70), [0, 0])):
        ended = three(*words, compensator={"wearer": {"links": links}})
        assert ended.code == 0 and "largest_moment: [" in ended.text and len(alone) == 3
        assert [row[5] for row in rows_of(ended.text)] == alone
    unfit = three("--body-mass", 70, compensator={"wearer": {"links": [3, 4]}})
    assert unfit.code == 2 and "compensator wearer.links = [3, 4]: must be 2 different links from 1 to 3" in unfit.text


@pytest.mark.thorough
def test_a_load_in_the_hand_is_part_of_the_torques_and_of_the_moments_and_every_joint_gets_a_figure(told, tmp_path):
    texts = [told("--body-mass", 40, "--support", 0.5, *more).text for more in ((), ("--payload", 1.5))]
    pictures = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in pictures] == [f"right_joint_{number}.png" for number in (1, 2, 3, 4)]
    assert all(matplotlib.image.imread(path).std() > 0.05 for path in pictures)
    assert "of a wearer of 40 kg with 1.5 kg in the hand is beyond" in texts[1]
    moments = [re.search(r"largest_moment: \[(.*?)\]", text)[1].split(", ") for text in texts]
    added = [float(new) - float(old) for old, new in zip(*moments, strict=True)]
    assert added == pytest.approx([1.5 * length for length in (0.05, 0.13, 0.30, 0.30)], abs=0.0011)
