# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Trust in zeros and signs ends with the continuity of the angles, whichever fault wins, and not before."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.safety.trust import Readings
from exo_gravity.core.vocabulary import NO_REASON, Reason, Wait

from ..support.safety_run import LIMITS, SafetyRun, reading
from ..support.thorough import quick

SPEC = MOTORS["AK80-9"]
CODE = 2.0 * SPEC.velocity_range / 4095.0  # rad/s of the velocity on the wire
TURN = math.radians(40.0)  # of its rotor, at the joint
STEP = 0.001  # s


@dataclass(frozen=True)
class Motor:
    """The second motor of an arm. lag: s by which its velocity follows. scale: of the velocity that it replies."""

    lag: float = 0.02
    scale: float = 1.0
    creep: float = 0.0  #: rad/s by which its encoder slips
    frozen: bool = False  #: its angle


class Motion:
    """Follows a joint at `angle(time)` rad through replies as ordinary equipment delivers them, at `rate` Hz.

    slip: rad, of the encoder. lost_trust: s, when; inf for never. faults: codes found.
    """

    def __init__(self, angle: Callable[[float], float], motor: Motor, rate: float, is_busy: bool) -> None:
        self.readings = Readings(LIMITS)
        self.slip = 0.0
        self.faults: set[FaultCode] = set()
        self._angle, self._motor, self._period, self._is_busy = angle, motor, 1.0 / rate, is_busy
        self._random = random.Random(7)
        self._velocity, self._seen = 0.0, angle(0.0)
        self.now = 0.0
        self._joints = [reading(time=0.0, position=angle(0.0))] * 4
        for _ in range(2):
            self._cycle()
        self.readings.prove()

    def run(self, seconds: float) -> Motion:
        end = self.now + seconds
        while self.now < end:
            self._cycle()
        return self

    def _cycle(self) -> None:
        late = 0.02 if self._is_busy and self._random.random() < 0.1 else 0.0
        self._pass(self._period)
        if not (self._is_busy and self._random.random() > 0.97**2):
            position = 0.0 if self._motor.frozen else self._angle(self.now) + self.slip
            position += self._motor.creep * self.now
            velocity = (math.floor(self._motor.scale * self._velocity / CODE) + 0.5) * CODE
            self._pass(late)  # the loop stands still before it takes the reply
            given = reading(time=self.now, position=position, velocity=velocity)
            self._joints = [given if n == 1 else reading(time=self.now) for n in range(4)]
        self.readings.step(self.now, self._joints, (False,) * 4)
        if self.readings.fault:
            self.faults.add(self.readings.fault.code)

    def _pass(self, seconds: float) -> None:
        """Let time pass for the motor, which measures its velocity by its encoder."""
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            angle = self._angle(self.now) + self.slip
            measured = (angle - self._seen) / STEP
            self._velocity += (measured - self._velocity) * (1.0 - math.exp(-STEP / max(1e-6, self._motor.lag)))
            self._velocity = max(-SPEC.velocity_range, min(SPEC.velocity_range, self._velocity))
            self._seen = angle


def knocked(now: float) -> float:
    """Twice a second a knock of 5 rad/s, there and back, within 30 ms."""
    return 0.02 * 4.9 * max(0.0, 1.0 - abs(now % 0.5 - 0.05) / 0.02)


def reaching(now: float) -> float:
    """Reaches to and fro, at up to 4.4 rad/s: with the largest wrong `velocity_range`, 4.9 by the velocity."""
    return 1.0 - 0.8 * math.cos(5.5 * now)


def resting(now: float) -> float:
    return 0.3


SCALES, ANGLES, RATES = (1.0, 0.9, 50.0 / 45.0), (knocked, reaching, resting), (100.0, 250.0, 500.0)
QUICK = [(0.9, knocked, 100.0), (1.0, reaching, 250.0), (50.0 / 45.0, knocked, 500.0), (1.0, resting, 100.0)]


@pytest.mark.parametrize(("scale", "angle", "rate"), quick(QUICK, itertools.product(SCALES, ANGLES, RATES)))
def test_ordinary_equipment_keeps_trust_while_a_wearer_reaches_and_the_arm_is_knocked(rate, angle, scale):
    motion = Motion(angle, Motor(scale=scale), rate, is_busy=True).run(20.0)
    assert motion.readings.trusted
    assert not motion.faults


WRONG = {
    "a velocity_range 2.2 times too large": Motor(scale=2.2),
    "2.2 times too small": Motor(scale=1 / 2.2),
    "a velocity of the wrong sign": Motor(scale=-1.0),
    "an angle that is frozen": Motor(frozen=True),
}


