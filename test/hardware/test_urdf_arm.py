# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Torques of arms from their URDF: against MuJoCo, and against the exact law on the exoskeleton's own description."""

from pathlib import Path

import numpy as np
import pytest

from exo_gravity.core import STANDARD_GRAVITY, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.hardware import urdf_tree
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.tools.urdf import urdf_of

from ..support.chains import random_chain
from ..support.urdf_oracle import MujocoArm

PUBLISHED = Path(__file__).parents[1] / "data" / "arms"
ARMS = {
    # The UR5 as a table arm; the Panda with two prismatic fingers, which stay at 0; the Kinova with continuous joints.
    "ur5": (PUBLISHED / "ur5.urdf",
            [f"{part}_joint" for part in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]),
    "panda": (PUBLISHED / "panda.urdf", [f"panda_joint{n}" for n in range(1, 8)]),
    "kinova": (PUBLISHED / "kinova.urdf", [f"j2s6s200_joint_{n}" for n in range(1, 7)]),
}  # fmt: skip
POSES = 200
# Joints on two branches: of the arm j1, j3 and j4; j2 slides as j1 turns, and j5 is where it is reported.
BRANCHES = "".join(
    f"<link name='l{n}'><inertial><origin xyz='0.05 0 -{n / 20}'/><mass value='{n}'/>"
    "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    f"<joint name='j{n}' type='{kind}'><parent link='{parent}'/><child link='l{n}'/><origin xyz='0 0.1 -0.3' "
    f"rpy='0.3 {n} 0'/><axis xyz='{axis}'/><limit lower='-2' upper='2' effort='30' velocity='1'/>{more}</joint>"
    for n, kind, parent, axis, more in (
        (1, "revolute", "base", "0 1 0.4", ""),
        (2, "prismatic", "l1", "1 0 0", "<mimic joint='j1' multiplier='0.2' offset='0.05'/>"),
        (3, "continuous", "l2", "0.2 1 0", ""),
        (4, "revolute", "l1", "0 1 0", ""),
        (5, "prismatic", "l4", "0 0 1", ""),
    )
)
BRANCHED = f"<robot name='branches'><link name='base'/>{BRANCHES}</robot>"
ONE_LINK = """<robot name="one">
<link name="base"/>
<link name="link"><inertial><origin xyz="0 0 -0.5"/><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="{kind}"><parent link="base"/><child link="link"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="5" velocity="1"/></joint>
</robot>"""


def torque_of(arm: UrdfArm, theta, gravity) -> tuple[float, ...]:
    """Return the torque (n,) in Nm where the root link feels `gravity`, (3,) m/s^2 in its axes."""
    return arm.torque(theta, Tilt.of_felt("left", gravity, STANDARD_GRAVITY))


def random_gravity(random: np.random.Generator) -> np.ndarray:
    gravity = random.normal(size=3)
    return 9.80665 * gravity / np.linalg.norm(gravity)


@pytest.mark.parametrize("name", ARMS)
def test_the_torques_of_published_arms_equal_mujocos_in_any_pose_under_any_tilt(name):
    path, joints = ARMS[name]
    text, random = path.read_text(encoding="utf-8"), np.random.default_rng(1)
    arm, mujoco = UrdfArm(text, joints), MujocoArm(text, joints)
    largest = 0.0
    for _ in range(POSES):
        theta, gravity = random.uniform(-np.pi, np.pi, len(joints)), random_gravity(random)
        torque = torque_of(arm, theta, gravity)
        assert np.allclose(torque, mujoco.torque(theta, gravity), rtol=0.0, atol=1e-11)
        largest = max(largest, *np.abs(torque))
    assert largest > 10.0


def test_the_joints_may_come_in_any_order():
    path, joints = ARMS["kinova"]
    text, random = path.read_text(encoding="utf-8"), np.random.default_rng(2)
    order = random.permutation(len(joints))
    theta, gravity = random.uniform(-3.0, 3.0, len(joints)), random_gravity(random)
    mixed, ordered = UrdfArm(text, [joints[n] for n in order]), UrdfArm(text, joints)
    assert np.allclose(torque_of(mixed, theta[order], gravity), np.array(torque_of(ordered, theta, gravity))[order])
    assert mixed.max_effort == tuple(ordered.max_effort[n] for n in order)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_exoskeletons_own_description_gives_the_torques_of_the_exact_law(side):
    params = packaged_config("sim_both.yaml")
    own, random = configured_arm(params, side), np.random.default_rng(3)
    for text in (urdf_of(params, side), urdf_of(params)):  # one arm, and both on one trunk
        arm = UrdfArm(text, own.joint_names)
        for _ in range(POSES):
            theta, gravity = random.uniform(-3.0, 3.0, 4), random_gravity(random)
            exact = gravity_torque(own.robot, theta, Tilt.of_gravity(side, gravity).direction)
            assert np.allclose(torque_of(arm, theta, gravity), exact, rtol=0.0, atol=1e-9)
        assert arm.total_mass == pytest.approx(own.robot.total_mass)


