# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The robot description: torques by Pinocchio and MuJoCo from its XML, the names, and the command."""

from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio
import pytest

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.arm.arm_data import STANDARD_GRAVITY
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import configured_arms
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.view.urdf import ArmDescription, urdf
from exo_gravity.tools.urdf import main, urdf_of

ROUNDING = 1e-9  # Nm
POSES = 1000
NAMES = ("rotation", "abduction", "flexion", "elbow")


def by_pinocchio(text, joints, theta, gravity):
    model = pinocchio.buildModelFromXML(text)
    data, result = model.createData(), []
    at = [model.joints[model.getJointId(name)].idx_q for name in joints]
    for pose, down in zip(theta, gravity, strict=True):
        q = pinocchio.neutral(model)
        q[at] = pose
        model.gravity.linear = down
        result.append(pinocchio.computeGeneralizedGravity(model, data, q)[at])
    return np.array(result)


def by_mujoco(text, joints, theta, gravity):
    model = mujoco.MjModel.from_xml_string(text)
    data, result = mujoco.MjData(model), []
    at = [model.joint(name).qposadr[0] for name in joints]
    for pose, down in zip(theta, gravity, strict=True):
        data.qpos[at] = pose
        model.opt.gravity[:] = down
        mujoco.mj_forward(model, data)
        result.append(data.qfrc_bias[at].copy())
    return np.array(result)


def poses_and_gravity(seed):
    """Random poses, and gravity's unit vector in the trunk's axes over the whole sphere."""
    rng = np.random.default_rng(seed)
    down = rng.normal(size=(POSES, 3))
    return rng.uniform(-np.pi, np.pi, (POSES, 4)), down / np.linalg.norm(down, axis=1, keepdims=True)


def exact(arm, side, theta, down):
    directions = [Tilt.of_gravity(side, vector).direction for vector in down]
    unscaled = ArmModel.from_moments(arm.length, arm.first_moment, arm.off_axis, gravity=arm.gravity)
    return gravity_torque(unscaled, theta, directions)


def description(side="left", joints=NAMES, **robot):
    values = {"length": (0.05, 0.13, 0.3, 0.3), "cog": (0.04, 0.1, 0.2, 0.15), "mass": (0.6, 0.5, 0.6, 0.2), **robot}
    arm = ArmModel.from_moments(**robot) if "first_moment" in robot else ArmModel(**values)
    return ArmDescription(side, arm, (0.6, 0.5, 0.6, 0.2), Limits(joints))


REFERENCES = pytest.mark.parametrize("reference", [by_pinocchio, by_mujoco])
CALIBRATED = {
    "off_axis": {"off_axis": (0.02, -0.03, 0.01, 0.004)},
    "by_moments": {
        "length": (0.05, 0.13, 0.3, 0.3),
        "first_moment": (0.2, 0.4, 0.3, 0.05),
        "off_axis": (0.02, 0.01, 0.0, -0.01),
    },
    "gain": {"gain": (0.9, 1.1, 1.2, 0.8), "gravity": 9.8},
}


@REFERENCES
@pytest.mark.parametrize("file", ["exo.yaml", "sim_both.yaml"])
def test_the_description_of_both_arms_gives_the_exact_laws_torques(reference, file):
    path = packaged_config(file)
    text, (theta, down) = urdf_of(path), poses_and_gravity(1)
    for arm in configured_arms(path):
        torque = reference(text, arm.joint_names, theta, STANDARD_GRAVITY * down)
        assert torque == pytest.approx(exact(arm.robot, arm.side, theta, down), abs=ROUNDING)


@REFERENCES
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("robot", CALIBRATED.values(), ids=CALIBRATED)
def test_a_calibrated_arms_description_gives_the_exact_laws_torques(reference, side, robot):
    arm, (theta, down) = description(side, **robot), poses_and_gravity(2)
    torque = reference(urdf([arm]), NAMES, theta, arm.robot.gravity * down)
    assert torque == pytest.approx(exact(arm.robot, side, theta, down), abs=ROUNDING)


def test_positive_angles_abduct_and_flex_on_both_sides():
    model = pinocchio.buildModelFromXML(urdf([description("left"), description("right")]))
    data = model.createData()
    for side, outward in (("left", 1.0), ("right", -1.0)):
        for joint, direction in (("abduction", (0.0, outward, 0.0)), ("flexion", (1.0, 0.0, 0.0))):
            q = pinocchio.neutral(model)
            q[model.joints[model.getJointId(f"{side}_{joint}")].idx_q] = np.pi / 2
            pinocchio.framesForwardKinematics(model, data, q)
            ends = [data.oMf[model.getFrameId(f"{side}_{name}")].translation for name in ("link_4", "end")]
            assert (ends[1] - ends[0]) / 0.3 == pytest.approx(direction, abs=1e-12)


def test_joints_keep_the_order_of_the_parameter_file_and_names_that_both_arms_share_get_the_side():
    def revolute(text):
        return [j.get("name") for j in ElementTree.fromstring(text).iter("joint") if j.get("type") == "revolute"]

    expected = [name for arm in configured_arms(packaged_config("exo.yaml")) for name in arm.joint_names]
    assert revolute(urdf_of(packaged_config("exo.yaml"))) == expected
    assert revolute(urdf([description("left")])) == list(NAMES)
    shared = [f"{side}_{name}" for side in ("left", "right") for name in NAMES]
    assert revolute(urdf([description("left"), description("right")])) == shared


def test_limits_and_friction_are_those_of_the_parameters():
    arm = ArmDescription("left", description().robot, (), Limits(NAMES), (0.0, 0.1, 0.0, 0.0), (0.0, 0.3, 0.2, 0.0))
    first, second = list(ElementTree.fromstring(urdf([arm])).iter("joint"))[:2]
    limit = {name: float(value) for name, value in second.find("limit").items()}
    assert limit == {"lower": -0.17, "upper": 3.14, "effort": 9.0, "velocity": 5.0}
    assert {k: float(v) for k, v in second.find("dynamics").items()} == {"damping": 0.1, "friction": 0.3}
    assert first.find("dynamics") is None


def test_every_inertia_is_positive_definite_and_possible():
    for inertia in ElementTree.fromstring(urdf_of(packaged_config("exo.yaml"))).iter("inertia"):
        a, b, c = sorted(float(inertia.get(name)) for name in ("ixx", "iyy", "izz"))
        assert a > 0 and c <= a + b


def test_own_meshes_replace_the_shapes_of_every_link():
    links = list(ElementTree.fromstring(urdf([description()], "package://mine/meshes/")).iter("link"))
    meshes = [mesh.get("filename") for link in links for mesh in link.iter("mesh")]
    names = ("trunk", "left_link_1", "left_link_2", "left_link_3", "left_link_4")
    assert meshes == [f"package://mine/meshes/{name}.stl" for name in names]


def test_two_arms_on_one_side_and_a_link_without_mass_are_refused():
    with pytest.raises(ParameterError, match="one arm for each side"):
        urdf([description(), description()])
    with pytest.raises(ParameterError, match="above 0 kg for each link"):
        urdf([description(mass=(0.6, 0.5, 0.6, 0.0))])


def test_the_command_writes_one_arm_or_both(tmp_path, capsys):
    params, file = str(packaged_config("exo.yaml")), tmp_path / "arm.urdf"
    assert main(["--params", params]) == 0
    assert capsys.readouterr().out == urdf_of(params)
    assert main(["--params", params, "--side", "right", "--output", str(file)]) == 0
    assert file.read_text() == urdf_of(params, "right")
    assert "left" not in file.read_text()
