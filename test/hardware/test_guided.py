# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Live changes of load, what has thrown an arm where a torque began or a load went, and wearers who reach.

With a person's arm in the device: judged by the true motion of the joints, and by how fast the motors drive them.
"""

import math
from functools import partial

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.catalogue import Friction, Inertia, Spring
from exo_gravity.core.compensation.terms.terms import SUM, TermSettings
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.command import State
from exo_gravity.core.safety.explain import MOTION
from exo_gravity.sim import VirtualWearer
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.rig import ACTS
from exo_gravity.sim.script import TrialScript

from ..support import PARTS
from ..support.thorough import quick
from .arms import PEAK, RATE, RATED, CarriedArm, raised_usual_arm, usual_arm

SAFE_SPEED = 0.65  # rad/s, at which an arm without friction sinks under the damping of the motors
RAISED = (0.0, 1.2, 0.3, 0.3)  # rad
ONE_G = {"mode": "one_g"}
SPRING = {"terms": TermSettings(spring=Spring((4.0, 14.0, 7.0, 3.9), (0.0, 0.0, -0.3, 1.3)))}
CLAMPED = {"max_effort": (0.5,) * 4}
HALVED = {"robot": ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass, (0.5,) * 4)}

BARE = {"pose": RAISED, "has_wearer": False, "mode": "one_g"}
guided_arm = partial(raised_usual_arm, rate=RATE, peak=PEAK, use_imu=True)  # with few options: each takes seconds


def fastest_driven(arm: CarriedArm) -> float:
    """The largest true speed of a joint along its motor's torque in rad/s."""
    records = arm.truth.records
    return float(np.abs(records["velocity"][records["velocity"] * records["torque"] > 0.0]).max(initial=0.0))


HANGING, LEANING = (0.0,) * 4, (0.0, 0.3, 0.2, 0.2)
ZERO_G = {"mode": "zero_g"}


# Carried again: in the mode for a wearer whose weight is not there, or by an IMU that is wrong by so many degrees.
AGAIN = [(LEANING, 0.0), (HANGING, 30.0), (HANGING, -30.0)]


@pytest.mark.parametrize(("pose", "roll"), quick(AGAIN[:1], AGAIN))
def test_an_empty_arm_whose_load_is_not_as_believed_when_it_is_carried_again_moves_slowly(pose, roll):
    arm = usual_arm(pose, RATE, peak=PEAK, has_wearer=False, use_imu=bool(roll), mode="one_g")
    arm.act({"move": list(pose), "over": 60.0})
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.state is State.DISABLED)
    if roll:
        ACTS["imu_wrong"](arm, 0.0, math.radians(roll), 1.0)  # a jump would be refused
    else:
        arm.change(mode="zero_g")
    arm.run(1.0)
    arm.enable()
    assert arm.run_until(lambda: arm.state is State.RAMPING_IN)
    arm.forget()
    arm.act()
    arm.run(8.0)
    assert roll or arm.device.arm.positions[1] > 1.0  # nobody's weight holds it
    assert 0.1 < fastest_driven(arm) < SAFE_SPEED


LOOSE = [(BARE, 30.0), ({}, 30.0), ({}, 60.0)]


@pytest.mark.parametrize(("given", "roll"), quick(LOOSE[:1], LOOSE), ids=["empty, 30 degrees", "worn, 30", "worn, 60"])
def test_an_imu_that_comes_loose_drives_the_arm_slowly(given, roll):
    arm = guided_arm(**given)
    ACTS["imu_wrong"](arm, 0.0, math.radians(roll), 0.2)
    arm.run(4.2)
    assert 0.1 < fastest_driven(arm) < SAFE_SPEED


def test_a_trunk_that_falls_takes_the_arm_along_and_one_that_bows_is_not_felt():
    arm, damped = guided_arm(), []
    for angle, duration in ((0.5, 1.0), (0.0, 1.0), (1.4, 0.8)):
        arm.forget()
        arm.act({"bow": angle, "over": duration})
        damped.append(arm.run_until(lambda: arm.direct.answer.damped, 4.0))
    assert damped == [False, False, True]
    arm.run(3.0)
    assert arm.state is State.ACTIVE, arm.safety.fault
    assert arm.fastest < 4.0  # where the torque follows at once it is 7.7


BACK = {"mode": "zero_g", "max_effort": PEAK}
WORN = [ONE_G, BACK, ONE_G, CLAMPED, {"support": 0.3}, BACK, SPRING, ONE_G]
LEFT = [{"mode": "zero_g", "support": float(support)} for support in np.linspace(1.0, 0.0, 8)]
ALL = [HALVED, ZERO_G, CLAMPED, {"max_effort": PEAK}, {"robot": DEFAULT_LINKS}, HALVED, ONE_G]
UPON = [(True, [*WORN, *LEFT]), (False, [ZERO_G, ONE_G] * 4), (False, ALL)]


