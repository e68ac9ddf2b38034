# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Weighing the load in the hand of a simulated arm, whose masses, friction and wearer the controller knows."""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.compensation.settings import ModelError, Settings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.vocabulary import WeighingPhase
from exo_gravity.lab.weighing import Weighed, Weigher, Weighing, refusal
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.rig import Rig

from ..support import PARTS
from ..support.simulated_device import joints_of, make_device

POSE = (0.0, 0.2, 0.0, 0.8)  # rad
HANGING, ELSEWHERE = (0.0, 0.0, 0.0, 0.0), (0.0, 1.2, 0.0, 0.3)
STILL = (0.0,) * 4
RATE = 100.0  # Hz
MOVE = 4.0  # s in which the hand leads the arm to POSE
LOAD = Wearer(70.0).on_links(DEFAULT_LINKS.length)
SETTINGS = Settings(
    "right", DEFAULT_LINKS, mode="zero_g", support=1.0, wearer_mass=tuple(LOAD.mass), wearer_cog=tuple(LOAD.cog),
    use_imu=False, max_effort=(9.0, 18.0, 9.0, 9.0), model_error=ModelError((0.05,) * 4, (0.01,) * 4, 0.02, 0.01),
)  # fmt: skip
TILT = Tilt.of("right")


def weigh(mass: float, **wearer: Any) -> tuple[Weighing, Rig]:
    """Weigh `mass` kg once a hand holds the arm at POSE; return the weighing and the arm.

    wearer: a step that they do then in place of relaxing.
    """
    device = make_device(config=ArmConfig(wearer_mass=SETTINGS.wearer_mass, wearer_cog=SETTINGS.wearer_cog))
    device.arm.carry(mass)
    device.arm.reset((0.0, 0.05, 0.05, 0.05))
    limits = Limits(PARTS, max_effort=SETTINGS.max_effort, sign_check_torque=0.0)
    arm = Rig(device, SETTINGS, joints_of((MIT,) * 4), limits, RATE)
    arm.carry()
    arm.act({"move": list(POSE), "over": MOVE}, wearer or {"hold": 20.0})
    arm.run(0.95 * MOVE)
    weigher = Weigher(arm.compensator, PARTS)
    assert not weigher.begin(RATE) and weigher.begin(RATE).text == "a weighing is under way"
    weighing = weigher.weighing
    arm.forget()
    arm.run_until(lambda: weighing.is_over)
    return weighing, arm


def test_a_load_of_1_kg_is_weighed_and_the_arm_stays_calm():
    weighing, arm = weigh(1.0)
    assert weighing.result is not None, weighing.text
    assert weighing.result.mass == pytest.approx(1.0, abs=0.03) and weighing.empty is None
    assert weighing.text.endswith(f": payload.mass = {weighing.result.mass:.3f} carries it")
    assert not arm.fault and np.abs(arm.truth.records["velocity"]).max() < 2.0


@pytest.mark.thorough
def test_a_wearer_who_helps_with_one_joint_is_refused():
    weighing, _ = weigh(0.5, push=[0.0, 0.0, 2.5, 0.0], over=60.0)  # half a sine wave: nearly constant meanwhile
    assert weighing.result is None
    assert ": no load in the hand explains " in weighing.trouble.text or "two turns" in weighing.trouble.text


def test_little_pushes_against_a_hand_that_moves_the_arm_and_not_for_long():
    compensator = Compensator(SETTINGS)
    weigher, moved = Weigher(compensator, PARTS), (0.0, 0.5, 0.0, 0.8)
    compensator.step(0.0, POSE, STILL)
    assert not weigher.begin(RATE)
    efforts = [
        compensator.step(0.01 * k, pose, STILL).effort[1] for k, pose in enumerate((POSE, *[moved] * 1000), start=1)
    ]
    assert re.search("shoulder_abduction.*a hand on the arm", weigher.weighing.trouble.text)
    pushed = np.abs(np.subtract(efforts[100:], SETTINGS.torque(moved, TILT)[0][1]))
    assert 4.0 < pushed.max() < 9.0 and pushed[-1] == pytest.approx(0.0)  # Nm; the motor has 18


