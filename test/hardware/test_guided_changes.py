# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Live changes of load, with a person's arm in the device: judged by the true motion of the joints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest

from exo_gravity.core import ArmModel
from exo_gravity.core.compensation.terms.catalogue import Spring
from exo_gravity.core.compensation.terms.terms import TermSettings
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.sim.arm import DEFAULT_LINKS
from exo_gravity.sim.virtual_time import TICK

from ..support.thorough import quick
from .compensated_arm import CYCLE, PEAK, compensated_arm

SAFE_SPEED = 0.65  # rad/s, at which an arm without friction sinks under the damping of the motors
CODE = 0.009  # Nm, of a torque of the AK80-9 on the wire
RAISED, UPRIGHT = (0.0, 1.2, 0.3, 0.3), (0.0, 2.4, 0.3, 0.3)
ONE_G, NO_WEARER = {"mode": "one_g"}, {"mode": "one_g", "has_wearer": False}
SPRING = {"terms": TermSettings(spring=Spring((4.0, 14.0, 7.0, 3.9), (0.0, 0.0, -0.3, 1.3)))}
CLAMPED = {"max_effort": (0.5,) * 4}
HALVED = {"robot": ArmModel(DEFAULT_LINKS.length, DEFAULT_LINKS.cog, DEFAULT_LINKS.mass, (0.5,) * 4)}

guided_arm = partial(compensated_arm, rate=0.5 / CYCLE)
# An arm, what changes, and whether its end is the hanging arm.
CHANGES = {
    # Without friction the damping alone holds it: at half the rate it sinks at 0.85 rad/s.
    "Zero-G to One-G, above the shoulder": (
        {"limit": PEAK, "pose": UPRIGHT, "friction": 0.01, "rate": 1.0 / CYCLE},
        ONE_G,
        True,
    ),
    "max_effort 18 to 0.5, raised": ({"limit": PEAK, "pose": RAISED}, CLAMPED, True),
    "a spring without a wearer": (NO_WEARER, SPRING, False),
    "gain": ({"limit": PEAK, "pose": RAISED}, HALVED, True),
}
# Of those, in which an arm whose motors do not damp comes near to SAFE_SPEED.
FASTEST = ("gain",)
QUICK = [("gain", True), ("gain", False)]


@pytest.mark.parametrize(
    ("name", "is_damped"), quick(QUICK, [*((name, True) for name in CHANGES), *((name, False) for name in FASTEST)])
)
def test_no_change_of_load_drops_or_throws_a_passive_arm(name, is_damped):
    rig, change, hangs = CHANGES[name]
    arm = guided_arm(**rig)
    arm.is_damped = is_damped
    arm.change(**change)
    arm.run(4.0)
    for _ in range(20):
        if hangs and arm.answer.remainder:
            arm.run(0.5)
    assert arm.top_speed < SAFE_SPEED
    assert arm.safety.state is State.ACTIVE, arm.safety.fault
    if hangs:
        arm.run(1.0)  # without friction it swings on, more slowly than a change is guided
        assert max(map(abs, arm.device.arm.velocities)) < GUIDANCE.calm + 0.03
        assert abs(arm.device.arm.positions[1]) < 0.1
        assert arm.answer.remainder == ()


def test_changes_during_changes_are_as_calm_as_one():
    arm = guided_arm(pose=RAISED, limit=PEAK)
    back = {"mode": "zero_g", "max_effort": PEAK}
    for change in (ONE_G, back, ONE_G, CLAMPED, {"support": 0.3}, back, SPRING, ONE_G):
        arm.change(**change)
        arm.run(0.7)
    for support in np.linspace(1.0, 0.0, 20):
        arm.change(mode="zero_g", support=float(support))
        arm.run(0.1)
    arm.run_until(lambda: arm.answer.remainder == (), 9.0)
    assert arm.top_speed < SAFE_SPEED
    assert arm.safety.state is State.ACTIVE
    assert arm.answer.remainder == ()


class Leading:
    """A hand that leads joints 2 and 4 to and fro at up to `speed` rad/s, 0 to hold them. torques: (n, 4) Nm so far."""

    def __init__(self, start: Sequence[float], speed: float) -> None:
        self.torques: list[np.ndarray] = []
        self._start, self._speed = np.array(start), speed
        self._weight = np.zeros(4)
        self._begin: float | None = None

    def __call__(self, now: float, theta: Sequence[float], velocity: Sequence[float]) -> Sequence[float]:
        self._begin = now if self._begin is None else self._begin
        pace, moving = 2.5, np.array((0.0, 1.0, 0.0, 1.0))
        phase = pace * (now - self._begin)
        error = self._start + moving * self._speed / pace * np.sin(phase) - theta
        self._weight += np.array((120.0, 160.0, 150.0, 80.0)) * error * 0.001
        damping = np.array((3.0, 6.0, 5.0, 2.0)) * (moving * self._speed * np.cos(phase) - velocity)
        self.torques.append(np.array((60.0, 80.0, 60.0, 30.0)) * error + damping + self._weight)
        return self.torques[-1].tolist()


def test_a_wearer_who_holds_still_feels_the_new_load_come_slowly_and_nothing_else():
    arm = guided_arm()
    arm.person.hand = Leading(arm.device.arm.positions, 0.0)
    arm.run(1.0)
    arm.torques.clear()
    arm.change(**ONE_G)
    arm.run(4.5)
    assert arm.answer.remainder == ()
    of_tenth = np.array(arm.torques)[:: round(0.1 / TICK)]
    assert np.abs(np.diff(of_tenth, axis=0)).max() < 0.1 * GUIDANCE.rate + 2 * CODE
    assert arm.top_speed < 0.1


def test_a_wearer_who_moves_on_is_not_stopped():
    felt, speed = {}, 1.0
    for is_damped in (True, False):
        arm = guided_arm()
        arm.is_damped = is_damped
        arm.person.hand = hand = Leading(arm.device.arm.positions, speed)
        arm.run(1.0)
        hand.torques.clear()
        arm.top_speed = 0.0
        arm.change(**ONE_G)
        arm.run(3.5)
        assert arm.safety.state is State.ACTIVE
        assert arm.top_speed < 1.3 * speed + 0.1
        felt[is_damped] = np.array(hand.torques)
    length = min(map(len, felt.values()))
    assert np.abs(felt[True][:length] - felt[False][:length]).max() < GUIDANCE.brake + 1.0  # Nm that damping costs
