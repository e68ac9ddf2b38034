# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A wearer's arm that is known by its moments and the springs of its joints, against MuJoCo's."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import MAX_TISSUE, TISSUE_REACH, Wearer
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import COMPENSATOR, Settings, settings_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import values_of
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.observer.momentum import MomentumObserver
from exo_gravity.sim import ArmConfig, SimulatedArm
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.urdf import UrdfConfig

from ..support.chains import random_chain

STILL = (0.0,) * 4
PERSON = ArmConfig(
    wearer_mass=(0.0, 0.0, 2.0, 1.6), wearer_cog=(0.0, 0.0, 0.16, 0.17), wearer_cog_y=(0.0, 0.0, 0.02, 0.03),
    wearer_cog_z=(0.0, 0.0, 0.01, -0.04), wearer_stiffness=(1.5, 1.0, 0.5, 0.8), wearer_rest=(0.1, 0.4, 0.3, 0.9),
)  # fmt: skip
ALONG = (3.6 * 0.05, 3.6 * 0.13, 2.0 * 0.16 + 1.6 * 0.3, 1.6 * 0.17)
ACROSS = (0.0, 2.0 * 0.01 - 1.6 * 0.04, 2.0 * 0.02, 1.6 * 0.03)
TISSUE = Springs(PERSON.wearer_stiffness, PERSON.wearer_rest, TISSUE_REACH)
SETTINGS = Settings(
    "left", DEFAULT_LINKS, mode="zero_g", support=1.0, wearer_mass=PERSON.wearer_mass, wearer_cog=PERSON.wearer_cog,
    wearer_moments=(ALONG, ACROSS), tissue=TISSUE, max_effort=(30.0,) * 4,
)  # fmt: skip
POSES = np.random.default_rng(3).uniform((-0.5, 0.0, -0.5, 0.0), (0.9, 1.3, 1.2, 1.5), (20, 4)).tolist()


def held(config, pose):
    """Return the torque (n,) in Nm that holds a simulated arm on an upright trunk."""
    arm = SimulatedArm(config)
    arm.reset(pose)
    return arm.data.qfrc_bias - arm.data.qfrc_passive


def test_zero_g_holds_segments_beside_their_links_and_springs_and_the_observer_sees_no_wearer():
    tilt, bare = Tilt.of("left"), replace(PERSON, wearer_mass=STILL, wearer_stiffness=STILL)
    for pose in POSES:
        needed, own = held(PERSON, pose), held(bare, pose)
        assert SETTINGS.torque(pose, tilt)[0] == pytest.approx(needed, abs=1e-9)
        part = replace(SETTINGS, support=0.4).torque(pose, tilt)[0]
        assert part == pytest.approx(own + 0.4 * (needed - own), abs=1e-9)
        assert replace(SETTINGS, mode="one_g").torque(pose, tilt)[0] == pytest.approx(own, abs=1e-9)
        estimate = MomentumObserver(SETTINGS).update(0.0, (pose, STILL, needed.tolist()), tilt)
        assert estimate.torque == pytest.approx(STILL, abs=1e-9)
        weight = needed - own - TISSUE.torque(pose)
        assert estimate.weight == pytest.approx(weight, abs=1e-9)  # gravity's alone


def test_a_new_wearer_is_a_guided_change_without_a_step():
    other = replace(SETTINGS, wearer_moments=(tuple(0.5 * m for m in ALONG), ACROSS), tissue=Springs())
    compensator, pose, efforts = Compensator(replace(SETTINGS, use_imu=False)), (0.2, 0.9, 0.7, 0.6), []
    for n in range(1500):
        if n == 100:
            compensator.apply(replace(other, use_imu=False))
        efforts.append(compensator.step(n * 0.01, pose, STILL).effort)
    steps = np.abs(np.diff(efforts, axis=0)).max()
    assert np.abs(np.subtract(efforts[-1], efforts[0])).max() > 3.0 and steps < 0.3
    assert efforts[-1] == pytest.approx(other.torque(pose, Tilt.of("left"))[0])


def test_beyond_its_reach_a_spring_pulls_no_harder():
    tissue = Springs((1.0, 0.0, 2.0), (0.1, 0.0, -0.2), TISSUE_REACH)
    assert tissue.torque((0.6, 3.0, -0.7)) == pytest.approx((0.5, 0.0, -1.0))
    assert tissue.torque((3.0, 3.0, -3.0)) == pytest.approx((TISSUE_REACH, 0.0, -2.0 * TISSUE_REACH))


def test_springs_of_a_wearer_on_an_arm_of_five_joints_from_a_urdf():
    count = 5
    text, names = random_chain(count, seed=8)
    arm, tilt = UrdfArm(text, names, "hand"), Tilt.of("left")
    stiffness, rest = (0.0, 1.2, 0.4, 2.0, 0.0), (0.0, 0.3, -0.2, 0.5, 0.0)
    settings = Settings(
        "left", arm, "urdf", mode="zero_g", support=0.5, max_effort=(90.0,) * count, use_imu=False,
        tissue=Springs(stiffness, rest, TISSUE_REACH),
    )  # fmt: skip
    config = UrdfConfig(
        text=text, joint_names=names, hand="hand", wearer_stiffness=tuple(0.5 * k for k in stiffness), wearer_rest=rest
    )
    for pose in np.random.default_rng(1).uniform(-0.6, 0.9, (10, count)).tolist():
        assert settings.torque(pose, tilt)[0] == pytest.approx(held(config, pose), abs=1e-9)
    with pytest.raises(ParameterError, match=r"wearer.joint_stiffness"):
        replace(settings, tissue=Springs((1.0,) * 4, (0.0,) * 4))


GIVEN = {"wearer.first_moment": list(ALONG), "wearer.off_axis": list(ACROSS)}
VALUES = values_of(COMPENSATOR, {"mode": "zero_g", "support": 1.0, **GIVEN})


def test_moments_stand_in_place_of_masses():
    alone, tabled = settings_of(VALUES), settings_of({**VALUES, "wearer.body_mass": 75.0})
    assert alone.arm.first_moment == pytest.approx(np.add(alone.robot.first_moment, ALONG))
    assert sum(alone.wearer_mass) == pytest.approx(3.6, rel=0.3)  # for the inertia
    mass, _ = Wearer(75.0).on_links(tabled.robot.length)
    assert tabled.arm == alone.arm and tuple(tabled.wearer_mass) == tuple(mass)


REFUSED = {
    r"exact with wearer\.first_moment": lambda: settings_of({**VALUES, "law": "paper_static"}),
    r"wearer\.first_moment.* at most 10 kg, not 1[0-9]": lambda: settings_of(
        {**VALUES, "wearer.first_moment": [0.2, 0.6, 2.0, 2.0]}
    ),
    **{
        f"wearer.{name} = .*{wrong}": lambda row=row, wrong=wrong: replace(
            SETTINGS,
            wearer_moments=np.insert(np.zeros((1, 4)), row, (0.0, 0.0, wrong, 0.1), axis=0).tolist(),
        )
        for row, name, wrong in (
            (0, "first_moment", 4.1),
            (0, "first_moment", -0.1),
            (1, "off_axis", 0.6),
            (1, "off_axis", math.nan),
        )
    },
    "wearer.joint_stiffness": lambda: replace(SETTINGS, tissue=Springs((0.0, 0.0, MAX_TISSUE + 0.1, 0.0))),
    "wearer.joint_rest": lambda: replace(SETTINGS, tissue=Springs((1.0,) * 4, (4.0,) * 4)),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_no_wearer_has_is_refused(words):
    with pytest.raises(ParameterError, match=words):
        REFUSED[words]()
