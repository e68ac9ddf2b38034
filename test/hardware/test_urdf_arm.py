# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms from their URDF: against MuJoCo, Pinocchio and the exact law on the exoskeleton's own description.

In descriptions that are incomplete but not empty, what changes the torque is used or refused, and the rest is named.
What gravity needs of an arm of any number of joints is explained, bare or worn; and so is its inertia.
"""

import ctypes
import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import rtbdata

from exo_gravity.core import STANDARD_GRAVITY, gravity_torque
from exo_gravity.core.arm.interface import NO_LOAD, Payload
from exo_gravity.core.arm.tilt import AXES, SIDES, Tilt
from exo_gravity.core.compensation.settings import Settings, compensator_table, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.core.safety.command import Command, Send
from exo_gravity.core.safety.explain import GRAVITY, MotionMonitor
from exo_gravity.core.safety.limits import DAMPING, Limits
from exo_gravity.hardware.bus_lock import ArmNotes, CommandNotes
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.sim.urdf import UrdfConfig
from exo_gravity.tools.urdf import urdf_of

from ..support import CONFIG
from ..support.chains import random_chain
from ..support.thorough import quick
from ..support.urdf_oracle import MujocoArm

PUBLISHED = Path(__file__).parents[1] / "data" / "arms"
ARMS = {
    # The UR5 as a table arm; the Panda with two prismatic fingers, which stay at 0; the Kinova with continuous joints.
    "ur5": (PUBLISHED / "ur5.urdf",
            [f"{part}_joint" for part in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]),
    "panda": (PUBLISHED / "panda.urdf", [f"panda_joint{n}" for n in range(1, 8)]),
    "kinova": (PUBLISHED / "kinova.urdf", [f"j2s6s200_joint_{n}" for n in range(1, 7)]),
    "elbow": (CONFIG / "arms" / "elbow.urdf", ["elbow"]),
    "three_joints": (CONFIG / "arms" / "three_joints.urdf", ["abduction", "flexion", "elbow"]),
    "seven_joints": (CONFIG / "arms" / "seven_joints.urdf", ["flexion", "abduction", "rotation", "elbow", "pronation",
                                                            "wrist_deviation", "wrist_flexion"]),
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


CHAINS = {
    f"{count} joints, {seed}": (count, 100 * count + seed) for count in (1, 2, 3, 5, 6, 7, 9) for seed in range(20)
}


def description(name: str) -> tuple[str, list[str]]:
    """Return the URDF of an arm of `ARMS` or `CHAINS`, and its joints."""
    return (ARMS[name][0].read_text(encoding="utf-8"), ARMS[name][1]) if name in ARMS else random_chain(*CHAINS[name])


@pytest.mark.parametrize("name", quick([*ARMS, *list(CHAINS)[::10]], [*ARMS, *CHAINS]))
def test_the_torques_are_mujocos_times_the_gain_in_any_pose_under_any_tilt(name):
    (text, joints), random = description(name), np.random.default_rng(1)
    joints = random.permutation(joints).tolist()
    gain = random.uniform(0.5, 1.5, len(joints))
    own, mujoco, largest = UrdfArm(text, joints).scaled(gain, STANDARD_GRAVITY), MujocoArm(text, joints), 0.0
    for _ in range(POSES // 4):
        theta, gravity = random.uniform(-np.pi, np.pi, len(joints)), random_gravity(random)
        torque = torque_of(own, theta, gravity)
        assert np.allclose(torque, gain * mujoco.torque(theta, gravity), rtol=0.0, atol=1e-10)
        largest = max(largest, *np.abs(torque))
    assert largest > (10.0 if name in ("ur5", "panda", "kinova") else 0.5 if name in ARMS else 0.0)


@pytest.mark.parametrize(("side", "inward"), [("right", 1.0), ("left", -1.0)])
def test_the_exoskeletons_own_description_gives_the_torques_of_the_exact_law_bare_worn_and_loaded(side, inward):
    """The description has the trunk's axes in every link while the arm hangs: x_4 down, y_4 forward, z_4 inward."""
    params, random = packaged_config("sim_both.yaml"), np.random.default_rng(3)
    own = configured_arm(params, side)
    arm, both = (
        UrdfArm(urdf_of(params, side), own.joint_names, f"{side}_end"),
        UrdfArm(urdf_of(params), own.joint_names),
    )
    mass, cog, load = (0.0, 0.2, 2.0, 1.5), (0.0, 0.05, 0.16, 0.18), (0.03, 0.02, -0.01)
    x, y, z = load
    held = arm.with_wearer(mass, cog, 0.7).with_payload(1.2, (y, inward * z, -x))
    law = own.robot.with_wearer(mass, cog, 0.7).with_payload(1.2, load)
    for described, exact in ((arm, own.robot), (both, own.robot), (held, law)):
        for _ in range(POSES):
            theta, gravity = random.uniform(-3.0, 3.0, 4), random_gravity(random)
            expected = gravity_torque(exact, theta, Tilt.of_gravity(side, gravity).direction)
            assert np.allclose(torque_of(described, theta, gravity), expected, rtol=0.0, atol=1e-9)
        assert np.allclose(*(np.abs([each.torque(theta, axis) for axis in AXES]) for each in (described, exact)))
        assert described.total_mass == pytest.approx(exact.total_mass)
    sides = [name.replace(side, other) for other in ("left", "right") for name in own.joint_names]
    assert UrdfArm(urdf_of(params), sides).total_mass == pytest.approx(2.0 * own.robot.total_mass)  # two chains
    assert arm.length == pytest.approx(own.robot.length.tolist())
    none = (0.0,) * 4
    assert held.with_payload(0.0).with_wearer(none, none) == arm.with_payload(0.0).with_wearer(none, none)