@pytest.mark.parametrize(
    ("end", "why"),
    [
        (lambda compensator: compensator.apply(SETTINGS), "the settings changed"),
        (lambda compensator: compensator.tilt.set_gravity(0.2, (0.3, 0.0, -0.95)), "the trunk turned fast"),
    ],
)
def test_a_client_gets_2_nm_and_what_5_kg_need_until_the_settings_change_or_the_trunk_turns_fast(end, why):
    compensator = Compensator(
        replace(SETTINGS, max_effort=(90.0,) * 4, max_effort_rate=1000.0, use_imu=True, tilt_timeout=0.5)
    )
    compensator.tilt.set_gravity(0.0, (0.0, 0.0, -1.0))
    client = Mock(is_over=False, torque=Mock(return_value=(100.0,) * 4))
    before = compensator.step(0.0, POSE, STILL).effort
    assert compensator.lend(client) and not compensator.lend(client)
    after = [compensator.step(0.01 * cycle, POSE, STILL).effort for cycle in range(1, 20)][-1]
    assert np.subtract(after, before) == pytest.approx(
        2.0 + 5.0 * 9.80665 * np.abs(SETTINGS.unit_load.torque(POSE, TILT))
    )
    end(compensator)
    compensator.step(0.2, POSE, STILL)
    client.interrupt.assert_called_once_with(why)


TROUBLE = {  # the arm's poses, its velocity, and what is said of it
    "hanging": ([HANGING], STILL, "bend the elbow by 45 degrees"),
    "moving": ([POSE], (0.0, 0.0, 0.5, 0.0), r"the arm moves at 0\.50 rad/s: hold it still"),
    "held, or not carried": ([POSE] * 3000, STILL, "does not follow|a hand on the arm"),
    "its load falls": ([POSE, (0.0, 0.2, 0.0, 1.3)], STILL, r"was the load dropped\?"),
}


@pytest.mark.parametrize(("poses", "velocity", "said"), TROUBLE.values(), ids=TROUBLE)
def test_an_arm_that_cannot_be_weighed_is_left_alone_with_what_would_be_right(poses, velocity, said):
    weighing = Weighing(SETTINGS, PARTS, RATE)
    torques = [weighing.torque(0.01, theta, velocity, TILT, STILL) for theta in poses]
    assert torques[-1] == STILL and weighing.result is None
    assert re.search(said, weighing.trouble.text) and weighing.text.startswith("not weighed: ")


@pytest.mark.parametrize(
    ("changes", "terms", "rate", "said"),
    [
        ({}, ("friction", "inertia"), RATE, "^$"),
        ({}, ("friction", "spring"), RATE, "spring would carry a part"),
        ({"support": 0.9}, (), RATE, "support 1"),
        ({"mode": "one_g"}, (), RATE, "zero_g"),
        ({"mode": "one_g", "wearer_mass": STILL}, (), RATE, "^$"),
        ({}, (), 50.0, "50 Hz, must be 80 or more"),
        ({}, (), 0.0, "0 Hz"),
    ],
)
def test_what_would_hide_the_load_is_refused_before_anything_moves(changes, terms, rate, said):
    assert re.search(said, refusal(replace(SETTINGS, **changes), terms, rate).text)
    assert Weighing(SETTINGS, PARTS, rate).phase is WeighingPhase.TAKING_OVER  # made before the rate is known


def weighed(mass: float, pose: Sequence[float], empty: Weighed | None = None) -> Weighing:
    weighing = Weighing(SETTINGS, PARTS, RATE, empty)
    weighing.torque(0.01, pose, STILL, TILT, STILL)
    weighing.result = Weighed(mass, 0.004, np.array(SETTINGS.unit_load.torque(pose, TILT)))
    return weighing


def test_with_the_empty_hand_weighed_before_the_error_of_the_model_is_left_out():
    first = weighed(0.06, POSE)
    assert first.text.endswith(": the hand is empty")
    second = weighed(1.05, POSE, first.empty)
    assert "1.050 +- " in second.text and "; 0.990 +- " in second.text
    assert second.text.endswith(": payload.mass = 0.990 carries it")
    assert second.empty is first.result  # 1.05 kg is no empty hand
    assert "empty" not in weighed(1.05, ELSEWHERE, first.empty).text
    for change, is_known in (({"payload": SETTINGS.payload._replace(mass=0.5)}, True), ({"wearer_mass": STILL}, False)):
        weigher = Weigher(Mock(settings=replace(SETTINGS, **change), **{"terms.active": ()}), PARTS)
        weigher.weighing = first
        assert not weigher.begin(RATE) and (weigher.weighing.empty is first.result) == is_known
