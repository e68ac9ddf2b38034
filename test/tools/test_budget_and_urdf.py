# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a file says of its arms: the torque budget of a wearer, and the robot description.

test/lab/test_budget.py shows how a budget is computed. Pinocchio reads the description's torques from its XML.
"""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pinocchio
import pytest
from matplotlib.figure import Figure

from exo_gravity.core import ArmModel, Tilt, gravity_torque
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.inputs.arms import configured_arms
from exo_gravity.lab.view import Described, PapersPicture, urdf
from exo_gravity.tools.urdf import urdf_of

from ..support import CONFIG

BRIDGE, COMPENSATOR = "/right/can_bridge", "/right/compensator"
EXO = CONFIG / "exo.yaml"

# budget


@pytest.fixture
def budget(run_tool, params_with, tmp_path):
    """A function that runs budget on a packaged file with `changes` {node: {parameter: value}}."""

    def run(*words, file="sim.yaml", changes=None):
        return run_tool("budget", "--params", params_with(file, changes), "--output", tmp_path / "out", *words)

    return run


@pytest.fixture
def plain(monkeypatch):
    """Figures take longest: draw blank ones in tests that do not look at them."""
    blank = Figure(figsize=(1, 1))
    monkeypatch.setattr("exo_gravity.tools.budget.joint_figure", lambda *_: blank)


def abduction(text):
    """Return the words of joint 2's row."""
    (row,) = (line.split() for line in text.splitlines() if "2 shoulder abduction" in line)
    return row


@pytest.mark.usefixtures("plain")
def test_full_zero_g_of_75_kg_is_reported_as_beyond_the_papers_motors_and_by_how_much(budget):
    ended = budget("--body-mass", 75)
    assert ended.code == 1 and "75 kg is beyond the motors of /right" in ended.text
    assert (abduction(ended.text)[3:7], abduction(ended.text)[-1]) == (["AK80-9", "9", "18", "19.63"], "AK80-64")
    assert "within rated torque everywhere is 0.068" in ended.text
    weak = budget("--body-mass", 75, changes={BRIDGE: {"torque_scale": [1.0, 0.75, 1.0, 1.0]}})
    assert abduction(weak.text)[3:6] == ["AK80-9", "6.75", "13.5"]  # a motor that gives three quarters of its torque
    heavy = budget("--body-mass", 75, changes={COMPENSATOR: {"robot": {"mass": [1.0, 1.0, 3.0, 1.0]}}})
    assert "The robot alone needs more than rated torque" in heavy.text
    both = budget("--body-mass", 60, file="sim_both.yaml")  # mirrored arms share one table
    assert both.code == 1 and "/right and /left at support 1" in both.text
    assert both.text.count("joint                 motor") == 1


@pytest.mark.usefixtures("plain")
def test_an_arm_that_nobody_wears_has_the_figures_of_the_arm_alone(budget):
    def needs(*words, **changes):
        ended = budget(*words, file="three_joints.yaml", changes=changes)
        return ended, [line.split()[5] for line in ended.text.splitlines() if "AK" in line]

    _, alone = needs("--body-mass", 70, "--support", 0)
    for words, links in (((), [2, 3]), (("--body-mass", 70), [0, 0])):
        ended, needed = needs(*words, **{COMPENSATOR: {"wearer": {"links": links}}})
        assert ended.code == 0 and "largest_moment: [" in ended.text and needed == alone and len(alone) == 3
        assert words or "The arm alone, which nobody wears, is within rated torque" in ended.text
    unfit, _ = needs("--body-mass", 70, **{COMPENSATOR: {"wearer": {"links": [3, 4]}}})
    assert unfit.code == 2 and "compensator wearer.links = [3, 4]: must be 2 different links from 1 to 3" in unfit.text


def test_a_load_in_the_hand_is_part_of_the_torques_and_of_the_moments_and_every_joint_gets_a_figure(
    budget, tmp_path, request
):
    words = ("--body-mass", 40, "--support", 0.5)
    loaded = budget(*words, "--payload", 1.5).text
    pictures = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in pictures] == [f"right_joint_{number}.png" for number in (1, 2, 3, 4)]
    assert all(matplotlib.image.imread(path).std() > 0.05 for path in pictures)
    request.getfixturevalue("plain")
    bare = budget(*words).text
    assert "of a wearer of 40 kg with 1.5 kg in the hand is beyond" in loaded
    moments = [re.search(r"largest_moment: \[(.*?)\]", text)[1].split(", ") for text in (bare, loaded)]
    added = [float(new) - float(old) for old, new in zip(*moments, strict=True)]
    assert added == pytest.approx([1.5 * length for length in (0.05, 0.13, 0.30, 0.30)], abs=0.0011)


# urdf

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
    return Described(side, PapersPicture(side, arm, (0.6, 0.5, 0.6, 0.2)), Limits(NAMES))


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
        f"{case}, {side}": (urdf([one]), [(side, NAMES, one.robot.robot)])
        for case, robot in CALIBRATED.items()
        for side in ("left", "right")
        for one in [description(side, **robot)]
    },
}


@pytest.mark.parametrize(("text", "arms"), DESCRIBED.values(), ids=DESCRIBED)
def test_the_description_gives_the_exact_laws_torques(text, arms):
    for side, joints, arm in arms:
        directions = [Tilt.of_gravity(side, vector).direction for vector in DOWN]
        unscaled = ArmModel.from_moments(arm.length, arm.first_moment, arm.off_axis, gravity=arm.gravity)
        exact = gravity_torque(unscaled, THETA, directions)
        assert by_pinocchio(text, joints, arm.gravity) == pytest.approx(exact, abs=1e-9)  # Nm


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