@pytest.mark.parametrize(
    ("has_wearer", "changes"), quick(UPON[:1], UPON), ids=["worn", "mode", "gain, mode and max_effort"]
)
def test_changes_upon_changes_are_as_calm_as_one(has_wearer, changes):
    arm = guided_arm(**({"pose": RAISED} if has_wearer else BARE))
    for change in changes:
        arm.change(**change)
        arm.run(0.3)
    arm.run_until(lambda: arm.direct.answer.remainder == (), 9.0)
    assert (arm.fastest if has_wearer else fastest_driven(arm)) < SAFE_SPEED
    assert arm.state is State.ACTIVE and arm.direct.answer.remainder == ()


THROWN = {  # pose, most torque, what happens then, rad/s at which a motor may drive a joint, and the fault
    "out of the cuff, rated torques": ((0.2, 0.35, -0.20, 0.9), RATED, "out_of_cuff", 1.5, "load_missing"),
    "out of the cuff, peak torques": ((0.1, 0.5, 0.5, 0.6), PEAK, "out_of_cuff", 1.6, "load_missing"),
    "clamped, arm abducted": ((0.0, 1.8, 0.2, 0.2), RATED, "limp", 1.9, ""),
}


@pytest.mark.thorough  # `make test` plays the row of the fault matrix in which the arm leaves the cuff
@pytest.mark.parametrize("name", THROWN)
def test_whatever_drives_an_arm_by_mistake_does_not_throw_it(name):
    pose, most, event, fastest, fault = THROWN[name]
    arm = raised_usual_arm(pose, peak=most)
    arm.forget()
    ACTS[event](arm)
    arm.run(3.0)
    assert arm.fault == fault and arm.caused.speed < fastest


# Reaches at up to 3.6 rad/s, as fast as is permitted (5 rad/s trips over_speed), and shakes at 2 Hz.
REACHES = [(0.3, 1.3, 1.2, 1.5), (-0.5, 0.4, -0.1, 0.3), (0.6, 1.5, 1.2, 1.6), (0.0, 0.5, 0.1, 0.4)]
FAST = [{"move": list(pose), "over": 1.1} for pose in REACHES]
FAST += [{"push": [0.0, 4.0 * sign, 2.0 * sign, 1.0 * sign], "over": 0.25} for sign in (1, -1, 1, -1)]
TERMS = TermSettings(
    friction=Friction(0.8, (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)),
    inertia=Inertia(0.6),
    spring=Spring((2.0, 4.0, 2.0, 1.0)),
    assist=Assist((2.0, 4.0, 2.0, 2.0)),
)
MOMENT = DEFAULT_LINKS.with_wearer(*Wearer(75.0).on_links(DEFAULT_LINKS.length)).first_moment


@pytest.mark.parametrize("is_assisted", quick([True], [False, True]), ids=["zero_g", "terms_and_assistance"])
def test_a_fast_wearer_is_not_let_down(is_assisted):
    addition = tuple(map(sum, zip(SUM.effort, TERMS.assist.max_effort, strict=True))) if is_assisted else NO_TORQUE
    limits = {"sign_check_torque": 0.0, "largest_moment": MOMENT, "largest_addition": addition}
    added = {"terms": TERMS, "inertial": True, "friction": 0.4} if is_assisted else {}
    arm = CarriedArm(rate=100.0, limits=limits, **added)
    arm.carry()
    arm.forget()

    def assist(answer):
        """Push the way that the arm moves; the push fades towards 3.5 rad/s."""
        pushed = [math.copysign(4.0 * max(0.0, 1.0 - abs(v) / 3.5), v) for v in arm.device.arm.velocities]
        arm.compensator.terms.assist.receive(arm.now, PARTS, pushed, arm.now)
        return answer

    arm.controller.change = assist if is_assisted else None
    arm.device.start(VirtualWearer(TrialScript.parse({"name": "fast", "steps": FAST}), strength=40.0))
    largest = []
    for _ in range(500):
        arm.cycle()
        columns = zip(arm.safety.motion.impulse, arm.safety.motion.full, strict=True)
        largest += [impulse / (MOTION.patience * full) for impulse, full in columns if full]
    assert (
        not arm.fault
        and 3.0 < np.abs(arm.records["velocity"]).max() < 5.0
        and max(largest) < 0.5
        and not arm.compensator.lost
    )