@pytest.mark.parametrize("name", ARMS)
def test_what_turns_with_the_trunk_is_mujocos_in_the_simulator_whatever_the_root_link_weighs(name):
    (text, joints), random = description(name), np.random.default_rng(4)
    count = len(joints)
    _, on_ball = UrdfConfig(text=text, joint_names=joints, rotor_inertia=(0.0,) * count).models()
    on_ball.opt.gravity = np.zeros(3)
    theta, spin_up, bias = random.uniform(-1.5, 1.5, count), random.normal(size=3), np.empty(3 + count)
    turning = mujoco.MjData(on_ball)
    turning.qpos[0], turning.qpos[4:], turning.qacc[:3] = 1.0, theta, spin_up
    for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
        compute(on_ball, turning)
    mujoco.mj_rne(on_ball, turning, 1, bias)
    assert np.allclose(UrdfArm(text, joints).turning_torque("left", theta, spin_up), bias[3:], rtol=0.0, atol=1e-11)


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
    with pytest.raises(ParameterError, match="j5"):
        arm.follow(["j1"], [1.0])  # which leaves the others where they were
    return arm


def test_one_pose_is_where_pinocchio_has_it_and_as_it_is_among_many():
    arm = branched()
    model = pin.buildModelFromXML(BRANCHED)
    data = model.createData()
    theta = np.random.default_rng(6).uniform(-3.0, 3.0, (POSES, 3))
    before, after, places = arm.frames(theta)
    for n, (j1, j3, j4) in enumerate(theta):
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


PANDA, WHOLE = ARMS["panda"][0].read_text(encoding="utf-8"), ARMS["panda"][1]
KR16 = Path(rtbdata.__path__[0], "xacro/kuka_description/kuka_kr16/urdf/kr16_2.urdf").read_text(encoding="utf-8")
FELT = (
    STANDARD_GRAVITY * np.array((0.12, -0.35, -0.929)) / np.linalg.norm((0.12, -0.35, -0.929))
)  # m/s^2, in the root link
TILT = Tilt.of_gravity("left", FELT / STANDARD_GRAVITY)
BALL = 0.01 * np.array((1.0, 1.0, 1.0, 0.0, 0.0, 0.0))  # kg m^2: ixx, iyy, izz, ixy, ixz, iyz
SHAPE = "<visual><geometry><box size='0.1 0.1 0.1'/></geometry></visual>"
DEPENDS = "<mimic joint='j1' multiplier='-0.7' offset='0.2'/>"


def link(name: str, mass: float = 1.0, cog: float = -0.2, extra: str = "") -> str:
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    inertia = " ".join(f"{key}='{value}'" for key, value in zip(names, BALL, strict=True))
    inertial = f"<inertial><origin xyz='0.05 0 {cog}'/><mass value='{mass}'/><inertia {inertia}/></inertial>"
    if not cog:
        inertial = inertial.replace("0.05 0 0", "0 0 0")
    return f"<link name='{name}'>{inertial if mass else ''}{extra}</link>"