@pytest.mark.parametrize(("text", "joint", "problem"), [
    ("", "j", r"well-formed XML \(no element found"),
    ("<robot", "j", r"well-formed XML \(unclosed token"),
    (2 * ONE_LINK.format(mass=1, kind="revolute"), "j", r"well-formed XML \(junk after document element"),
    ("<sdf/>", "j", "<sdf>': must be a URDF, whose outermost element is `robot`"),
    (ONE_LINK.replace("<robot ", "<robot xmlns='http://ros.org' "), "j", "without a namespace"),
    ("<robot xmlns:xacro='http://wiki.ros.org/xacro'><xacro:include/></robot>", "j", "run xacro first"),
    (ONE_LINK.replace('lower="-1" upper="1"', 'lower="2" upper="-1"').format(mass=1, kind="revolute"), "j",
     r"limits of j = \[2.0, -1.0\]: must be the lower one, then the upper one"),
    (ONE_LINK.replace('xyz="0 1 0"', 'xyz="0 0 0"').format(mass=1, kind="revolute"), "j", "axis of j = '0 0 0'"),
    (ONE_LINK.format(mass=1, kind="prismatic"), "j", "it has none"),
    (ONE_LINK.format(mass=1, kind="revolute"), "k", r"turning joints of the URDF \(j\)"),
    (ONE_LINK.format(mass=0, kind="revolute"), "j", "above 0 kg"),
    (ONE_LINK.replace('child link="link"', 'child link="x"').format(mass=1, kind="revolute"), "j", "Pinocchio reads"),
])  # fmt: skip
def test_a_description_that_cannot_be_used_is_refused_with_the_reason(text, joint, problem):
    with pytest.raises(ParameterError, match=problem):
        UrdfArm(text, [joint])


def test_the_papers_arm_as_a_urdf_carries_a_wearer_and_a_load_like_the_closed_form():
    """The description has the trunk's axes in every link while the arm hangs: x_4 down, y_4 forward, z_4 inward."""
    params, random = packaged_config("sim_both.yaml"), np.random.default_rng(4)
    for side, inward in (("right", 1.0), ("left", -1.0)):
        own = configured_arm(params, side)
        arm = UrdfArm(urdf_of(params, side), own.joint_names, f"{side}_end")
        assert arm.length == pytest.approx(own.robot.length.tolist())
        mass, cog, load = (0.0, 0.2, 2.0, 1.5), (0.0, 0.05, 0.16, 0.18), (0.03, 0.02, -0.01)
        x, y, z = load
        held = arm.with_wearer(mass, cog, 0.7).with_payload(1.2, (y, inward * z, -x))
        exact = own.robot.with_wearer(mass, cog, 0.7).with_payload(1.2, load)
        assert held.total_mass == pytest.approx(exact.total_mass)
        for _ in range(POSES):
            theta, gravity = random.uniform(-3.0, 3.0, 4), random_gravity(random)
            expected = gravity_torque(exact, theta, Tilt.of_gravity(side, gravity).direction)
            assert np.allclose(torque_of(held, theta, gravity), expected, rtol=0.0, atol=1e-9)
        assert held.with_payload(0.0).with_wearer((0.0,) * 4, (0.0,) * 4) == arm.with_payload(0.0).with_wearer(
            (0.0,) * 4, (0.0,) * 4
        )


def worn(count: int, random: np.random.Generator) -> UrdfArm:
    """Return an arm of `count` joints whose places lie askew, with gains, a wearer and a load."""
    text, names = random_chain(count, seed=count)
    arm = UrdfArm(text, names, "hand").turned(random.normal(0.0, 0.05, (count, 3)))
    worn = arm.with_wearer_moments(random.normal(0.0, 0.2, (count, 3))).with_payload(1.2, (0.02, -0.03, 0.05))
    return worn.scaled(random.uniform(0.5, 1.0, count), 9.7)


