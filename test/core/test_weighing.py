# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Weighing the load in the hand of a simulated arm, whose masses, friction and wearer the controller knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from exo_gravity.core.arm.arm_data import ModelError
from exo_gravity.core.arm.gravity import exact_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.compensator import JOINTS, Compensation, Compensator
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.weighing import Weighed, Weighing, refusal
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.vocabulary import WeighingPhase
from exo_gravity.lab.trial.offline import ArmSetup, OfflineTrial
from exo_gravity.sim import ArmConfig
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.script import TrialScript

from ..support.simulated_device import joints_of, make_device

POSE = (0.0, 0.2, 0.0, 0.8)  # rad
HANGING, ELSEWHERE = (0.0, 0.0, 0.0, 0.0), (0.0, 1.2, 0.0, 0.3)
STILL = (0.0,) * 4
RATE = 100.0  # Hz
MOVE, HELD = 7.0, 9.2  # s in which the hand leads the arm to POSE, and time at which it holds it there
LOAD = Wearer(70.0).on_links(DEFAULT_LINKS.length)
CALIBRATED = ModelError((0.05,) * 4, (0.01,) * 4, 0.02, 0.01)
SETTINGS = Settings(
    "right", DEFAULT_LINKS, mode="zero_g", support=1.0, wearer_mass=tuple(LOAD.mass), wearer_cog=tuple(LOAD.cog),
    use_imu=False, max_effort=(9.0, 18.0, 9.0, 9.0), model_error=CALIBRATED,
)  # fmt: skip
TILT = Tilt.of("right")


class Balance(Compensator):
    """A compensator that weighs once, `at` s."""

    def __init__(self, settings: Settings, at: float) -> None:
        super().__init__(settings)
        self._planned = Weighing(settings, JOINTS, RATE)
        self._at = at

    def step(self, now: float, theta: Sequence[float], velocity: Sequence[float] | None = None) -> Compensation:
        """Return the answer that the bridge gets."""
        if now >= self._at and self.weighing is None:
            assert self.weigh(self._planned) == ""
            assert self.weigh(self._planned) == "a weighing is under way"
        return super().step(now, theta, velocity)


def weigh(mass: float, *after: dict[str, Any]) -> tuple[Weighing, str, np.ndarray]:
    """Weigh `mass` kg; return the weighing, what went wrong with the arm, and its speeds (n, 4) rad/s.

    after: what the wearer does in place of relaxing, from when they have brought the arm to POSE.
    """
    device = make_device(config=ArmConfig(wearer_mass=SETTINGS.wearer_mass, wearer_cog=SETTINGS.wearer_cog))
    device.arm.carry(mass)
    device.arm.reset((0.0, 0.05, 0.05, 0.05))
    steps = [{"move": list(POSE), "over": MOVE}, *(after or ({"hold": 20.0},))]
    limits = Limits(JOINTS, max_effort=SETTINGS.max_effort, sign_check_torque=0.0)
    compensator = Balance(SETTINGS, at=HELD)
    trial = OfflineTrial(
        ArmSetup("right", device, joints_of((MIT,) * 4), limits, SETTINGS, RATE, None),
        TrialScript.parse({"name": "weigh", "steps": steps}), 2.0, compensator,
    )  # fmt: skip
    recording = trial.run()
    return compensator.weighing, trial.trouble, recording.velocity


def test_a_load_of_1_kg_is_weighed_and_the_arm_stays_calm():
    weighing, trouble, speed = weigh(1.0)
    assert trouble == ""
    assert weighing.result is not None, weighing.text
    assert weighing.result.mass == pytest.approx(1.0, abs=0.03)
    assert weighing.text.endswith(
        f"kg more than the settings carry: payload.mass = {weighing.result.mass:.3f} carries it"
    )
    assert weighing.empty is None
    assert np.abs(speed).max() < 2.0


@pytest.mark.thorough
def test_a_wearer_who_helps_with_one_joint_is_refused():
    push = {"push": [0.0, 0.0, 2.5, 0.0], "over": 60.0}  # half a sine wave: nearly constant while the arm is weighed
    weighing, _, _ = weigh(0.5, {"hold": 0.1}, push)
    assert weighing.result is None
    assert ": no load in the hand explains " in weighing.trouble or "two turns" in weighing.trouble