def joint(n: int, kind: str = "revolute", effort: float = 30.0, extra: str = "") -> str:
    return (
        f"<joint name='j{n}' type='{kind}'><parent link='l{n - 1}'/><child link='l{n}'/><origin xyz='0 0 -0.3'/>"
        f"<axis xyz='0 1 {0.2 * n}'/><limit lower='-2' upper='2' effort='{effort}' velocity='1'/>{extra}</joint>"
    )


def chain(*parts: str) -> str:
    return f"<robot name='chain'><link name='l0'/>{''.join(parts)}</robot>"


THREE = (link("l1"), link("l2"), link("l3"), joint(1), joint(2), joint(3))


def test_positions_of_other_joints_that_are_reported_give_the_torque_of_the_whole_arm() -> None:
    arm, whole, random = UrdfArm(PANDA, WHOLE[:3]), MujocoArm(PANDA, WHOLE), np.random.default_rng(1)
    low, high = np.array((-2.8, -1.7, -2.8, -3.0, -2.8, 0.0, -2.8)), np.array((2.8, 1.7, 2.8, -0.1, 2.8, 3.7, 2.8))
    for _ in range(50):
        theta = random.uniform(low, high)
        arm.follow([*WHOLE[::-1], "gripper"], [*theta[::-1], np.nan])
        expected = whole.torque(theta, FELT)[:3]
        # Of the other joints only the last does not change the torque by more than 3 %: it is left at 0.
        assert np.allclose(arm.torque(theta[:3], TILT), expected, rtol=0.0, atol=0.03 * 50.0)
        whole_but_last = whole.torque((*theta[:6], 0.0), FELT)[:3]
        assert np.allclose(arm.torque(theta[:3], TILT), whole_but_last, rtol=0.0, atol=1e-9)
    assert arm.fixed == ()


def test_a_joint_that_cannot_be_at_0_must_be_reported_and_one_that_was_must_stay() -> None:
    arm = UrdfArm(PANDA, WHOLE[:3])
    assert arm.fixed == ("panda_joint4", "panda_joint5", "panda_joint6") and "panda_joint5" in arm.notes[-1]
    with pytest.raises(ParameterError, match=r"position of panda_joint4 .*limits -3\.0718 to -0\.0698"):
        arm.torque((0.0, 0.6, 0.0), TILT)
    with pytest.raises(ParameterError, match="position of panda_joint4"):
        arm.follow(WHOLE[:3], (0.0,) * 3)
    arm.follow(WHOLE[3:5], (-1.0, 0.3))
    assert arm.fixed == ("panda_joint6",)
    with pytest.raises(ParameterError, match="position of panda_joint5 = None: must be in the joint states"):
        arm.follow(WHOLE[3:4], (-1.0,))
    with pytest.raises(ParameterError, match="position of panda_joint5 = nan: must be finite"):
        arm.follow(WHOLE[3:5], (-1.0, np.nan))


def test_a_mimic_joint_carries_its_share_to_the_joint_that_it_follows() -> None:
    text = chain(*THREE[:4], joint(2, extra=DEPENDS), joint(3))
    arm, mujoco, random = UrdfArm(text, ["j1", "j3"]), MujocoArm(text, ["j1", "j2", "j3"]), np.random.default_rng(2)

    def energy(first: float, last: float) -> float:
        return mujoco.energy((first, -0.7 * first + 0.2, last), FELT)

    for first, last in random.uniform(-1.5, 1.5, (20, 2)):
        small = 1e-5
        expected = (
            (energy(first + small, last) - energy(first - small, last)) / (2.0 * small),
            (energy(first, last + small) - energy(first, last - small)) / (2.0 * small),
        )
        assert arm.torque((first, last), TILT) == pytest.approx(expected, abs=1e-8)


ONE, J, N3 = ONE_LINK.format(mass=1, kind="revolute"), ["j"], ["j1", "j2", "j3"]
EMPTY = link("l2", mass=0.0, extra=SHAPE)
CIRCLE = joint(2, extra=DEPENDS.replace("j1", "j3")), joint(3, extra=DEPENDS.replace("j1", "j2"))
TWICE = "<joint name='k' type='fixed'><parent link='base'/><child link='link'/></joint></robot>"


