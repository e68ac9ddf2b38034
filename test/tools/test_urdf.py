# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What viewers show of an arm: its description against Pinocchio and MuJoCo, its pose, arcs, and words for each state.

The torques of the description are read from its XML by Pinocchio.
"""

import math
from dataclasses import replace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio
import pytest

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import configured_arm, configured_arms
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
    OnTrunk,
    arm_shapes,
    described,
    gravity_shapes,
    state_of,
    urdf,
)  # fmt: skip
from exo_gravity.tools.urdf import urdf_of

from ..support import CONFIG

EXO = CONFIG / "exo.yaml"
STILL = (0.0,) * 4

# The description

NAMES = ("rotation", "abduction", "flexion", "elbow")
THETA = np.random.default_rng(1).uniform(-np.pi, np.pi, (300, 4))
DOWN = np.random.default_rng(2).normal(size=(300, 3))  # gravity in the trunk's axes, over the whole sphere
DOWN /= np.linalg.norm(DOWN, axis=1, keepdims=True)


def by_pinocchio(text, joints, gravity):
    model = pinocchio.buildModelFromXML(text)
    data, result = model.createData(), []
    at = [model.joints[model.getJointId(name)].idx_q for name in joints]
    for pose, down in zip(THETA, gravity * DOWN, strict=True):
        q = pinocchio.neutral(model)
        q[at] = pose
        model.gravity.linear = down
        result.append(pinocchio.computeGeneralizedGravity(model, data, q)[at])
    return np.array(result)


def description(side="left", **robot):
    values = {"length": (0.05, 0.13, 0.3, 0.3), "cog": (0.04, 0.1, 0.2, 0.15), "mass": (0.6, 0.5, 0.6, 0.2), **robot}
    arm = ArmModel.from_moments(**robot) if "first_moment" in robot else ArmModel(**values)
    on_trunk = OnTrunk(side, arm, (0.6, 0.5, 0.6, 0.2))
    return Described(side, on_trunk.pose, on_trunk.bodies, Limits(NAMES))


CALIBRATED = {
    "off_axis": {"off_axis": (0.02, -0.03, 0.01, 0.004)},
    "by_moments": {
        "length": (0.05, 0.13, 0.3, 0.3),
        "first_moment": (0.2, 0.4, 0.3, 0.05),
        "off_axis": (0.02, 0.01, 0.0, -0.01),
    },
    "gain": {"gain": (0.9, 1.1, 1.2, 0.8), "gravity": 9.8},
}
DESCRIBED = {  # the text, and the arms in it: side, joints, robot
    **{
        name: (urdf_of(CONFIG / name), [(a.side, a.joint_names, a.robot) for a in configured_arms(CONFIG / name)])
        for name in ("exo.yaml", "sim_both.yaml")
    },
    **{
        f"{case}, {side}": (urdf([one]), [(side, NAMES, one.pose.__self__.robot)])
        for case, robot in CALIBRATED.items()
        for side in ("left", "right")
        for one in [description(side, **robot)]
    },
}


@pytest.mark.parametrize(("text", "arms"), DESCRIBED.values(), ids=DESCRIBED)
def test_the_description_gives_the_exact_laws_torques(text, arms):
    for side, joints, arm in arms:
        unscaled = ArmModel.from_moments(arm.length, arm.first_moment, arm.off_axis, gravity=arm.gravity)
        exact = gravity_torque(unscaled, THETA, [Tilt.of_gravity(side, vector).direction for vector in DOWN])
        assert by_pinocchio(text, joints, arm.gravity) == pytest.approx(exact, abs=1e-9)  # Nm


def test_joints_keep_the_order_of_the_file_names_that_both_arms_share_get_the_side_and_inertias_are_possible():
    def revolute(text):
        return [j.get("name") for j in ElementTree.fromstring(text).iter("joint") if j.get("type") == "revolute"]

    assert revolute(urdf_of(EXO)) == [name for arm in configured_arms(EXO) for name in arm.joint_names]
    assert revolute(urdf([description("left")])) == list(NAMES)
    shared = [f"{side}_{name}" for side in ("left", "right") for name in NAMES]
    assert revolute(urdf([description("left"), description("right")])) == shared
    for inertia in ElementTree.fromstring(urdf_of(EXO)).iter("inertia"):
        a, b, c = sorted(float(inertia.get(name)) for name in ("ixx", "iyy", "izz"))
        assert a > 0 and c <= a + b


def test_limits_friction_and_own_meshes_are_in_the_description():
    arm = replace(description(), damping=(0.0, 0.1, 0.0, 0.0), friction=(0.0, 0.3, 0.2, 0.0))
    root = ElementTree.fromstring(urdf([arm], "package://mine/meshes/"))
    first, second = list(root.iter("joint"))[:2]
    limit, dynamics = ({k: float(v) for k, v in second.find(tag).items()} for tag in ("limit", "dynamics"))
    assert limit == {"lower": -0.17, "upper": 3.14, "effort": 9.0, "velocity": 5.0}
    assert dynamics == {"damping": 0.1, "friction": 0.3} and first.find("dynamics") is None
    meshes = [mesh.get("filename") for link in root.iter("link") for mesh in link.iter("mesh")]
    names = ("trunk", "left_link_1", "left_link_2", "left_link_3", "left_link_4")
    assert meshes == [f"package://mine/meshes/{name}.stl" for name in names]


REFUSED = {  # what differs of each arm's robot, and what is said
    "two arms on one side": ([{}, {}], "one arm for each side"),
    "a link without mass": ([{"mass": (0.6, 0.5, 0.6, 0.0)}], "above 0 kg for each link"),
}


@pytest.mark.parametrize(("robots", "said"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_described_is_refused(robots, said):
    with pytest.raises(ParameterError, match=said):
        urdf([description(**robot) for robot in robots])


def test_the_command_writes_one_arm_or_both(tmp_path, run_tool):
    assert run_tool("urdf", "--params", EXO) == (0, urdf_of(EXO), "")
    assert run_tool("urdf", "--params", EXO, "--side", "right", "--output", tmp_path / "arm.urdf").code == 0
    text = (tmp_path / "arm.urdf").read_text()
    assert text == urdf_of(EXO, "right") and "left" not in text


# The picture


def view(theta=STILL, velocity=STILL, effort=STILL, state="active", message="", side="left"):
    return ArmView(description(side), theta, velocity, effort, state, message)


def lines(shapes, group):
    return [shape for shape in shapes if (shape.group, shape.kind) == (group, LINE)]


def test_the_range_of_each_joint_is_an_arc_on_which_the_link_points_at_its_angle():
    theta = (0.3, 0.8, 0.5, 1.0)
    origins, _, _ = description().pose(theta)
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
    origins, axes, _ = description().pose(STILL)
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


@pytest.mark.parametrize(
    ("file", "side", "given"),
    [("exo.yaml", "left", ()), ("exo.yaml", "right", ()), ("seven_joints.yaml", "right", ["arms/seven_joints.urdf"])],
)
def test_the_picture_has_its_joints_where_mujoco_has_those_of_its_description(file: str, side: str, given) -> None:
    """And where it has those of the given URDF."""
    arm = configured_arm(packaged_config(file), side)
    picture, random = described(arm.compensator, arm.can_bridge), np.random.default_rng(0)
    texts = urdf([picture]), *(packaged_config(name).read_text(encoding="utf-8") for name in given)
    models = list(map(mujoco.MjModel.from_xml_string, texts))
    assert picture.side == side and [models[0].joint(n).name for n in range(models[0].njnt)] == list(arm.joint_names)
    for theta in random.uniform(arm.low, arm.high, (20, len(arm.low))):
        origins, axes, along = picture.pose(theta.tolist())
        np.testing.assert_allclose(np.einsum("na,na->n", axes, along), 0.0, atol=1e-9)
        for model in models:
            data = mujoco.MjData(model)
            data.qpos[:] = theta
            mujoco.mj_kinematics(model, data)
            np.testing.assert_allclose(origins[:-1], data.xanchor, atol=1e-5)
            np.testing.assert_allclose(axes, data.xaxis, atol=1e-5)
    view = ArmView(picture, theta.tolist(), [0.0] * len(theta), [1.0] * len(theta), "active")
    assert len([shape for shape in arm_shapes(view) if shape.group == "torques"]) == 2 * len(theta)