def branched() -> UrdfArm:
    arm = UrdfArm(BRANCHED, ["j1", "j3", "j4"])
    arm.follow(["j5"], [0.35])
    assert not arm.fixed
    return arm


@pytest.mark.parametrize("count", [1, 3, 7, 0], ids=lambda count: f"{count} joints" if count else "branches")
def test_many_poses_at_once_have_the_torques_that_pinocchio_computes_for_each(count, monkeypatch):
    monkeypatch.setattr(urdf_tree, "BLOCK", 150)
    random = np.random.default_rng(5)
    arm = worn(count, random) if count else branched()
    theta = random.uniform(-3.0, 3.0, (POSES, len(arm.names)))
    tilts = [Tilt.of_gravity("left", random_gravity(random)) for _ in theta]
    each = [arm.torque(pose, tilt) for pose, tilt in zip(theta, tilts, strict=True)]
    assert np.allclose(arm.torques(theta, [tilt.direction for tilt in tilts]), each, rtol=0.0, atol=1e-12)
    assert np.max(np.abs(each)) > 1.0

    down = np.array([tilt.gravity_in_trunk for tilt in tilts])
    rows = arm.regressor(theta, down) * arm.gain[:, None]
    for k, more in enumerate(np.eye(rows.shape[-1])):
        changed = arm.with_more_moments(0.1 * more)
        with_more = [changed.torque(pose, tilt) for pose, tilt in zip(theta, tilts, strict=True)]
        assert np.allclose(np.subtract(with_more, each), 0.1 * rows[:, :, k], rtol=0.0, atol=1e-12)


def test_one_pose_is_where_pinocchio_has_it_and_as_it_is_among_many():
    random = np.random.default_rng(6)
    arm, pin = branched(), pytest.importorskip("pinocchio")
    model = pin.buildModelFromXML(BRANCHED)
    data = model.createData()
    theta = random.uniform(-3.0, 3.0, (POSES, 3))
    down = np.array([random_gravity(random) for _ in theta]) / STANDARD_GRAVITY
    moments = random.normal(size=(3, len(arm.base)))
    by_moments = arm.by_moments(moments)
    rows, places, (before, after) = arm.regressor(theta, down), arm.places(theta), arm.frames(theta)
    for n, (j1, j3, j4) in enumerate(theta):
        one = theta[n : n + 1]
        assert np.allclose(arm.regressor(one, down[n])[0], rows[n], rtol=0.0, atol=1e-12)
        own = by_moments(one[0].tolist(), Tilt.of_gravity("left", down[n]))
        assert np.allclose(own, np.einsum("jk,jk->j", rows[n], moments), rtol=0.0, atol=1e-12)
        position = dict(zip(("j1", "j2", "j3", "j4", "j5"), (j1, 0.2 * j1 + 0.05, j3, j4, 0.35), strict=True))
        at = pin.integrate(model, pin.neutral(model), np.array([position[name] for name in list(model.names)[1:]]))
        pin.forwardKinematics(model, data, at)
        frames = [data.oMi[model.getJointId(name)] for name in arm.names]
        assert np.allclose(places[n, :3], [frame.translation for frame in frames], rtol=0.0, atol=1e-12)
        assert np.allclose(after[n], [frame.rotation for frame in frames], rtol=0.0, atol=1e-12)
        for own, name in zip(before[n], arm.names, strict=True):
            joint = model.getJointId(name)
            place = data.oMi[model.parents[joint]].rotation @ model.jointPlacements[joint].rotation
            assert np.allclose(own, place, rtol=0.0, atol=1e-12)
        assert np.allclose(arm.pose(one[0].tolist())[0], places[n], rtol=0.0, atol=1e-12)


def test_a_missing_joint_leaves_the_others_where_they_were():
    arm = branched()
    before = arm.places(np.zeros((1, 3)))
    with pytest.raises(ParameterError, match="j5"):
        arm.follow(["j1"], [1.0])
    assert np.array_equal(arm.places(np.zeros((1, 3))), before)


def test_one_link_takes_its_weight_times_its_lever():
    arm = UrdfArm(ONE_LINK.format(mass=2, kind="continuous"), ["j"])
    assert torque_of(arm, [np.pi / 2], (0.0, 0.0, -10.0)) == pytest.approx([10.0])
    assert arm.max_effort == (5.0,)
