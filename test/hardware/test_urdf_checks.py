# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Descriptions that are incomplete but not empty: what changes the torque is used or refused, the rest is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rtbdata

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import urdf_settings_of, urdf_table
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.hardware.urdf_arm import UrdfArm

from ..support.urdf_oracle import MujocoArm

PANDA = (Path(__file__).parents[1] / "data" / "arms" / "panda.urdf").read_text(encoding="utf-8")
KR16 = Path(rtbdata.__path__[0], "xacro/kuka_description/kuka_kr16/urdf/kr16_2.urdf").read_text(encoding="utf-8")
WHOLE = [f"panda_joint{n}" for n in range(1, 8)]
GRAVITY = 9.80665 * np.array((0.12, -0.35, -0.929)) / np.linalg.norm((0.12, -0.35, -0.929))  # m/s^2, in the root link
TILT = Tilt.of_gravity("left", GRAVITY / 9.80665)
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
        expected = whole.torque(theta, GRAVITY)[:3]
        # Of the other joints only the last does not change the torque by more than 3 %: it is left at 0.
        assert np.allclose(arm.torque(theta[:3], TILT), expected, rtol=0.0, atol=0.03 * 50.0)
        whole_but_last = whole.torque((*theta[:6], 0.0), GRAVITY)[:3]
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
        return mujoco.energy((first, -0.7 * first + 0.2, last), GRAVITY)

    for first, last in random.uniform(-1.5, 1.5, (20, 2)):
        small = 1e-5
        expected = (
            (energy(first + small, last) - energy(first - small, last)) / (2.0 * small),
            (energy(first, last + small) - energy(first, last - small)) / (2.0 * small),
        )
        assert arm.torque((first, last), TILT) == pytest.approx(expected, abs=1e-8)
    with pytest.raises(ParameterError, match="joint_names = 'j2': must be j1, which that joint follows"):
        UrdfArm(text, ["j1", "j2", "j3"])


def test_mimic_joints_that_follow_each_other_are_refused() -> None:
    circle = DEPENDS.replace("j1", "j3")
    with pytest.raises(ParameterError, match="a joint that does not follow it in turn"):
        UrdfArm(chain(*THREE[:4], joint(2, extra=circle), joint(3, extra=DEPENDS.replace("j1", "j2"))), ["j1"])


def test_a_link_with_a_shape_and_no_mass_is_refused_where_a_joint_of_the_arm_moves_it_and_named_elsewhere() -> None:
    empty = link("l2", mass=0.0, extra=SHAPE)
    with pytest.raises(ParameterError, match="link = 'l2': must be with a mass"):
        UrdfArm(chain(link("l1"), empty, *THREE[2:]), ["j1", "j2", "j3"])
    arm = UrdfArm(chain(link("l1"), empty, link("l3"), joint(1), joint(2, "fixed"), joint(3)), ["j1", "j3"])
    assert arm.notes == ("these moving links have a shape and no mass: l2",)
    assert UrdfArm(chain(link("l1"), link("l2", mass=0.0), *THREE[2:]), ["j1", "j2", "j3"]).notes == ()


def test_equal_masses_in_the_joints_are_placeholders_and_refused_unless_they_hardly_matter() -> None:
    with pytest.raises(ParameterError, match=r"mass of link_1, .* link_6 .* make 100% of the torque"):
        UrdfArm(KR16, [f"joint_a{n}" for n in range(1, 7)])
    two = (link("l2", 0.005, 0.0), link("l3", 0.005, 0.0))
    (note,) = UrdfArm(chain(link("l1"), *two, *THREE[3:]), ["j1", "j2", "j3"]).notes
    assert note.startswith("the masses of these links look like placeholders,") and note.endswith("l2, l3")
    equal = UrdfArm(chain(*THREE), ["j1", "j2", "j3"])  # modules of one kind, with their centres of gravity
    assert equal.notes == ()


@pytest.mark.parametrize("effort", [2000.0, 0.5])
def test_an_effort_limit_that_no_joint_of_such_an_arm_has_is_not_used(effort: float) -> None:
    arm = UrdfArm(chain(*THREE[:3], joint(1), joint(2, effort=effort), joint(3)), ["j1", "j2", "j3"])
    assert arm.max_effort == (30.0, 0.0, 30.0)
    assert arm.notes[0].startswith(f"the effort limit of j2, {effort:g} Nm, is not used: gravity needs up to")
    given = {"joint_names": ["j1", "j2", "j3"], "max_effort": [0.0, 20.0, 0.0], "use_imu": False}
    assert urdf_settings_of(values_of(urdf_table(given), given), arm).max_effort == (30.0, 20.0, 30.0)
    with pytest.raises(ParameterError, match=r"max_effort of j2 = 0\.0: must be greater than 0"):
        urdf_settings_of(values_of(urdf_table(given), given | {"max_effort": [0.0] * 3}), arm)