def one(written: str, instead: str) -> str:
    """Return the text of an arm of one joint with something else in it."""
    assert written in ONE
    return ONE.replace(written, instead)


# What is refused: the text, the arm's joints, and the reason. The text alone, which the simulator reads, too:
TEXTS = [
    ("", J, r"well-formed XML \(no element found"),
    ("<robot", J, r"well-formed XML \(unclosed token"),
    (2 * ONE, J, r"well-formed XML \(junk after document element"),
    ("<sdf/>", J, "<sdf>': must be a URDF, whose outermost element is `robot`"),
    (one("<robot ", "<robot xmlns='http://ros.org' "), J, "without a namespace"),
    ("<robot xmlns:xacro='http://wiki.ros.org/xacro'><xacro:include/></robot>", J, "run xacro first"),
    (one('value="1"', 'value="nan"'), J, "mass value of the link link = 'nan': must be a finite number"),
    (one('value="1"', 'value="1,2"'), J, "mass value of the link link = '1,2': must be a finite number"),
    (one('value="1"', 'value="10 kg"'), J, "mass value of the link link = '10 kg': must be a finite number"),
    (one('value="1"', 'value=""'), J, "mass value of the link link = '': must be a finite number"),
    (one('"0 0 -0.5"', '"0 0 -0,5"'), J, "origin xyz of the link link = '0 0 -0,5': must be 3 finite numbers"),
    (one('"0 0 -0.5"', '"0 -0.5"'), J, "origin xyz of the link link = '0 -0.5': must be 3 finite numbers"),
    (one('ixx="1"', 'ixx="1e-2 kg"'), J, "inertia ixx of the link link = '1e-2 kg': must be a finite number"),
    (one('"0 1 0"', '"0, 1, 0"'), J, "axis xyz of the joint j = '0, 1, 0': must be 3 finite numbers"),
    (one('lower="-1"', 'lower="-90°"'), J, "limit lower of the joint j = '-90°': must be a finite number"),
    (one('effort="5"', 'effort="5 Nm"'), J, "limit effort of the joint j = '5 Nm': must be a finite number"),
    (one('value="1"', 'value="-1"'), J, "mass of the link link = -1.0: must be 0 kg or more"),
    (one("<axis", "<mimic joint='j'/><axis"), J, "mimic of j = 'j': must be a joint that does not follow it in turn"),
    (chain(*THREE[:4], *CIRCLE), ["j1"], "mimic of j2 = 'j3': must be a joint that does not follow it in turn"),
    (one("</robot>", TWICE), J, "joints that move link = 2: must be 1"),
]  # fmt: skip
# And what the law cannot use.
REFUSED = [
    (one('lower="-1" upper="1"', 'lower="2" upper="-1"'), J, r"limits of j = \[2.0, -1.0\]: must be the lower"),
    (one('xyz="0 1 0"', 'xyz="0 0 0"'), J, "axis of j = '0 0 0': must be a direction"),
    (one('<axis xyz="0 1 0"/>', "<axis/>"), J, "axis of j = None: must be a direction"),
    (one("revolute", "prismatic"), J, "it has none"),
    (one('parent link="base"', 'parent link="link"'), J, r"links = \['link'\]: must be carried by the root link"),
    (ONE, ["k"], r"turning joints of the URDF \(j\)"),
    (one('value="1"', 'value="0"'), J, "0.05 to 40 kg in all"),
    (one('value="1"', 'value=" 1.2 "'), J, "mass of link = 1.2: .* it reads 0 kg"),  # as urdfdom drops the inertial
    (one('value="1"', 'value="1e3"'), J, "0.05 to 40 kg in all"),  # g
    (one('value="1"', 'value="1e-3"'), J, "0.05 to 40 kg in all"),  # t
    (one('child link="link"', 'child link="x"'), J, "Pinocchio reads"),
    (chain(*THREE[:4], joint(2, extra=DEPENDS), joint(3)), N3,
     "joint_names = 'j2': must be j1, which that joint follows"),
    (chain(link("l1"), EMPTY, *THREE[2:]), N3, "link = 'l2': must be with a mass"),
    (chain(*THREE).replace("-0.3", "-3"), N3, "reach of the URDF's links = .* at most 2 m"),
    (KR16, [f"joint_a{n}" for n in range(1, 7)], r"mass of link_1, .* link_6 .* make 100% of the torque"),
]  # fmt: skip
NOTED = [
    (chain(link("l1"), EMPTY, link("l3"), joint(1), joint(2, "fixed"), joint(3)), ["j1", "j3"],
     "these moving links have a shape and no mass: l2"),
    (chain(link("l1"), link("l2", mass=0.0), *THREE[2:]), N3, ""),
    (chain(link("l1"), link("l2", 0.005, 0.0), link("l3", 0.005, 0.0), *THREE[3:]), N3,
     r"the masses of these links look like placeholders, 2\.1% of the torque: l2, l3"),
    (chain(*THREE), N3, ""),  # modules of one kind, with their centres of gravity
    (chain(*THREE), ["j1", "j2"], "j3 change the torque and are not in joint_names: at 0, unless the joint states"),
    (chain(*THREE[:4], joint(2, effort=2000.0), joint(3)), N3, "the effort limit of j2, 2000 Nm, is not used"),
    (chain(*THREE[:4], joint(2, effort=0.5), joint(3)), N3, "the effort limit of j2, 0.5 Nm, is not used"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("read", "text", "names", "problem"),
    [
        *((UrdfArm, *row) for row in TEXTS + REFUSED),
        *((lambda text, names: UrdfConfig(text=text, joint_names=names), *row) for row in TEXTS),
    ],
)
def test_a_description_that_cannot_be_used_is_refused_with_the_reason(read, text, names, problem):
    with pytest.raises(ParameterError, match=problem):
        read(text, names)


@pytest.mark.parametrize(("text", "names", "note"), NOTED)
def test_what_is_doubtful_and_hardly_changes_a_torque_is_noted(text, names, note):
    notes = UrdfArm(text, names).notes
    assert len(notes) == bool(note) and re.match(note, "".join(notes))


def test_an_effort_limit_that_no_joint_of_such_an_arm_has_is_not_used():
    arm = UrdfArm(chain(*THREE[:4], joint(2, effort=2000.0), joint(3)), N3)
    assert arm.max_effort == (30.0, 0.0, 30.0)
    given = {"law": "urdf", "joint_names": N3, "max_effort": [0.0, 20.0, 0.0], "use_imu": False}
    assert settings_of(values_of(compensator_table(given), given), arm).max_effort == (30.0, 20.0, 30.0)
    with pytest.raises(ParameterError, match=r"max_effort of j2 = 0\.0: must be greater than 0"):
        settings_of(values_of(compensator_table(given), given | {"max_effort": [0.0] * 3}), arm)


# Arms of any number of joints, and what they hold.


def settings_for(text: str, names: Sequence[str], **given: object) -> Settings:
    given = {"law": "urdf", "joint_names": list(names), "use_imu": False, **given}
    return settings_of(values_of(compensator_table(given), given), UrdfArm(text, names, "hand"))


def test_notes_of_an_arm_with_another_number_of_joints_are_no_torque_for_this_one() -> None:
    notes = CommandNotes.from_buffer(bytearray(ctypes.sizeof(CommandNotes)))
    assert not ArmNotes([notes] * 2).command.powered
    notes.note(Command((1.0, 2.0, 3.0), (0.5,) * 3, (Send.COMMAND,) * 3, True))
    assert ArmNotes([notes] * 3).command == notes.command
    assert ArmNotes([notes] * 2).command == Command((0.0,) * 2, (DAMPING,) * 2, (Send.COMMAND,) * 2, True)


@pytest.mark.parametrize("held", [{}, {"payload.mass": 1.5, "payload.cog": [0.02, -0.03, 0.05]}])
@pytest.mark.parametrize("pitch", [0.0, 0.6])
def test_a_wearer_and_a_load_are_carried_on_any_links_under_any_tilt(held: dict[str, object], pitch: float) -> None:
    count = 5
    text, names = random_chain(count, seed=11)
    arm = UrdfArm(text, names, "hand")
    mass, cog = [0.0, 1.1, 0.0, 0.7, 0.3], [0.0, 0.5 * arm.length[1], 0.0, 0.9 * arm.length[3], 0.2 * arm.length[4]]
    stiffness, rest = [0.0, 1.2, 0.4, 2.0, 0.0], [0.0, 0.3, -0.2, 0.5, 0.0]
    worn = {"wearer.mass": mass, "wearer.cog": cog, "mode": "zero_g", "support": 0.6}
    worn |= {"wearer.joint_stiffness": stiffness, "wearer.joint_rest": rest}
    settings = settings_for(text, names, max_effort=[1000.0] * count, **worn, **held)
    config = UrdfConfig(
        text=text,
        joint_names=names,
        hand="hand",
        wearer_mass=[0.6 * m for m in mass],
        wearer_cog=cog,
        gravity=9.80665,
        wearer_stiffness=[0.6 * k for k in stiffness],
        wearer_rest=rest,
    )
    load = Payload(held["payload.mass"], held["payload.cog"]) if held else NO_LOAD
    model, _ = config.models(load)
    random, tilt = np.random.default_rng(5), Tilt.of("left", pitch, -0.5 * pitch)
    model.opt.gravity = 9.80665 * np.array(tilt.gravity_in_trunk)
    data = mujoco.MjData(model)
    for _ in range(20):
        data.qpos[:] = random.uniform(-0.6, 0.9, count)  # within reach of the wearer's joints
        mujoco.mj_forward(model, data)
        torque, reason = settings.torque(data.qpos.tolist(), tilt)
        assert reason == "" and np.abs(torque - data.qfrc_bias + data.qfrc_passive).max() < 1e-9
    bare = settings.robot
    assert settings.mass == pytest.approx(bare.total_mass + 0.6 * sum(mass) + load[0])


def test_inertia_and_momentum_agree_with_mujocos_and_their_balance_holds() -> None:
    count = 6
    text, names = random_chain(count, seed=3)
    arm = UrdfArm(text, names, "hand").with_payload(0.8, (0.05, 0.0, 0.02))
    config = UrdfConfig(text=text, joint_names=names, hand="hand", rotor_inertia=(0.0,) * count)
    model, _ = config.models(Payload(0.8, (0.05, 0.0, 0.02)))
    model.opt.gravity = np.zeros(3)
    model.dof_damping[:] = model.dof_frictionloss[:] = 0.0
    data, random = mujoco.MjData(model), np.random.default_rng(4)
    whole = np.zeros((count, count))
    for _ in range(20):
        theta, velocity, acceleration = (random.uniform(-1.5, 1.5, count) for _ in range(3))
        data.qpos[:], data.qvel[:] = theta, velocity
        mujoco.mj_forward(model, data)
        for row, one in zip(whole, np.eye(count), strict=True):
            mujoco.mj_mulM(model, data, row, one)
        np.testing.assert_allclose(
            arm.links.matrix(theta), whole, rtol=0.0, atol=1e-6
        )  # a point of mass has some inertia
        expected = whole @ acceleration + data.qfrc_bias
        np.testing.assert_allclose(arm.links.torque(theta, velocity, acceleration), expected, rtol=0.0, atol=1e-5)
        momentum, drift = arm.links.momentum(theta, velocity)
        np.testing.assert_allclose(momentum, whole @ velocity, rtol=0.0, atol=1e-5)
        # p' = tau + C^T v along any motion, which is what the observer relies on
        before, after = (
            arm.links.momentum(theta + s * velocity + s * s / 2.0 * acceleration, velocity + s * acceleration)[0]
            for s in (-1e-5, 1e-5)
        )
        balance = np.add(arm.links.torque(theta, velocity, acceleration), drift)
        np.testing.assert_allclose(np.subtract(after, before) / 2e-5, balance, rtol=0.0, atol=1e-5)
        assert np.all(1.0 / np.diag(np.linalg.inv(whole)) > 0.9 * np.array(arm.links.least))


# Torque that gravity cannot account for.


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
        monitor.follow(0.0, tilt, None)
        low, high = monitor.explained(theta.tolist())
        torque = truth.torque(theta, 9.80665 * np.array(tilt.gravity_in_trunk))
        assert np.all(low - beside - 0.01 <= torque) and np.all(torque <= high + beside + 0.01)
