# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What viewers show: the arm's pose against Pinocchio and the description, arcs, and the words for each state."""

import math

import mujoco
import numpy as np
import pinocchio
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.view import (
    AMBER,
    GREEN,
    GREY,
    LINE,
    RED,
    SIZES,
    ArmView,
    Described,
    PapersPicture,
    arm_shapes,
    described,
    gravity_shapes,
    state_of,
    urdf,
)  # fmt: skip
from exo_gravity.sim.urdf import UrdfConfig

NAMES = ("rotation", "abduction", "flexion", "elbow")
ROBOT = ArmModel((0.05, 0.13, 0.3, 0.3), (0.04, 0.1, 0.2, 0.15), (0.6, 0.5, 0.6, 0.2))
STILL = (0.0,) * 4


def arm(side="left"):
    return Described(side, PapersPicture(side, ROBOT, ()), Limits(NAMES))


def view(theta=STILL, velocity=STILL, effort=STILL, state="active", message="", side="left"):
    return ArmView(arm(side), theta, velocity, effort, state, message)


def lines(shapes, group):
    return [shape for shape in shapes if (shape.group, shape.kind) == (group, LINE)]


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_pose_is_that_of_the_description(side):
    model = pinocchio.buildModelFromXML(urdf([arm(side)]))
    data, rng = model.createData(), np.random.default_rng(1)
    for theta in rng.uniform(-math.pi, math.pi, (50, 4)):
        pinocchio.framesForwardKinematics(model, data, theta)
        origins, axes, _ = arm(side).pose(theta)
        frames = [data.oMf[model.getFrameId(name)] for name in arm(side).links]
        assert origins == pytest.approx(np.array([frame.translation for frame in frames]), abs=1e-12)
        # The description's own axes, in the frames of the links, which turn about them.
        local = [(0, 0, -1), (1, 0, 0), (0, -1, 0), (0, -1, 0)]
        mirrored = [(0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, -1, 0)]
        turned = [f.rotation @ a for f, a in zip(frames, local if side == "left" else mirrored, strict=False)]
        assert axes == pytest.approx(np.array(turned), abs=1e-12)


def test_the_range_of_each_joint_is_an_arc_on_which_the_link_points_at_its_angle():
    theta = (0.3, 0.8, 0.5, 1.0)
    origins, _, _ = arm().pose(theta)
    shapes = lines(arm_shapes(view(theta)), "limits")
    for n, (arc, needle) in enumerate(zip(shapes[0::2], shapes[1::2], strict=True)):
        assert np.linalg.norm(arc.points - origins[n], axis=1) == pytest.approx(SIZES.range_radius)
        link = origins[n + 1] - origins[n]
        start, tip = needle.points
        assert (tip - start) / SIZES.range_radius == pytest.approx(link / np.linalg.norm(link), abs=1e-12)
    shapes = lines(arm_shapes(view((0.0, 3.10, 0.0, 0.0))), "limits")  # joint 2 is near its limit
    assert [shape.colour for shape in shapes] == [GREY, GREY, RED, RED, GREY, GREY, GREY, GREY]


def test_a_torque_spans_its_share_of_the_limit_in_its_direction_and_is_red_at_the_limit():
    shapes = lines(arm_shapes(view(effort=(0.0, 4.5, -1.0, 3.0))), "torques")
    origins, axes, _ = arm().pose(STILL)
    for n, share in enumerate((0.0, 0.5, -1.0 / 3.0, 1.0)):
        start, end = ((shapes[n].points[i] - origins[n]) / SIZES.torque_radius for i in (0, -1))
        turn = math.atan2(np.cross(start, end) @ axes[n], start @ end)
        assert math.remainder(turn - share * SIZES.torque_span, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert [shape.colour for shape in shapes] == [GREEN, GREEN, GREEN, RED]


def test_gravity_points_along_its_vector_and_without_a_tilt_there_is_no_arrow():
    (arrow,) = gravity_shapes((0.0, 0.6, -0.8))
    direction = arrow.points[1] - arrow.points[0]
    assert direction / np.linalg.norm(direction) == pytest.approx((0.0, 0.6, -0.8))
    (text,) = gravity_shapes(None)
    assert (text.kind, text.text) == ("text", "no tilt")


@pytest.mark.parametrize(
    ("state", "more", "shown"),
    [
        ("active", {}, (GREEN, "active, holding")),
        ("active", {"velocity": (0.0, -0.3, 0.0, 0.0)}, (GREEN, "active, moving")),
        ("fault", {"message": "fault: no reply"}, (RED, "fault: no reply")),
        ("ramping in", {}, (AMBER, "ramping in")),
        ("letting down", {}, (AMBER, "letting down")),
        ("disabled", {}, (GREY, "disabled")),
        ("", {}, (GREY, "no state")),
    ],
)
def test_the_state_is_shown_by_colour_and_words(state, more, shown):
    assert state_of(view(state=state, **more)) == shown


def test_the_picture_of_a_seven_joint_arm_has_its_joints_where_mujoco_has_them() -> None:
    arm = configured_arm(packaged_config("seven_joints.yaml"), "right")
    picture, random = described(arm.compensator, arm.can_bridge), np.random.default_rng(0)
    text = packaged_config("arms/seven_joints.urdf").read_text(encoding="utf-8")
    given, _ = UrdfConfig(text=text, joint_names=arm.joint_names, hand="hand").models()
    drawn = mujoco.MjModel.from_xml_string(urdf([picture]))
    assert picture.side == "right" and [drawn.joint(n).name for n in range(drawn.njnt)] == list(arm.joint_names)
    truth, shown = mujoco.MjData(given), mujoco.MjData(drawn)
    for _ in range(20):
        theta = random.uniform(arm.low, arm.high)
        truth.qpos[:] = shown.qpos[:] = theta
        mujoco.mj_kinematics(given, truth)
        mujoco.mj_kinematics(drawn, shown)
        origins, axes, along = picture.pose(theta.tolist())
        np.testing.assert_allclose(origins[:-1], truth.xanchor, atol=1e-9)
        np.testing.assert_allclose(axes, truth.xaxis, atol=1e-9)
        np.testing.assert_allclose(origins[:-1], shown.xanchor, atol=1e-5)
        np.testing.assert_allclose(np.einsum("na,na->n", axes, along), 0.0, atol=1e-9)
    view = ArmView(picture, theta.tolist(), [0.0] * drawn.njnt, [1.0] * drawn.njnt, "active")
    assert len([shape for shape in arm_shapes(view) if shape.group == "torques"]) == 2 * drawn.njnt
