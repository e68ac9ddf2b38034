# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Arms in virtual time that something would throw, and wearers who reach: judged by the truth of the simulated device.

Joint speeds are MuJoCo's, torques those that the motors apply, masses those of the paper's arm and a wearer of 75 kg.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.assist import Assist
from exo_gravity.core.compensation.terms.catalogue import Friction, Inertia, Spring
from exo_gravity.core.compensation.terms.terms import SUM, TermSettings
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.explain import MOTION
from exo_gravity.core.safety.limits import Limits
from exo_gravity.sim import ArmConfig, VirtualWearer
from exo_gravity.sim.events import ACTS
from exo_gravity.sim.rig import Rig
from exo_gravity.sim.script import TrialScript

from ..support import ROBOT
from ..support.simulated_device import joints_of, make_device
from ..support.thorough import quick

MASS, COG = (tuple(map(float, load)) for load in Wearer(75.0).on_links(ROBOT.length))
RATED, PEAK = (3.0, 9.0, 3.0, 3.0), (9.0, 18.0, 9.0, 9.0)  # Nm
MOMENT = ROBOT.first_moment  # kg m, of the robot
WORN = {"mode": "zero_g", "support": 1.0, "wearer_mass": MASS, "wearer_cog": COG}


def make_arm(is_worn: bool, rate: float, settings: dict[str, Any], **limits: Any) -> Rig:
    """Return a right arm that hangs, with a compensator that has these settings."""
    most = limits.setdefault("max_effort", RATED)
    device = make_device(config=ArmConfig(wearer_mass=MASS, wearer_cog=COG) if is_worn else None)
    device.arm.reset((0.0, 0.05, 0.05, 0.05))
    assumed = {"side": "right", "robot": ROBOT, "max_effort": most, **(WORN if is_worn else {}), **settings}
    known = Limits(JOINTS, sign_check_torque=0.0, **limits)
    return Rig(device, Settings(**assumed), joints_of((MIT,) * 4), known, rate)


RAISED, OUT = (0.2, 0.35, -0.20, 0.9), (0.1, 0.5, 0.5, 0.6)  # rad, which the rated and the peak torques carry
THROWN = {  # pose, most torque, what happens then, rad/s at which a motor may drive a joint
    "out of the cuff, rated torques": (RAISED, RATED, "out_of_cuff", 2.9),
    "out of the cuff, peak torques": (OUT, PEAK, "out_of_cuff", 2.9),
    "clamped, arm abducted": ((0.0, 1.8, 0.2, 0.2), RATED, "limp", 1.9),
}


@pytest.mark.parametrize("name", quick(["out of the cuff, peak torques"], THROWN))
def test_whatever_drives_an_arm_by_mistake_does_not_throw_it(name):
    pose, most, event, fastest = THROWN[name]
    arm = make_arm(True, 250.0, {}, max_effort=most)
    arm.carry()
    arm.raise_to(pose, 1.5, 0.0)
    arm.forget()
    ACTS[event](arm)
    arm.run(3.0)
    assert arm.fault == "" and arm.caused.speed < fastest


def test_an_arm_whose_imu_is_wrong_by_30_degrees_is_not_carried():
    arm = make_arm(True, 250.0, {}, max_effort=PEAK)
    arm.imu_error = [math.radians(30.0), 0.0]
    with pytest.raises(RuntimeError, match="torque_while_hanging"):
        arm.carry()


WRONG = {  # settings from the start, lean of the trunk in rad; s from when the motors are on, and rad/s until the fault
    "three times the mass": ({"robot": ArmModel(ROBOT.length, ROBOT.cog, 3.0 * ROBOT.mass)}, 0.0, 2.2, 0.4),
    "the wrong side": ({"side": "left"}, 0.3, 6.0, 0.6),
}


@pytest.mark.parametrize(("settings", "lean", "latest", "fastest"), WRONG.values(), ids=WRONG)
def test_a_wrong_compensator_is_let_down_before_a_free_arm_is_fast(settings, lean, latest, fastest):
    arm = make_arm(False, 100.0, settings, largest_moment=MOMENT)
    arm.between_cycles(arm.safety.enable)
    arm.run_until(lambda: arm.state is State.PROVING)
    arm.forget()
    begin = arm.now
    arm.act({"hold": 4.0}, {"lean": lean, "over": 1.0}, {"hold": 4.0})
    assert arm.run_until(lambda: arm.fault, latest) and arm.fault == "unexplained_torque", arm.now - begin
    assert np.abs(arm.truth.records["velocity"]).max() < fastest
    arm.run(3.0)
    assert arm.caused.speed < fastest


# Reaches at up to 3.6 rad/s, as fast as is permitted (5 rad/s trips over_speed), and shakes at 2 Hz.
REACHES = [(0.3, 1.3, 1.2, 1.5), (-0.5, 0.4, -0.1, 0.3), (0.6, 1.5, 1.2, 1.6), (0.0, 0.5, 0.1, 0.4)]
FAST = [{"move": list(pose), "over": 1.1} for pose in REACHES]
FAST += [{"push": [0.0, 4.0 * sign, 2.0 * sign, 1.0 * sign], "over": 0.25} for sign in (1, -1, 1, -1)]


@pytest.mark.parametrize("is_assisted", quick([True], [False, True]), ids=["zero_g", "terms_and_assistance"])
def test_a_fast_wearer_is_not_let_down(is_assisted):
    terms = TermSettings(
        friction=Friction(0.8, (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)),
        inertia=Inertia(0.6),
        spring=Spring((2.0, 4.0, 2.0, 1.0)),
        assist=Assist((2.0, 4.0, 2.0, 2.0)),
    )
    addition = tuple(map(sum, zip(SUM.effort, terms.assist.max_effort, strict=True))) if is_assisted else NO_TORQUE
    moment = ROBOT.with_wearer(MASS, COG).first_moment
    settings = {"terms": terms, "inertial": True} if is_assisted else {}
    arm = make_arm(True, 100.0, settings, largest_moment=moment, largest_addition=addition)
    arm.carry()
    arm.forget()

    def assist(answer):
        """Push the way that the arm moves; the push fades towards 3.5 rad/s."""
        pushed = [math.copysign(4.0 * max(0.0, 1.0 - abs(v) / 3.5), v) for v in arm.device.arm.velocities]
        arm.compensator.terms.assist.receive(arm.now, JOINTS, pushed, arm.now)
        return answer

    arm.controller.change = assist if is_assisted else None
    arm.device.start(VirtualWearer(TrialScript.parse({"name": "fast", "steps": FAST}), strength=40.0))
    largest = []
    for _ in range(500):
        arm.cycle()
        columns = zip(arm.safety.motion.impulse, arm.safety.motion.full, strict=True)
        largest += [impulse / (MOTION.patience * full) for impulse, full in columns if full]
    assert not arm.fault and 3.0 < np.abs(arm.truth.records["velocity"]).max() < 5.0 and max(largest) < 0.5