@pytest.mark.parametrize("motor", WRONG.values(), ids=WRONG)
def test_an_angle_and_a_velocity_that_contradict_each_other_are_found_within_one_reach(motor):
    motion = Motion(lambda now: 1.0 - math.cos(min(math.pi, 2.0 * now)), motor, 100.0, is_busy=True).run(1.5)
    assert not motion.readings.trusted
    assert motion.faults == {FaultCode.READINGS_CONTRADICT}


def test_a_slow_slip_is_found_before_it_matters():
    motion = Motion(resting, Motor(creep=0.2), 100.0, is_busy=True).run(3.0)
    assert not motion.readings.trusted


@pytest.mark.parametrize("lag", [0.0, 0.02], ids=["at once", "filtered"])
@pytest.mark.parametrize("rate", [100.0, 500.0])
def test_a_lost_turn_ends_trust_whatever_the_velocity_shows(lag, rate):
    motion = Motion(resting, Motor(lag=lag), rate, is_busy=False).run(0.5)
    motion.slip = TURN
    motion.run(0.2)
    assert not motion.readings.trusted
    assert motion.faults <= {FaultCode.POSITION_JUMP, FaultCode.OVER_SPEED}


@pytest.mark.parametrize("code", [FaultCode.OVER_TEMPERATURE, FaultCode.OUTSIDE_LIMITS])
def test_a_jump_ends_trust_although_another_fault_wins(code):
    change = {"temperature": 90} if code is FaultCode.OVER_TEMPERATURE else {}
    arm = SafetyRun().until_active()
    arm.changes[1] = {"position": 0.7, **change} if change else {"position": 3.3}
    arm.cycle(0.02)
    assert arm.machine.state is State.LETTING_DOWN
    arm.machine.clear(arm.now)
    assert not arm.machine._readings.trusted


def test_after_a_slip_with_a_filtered_velocity_the_arm_is_not_carried_again_from_wrong_angles():
    """Issue 42: over_speed hid position_jump; clear and enable carried the arm 40 degrees wrong."""
    arm = SafetyRun().until_active()
    for step in range(25):  # the velocity follows the slip within 20 ms
        arm.changes[1] = {"position": TURN, "velocity": TURN / 0.02 * math.exp(-step * 0.004 / 0.02)}
        arm.cycle()
    arm.changes[1] = {"position": TURN}
    assert arm.fault_code in ("over_speed", "position_jump")
    arm.until(State.FAULT).machine.clear(arm.now)
    arm.enable().cycle(1.5)
    assert (arm.machine.state, arm.fault_code) == (State.FAULT, "implausible_zero")


def test_a_restart_of_the_motors_after_an_emergency_stop_asks_the_operator_again():
    arm = SafetyRun(start_pose="confirm")
    arm.enable().cycle(1.0)
    assert arm.machine.confirm_pose(arm.now) == ""
    arm.until_active()
    arm.silent = {0, 1, 2, 3}
    arm.cycle(0.5)
    arm.off, arm.silent = {0, 1, 2, 3}, set()
    arm.changes[3] = {"position": 0.4}  # in the lap, off by a turn of its rotor: within the gate's tolerance
    arm.until(State.FAULT).machine.clear(arm.now)
    arm.enable().cycle(5.0)
    assert arm.machine.state is State.CHECKING
    assert "the operator to confirm the pose" in arm.machine.waiting_for
    assert "d 23" in arm.machine.pose.text


def test_a_hanging_arm_for_which_much_torque_is_asked_is_refused_at_an_untrusted_start_only():
    arm = SafetyRun()
    arm.while_hanging = (0.0, 3.8, 0.0, 0.0)  # of the robot alone, by an IMU that is mounted 90 degrees otherwise
    arm.enable().cycle(3.0)
    assert (arm.machine.state, arm.fault_code) == (State.FAULT, "torque_while_hanging")
    arm.while_hanging = (0.0, 1.0, 0.0, 0.0)
    arm.machine.clear(arm.now)
    arm.until_active()


@pytest.mark.parametrize(("moved", "waited"), [(0.1, 0.0), (0.0, 11.0)], ids=["the arm moves", "time passes"])
def test_a_confirmation_lapses_and_is_asked_for_again(moved, waited):
    arm = SafetyRun(start_pose="confirm")
    assert arm.machine.confirm_pose(arm.now).startswith("nothing to confirm: the arm is disabled")
    arm.enable().cycle(0.5)
    assert arm.machine.pose.asked
    assert arm.machine.confirm_pose(arm.now) == "" and not arm.machine.pose.asked
    arm.machine.hindrance = Reason(Wait.WATCHDOG, "the watchdog to start") if waited else NO_REASON
    arm.changes[3] = {"position": moved, "velocity": 0.0}
    arm.cycle(max(0.02, waited))
    arm.machine.hindrance = NO_REASON
    arm.cycle(2.0)
    assert arm.machine.state is State.CHECKING and arm.machine.pose.asked