def test_little_pushes_against_a_hand_that_moves_the_arm_and_not_for_long():
    weighing, largest = Weighing(SETTINGS, JOINTS, RATE), 0.0
    weighing.torque(0.01, POSE, STILL, TILT, STILL)
    for _ in range(1000):
        held = weighing.torque(0.01, (0.0, 0.5, 0.0, 0.8), STILL, TILT, STILL)
        largest = max(largest, abs(held[1]))
    assert "shoulder_abduction" in weighing.trouble and "a hand on the arm" in weighing.trouble
    assert largest < 9.0 and held == STILL  # Nm, what 5 kg and 2 Nm more need; the motor has 18


def test_a_hanging_or_moving_arm_is_refused_with_what_would_be_right():
    for theta, velocity, reason in (
        (HANGING, STILL, "bend the elbow to a right angle"),
        (POSE, (0.0, 0.0, 0.5, 0.0), "the arm moves at 0.50 rad/s: hold it still"),
    ):
        weighing = Weighing(SETTINGS, JOINTS, RATE)
        assert weighing.torque(0.01, theta, velocity, TILT, STILL) == STILL
        assert reason in weighing.trouble and weighing.text.startswith("not weighed: ")


def test_what_would_hide_the_load_is_refused_before_anything_moves():
    assert refusal(SETTINGS, ("friction", "inertia"), RATE) == ""
    assert "spring would carry a part" in refusal(SETTINGS, ("friction", "spring"), RATE)
    assert "support 1" in refusal(replace(SETTINGS, support=0.9), (), RATE)
    assert "zero_g" in refusal(replace(SETTINGS, mode="one_g"), (), RATE)
    assert refusal(replace(SETTINGS, mode="one_g", wearer_mass=STILL), (), RATE) == ""
    assert "50 Hz, must be 80 or more" in refusal(SETTINGS, (), 50.0)
    assert Weighing(SETTINGS, JOINTS, 0.0).phase is WeighingPhase.TAKING_OVER  # made before the rate is known,
    assert "0 Hz" in refusal(SETTINGS, (), 0.0)  # and refused


def test_an_arm_that_is_not_carried_or_is_held_has_no_result():
    weighing = Weighing(SETTINGS, JOINTS, RATE)
    for _ in range(3000):
        weighing.torque(0.01, POSE, STILL, TILT, STILL)
    assert weighing.result is None
    assert "does not follow" in weighing.trouble or "a hand on the arm" in weighing.trouble


def test_a_load_that_falls_while_it_is_weighed_is_seen_by_the_arm_that_rises():
    weighing = Weighing(SETTINGS, JOINTS, RATE)
    weighing.torque(0.01, POSE, STILL, TILT, STILL)
    weighing.torque(0.01, (0.0, 0.2, 0.0, 1.3), STILL, TILT, STILL)
    assert "was the load dropped?" in weighing.trouble


def lever(theta: Sequence[float]) -> np.ndarray:
    """Return the torques (4,) of 1 kg in the hand."""
    return np.array(exact_torque(SETTINGS.unit_load, theta, TILT))


def test_with_the_empty_hand_weighed_before_the_error_of_the_model_is_left_out():
    first = Weighing(SETTINGS, JOINTS, RATE)
    first.torque(0.01, POSE, STILL, TILT, STILL)
    first.result = Weighed(0.06, 0.004, lever(POSE))
    assert first.text.endswith(": the hand is empty")
    second = Weighing(SETTINGS, JOINTS, RATE, first.empty)
    second.torque(0.01, POSE, STILL, TILT, STILL)
    second.result = Weighed(1.05, 0.004, lever(POSE))
    assert "1.050 +- " in second.text and "; 0.990 +- " in second.text
    assert second.text.endswith(": payload.mass = 0.990 carries it")
    assert second.empty is first.result  # 1.05 kg is no empty hand
    elsewhere = Weighing(SETTINGS, JOINTS, RATE, first.empty)
    elsewhere.torque(0.01, ELSEWHERE, STILL, TILT, STILL)
    elsewhere.result = Weighed(1.05, 0.004, lever(ELSEWHERE))
    assert "empty" not in elsewhere.text
