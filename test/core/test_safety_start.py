# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The start of the safety machine: the checks before torque flows, the ramp, and what is trusted from then on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest

from exo_gravity.core.safety.drive import Fault, FaultCode, Send, State
from exo_gravity.core.safety.gate import SWITCH_ON, SignCheck
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE

from ..support.safety_run import EFFORT, LIMITS, PERIOD, SafetyRun, reading
from ..support.simulated_device import OFF


def test_a_new_machine_keeps_the_motors_off_and_torque_begins_slowly_and_without_a_step():
    arm = SafetyRun().cycle(1.0)
    assert arm.machine.state is State.DISABLED
    assert arm.drive == OFF
    arm.enable()
    arm.cycle(1.65)
    assert arm.machine.state is State.RAMPING_IN
    assert arm.drive.effort[1] == pytest.approx(-2.0, abs=0.15)
    arm.cycle(1.0)
    assert arm.drive.effort == pytest.approx(EFFORT)
    assert max(arm.steps) <= MAX_EFFORT_RATE * PERIOD * 1.0001


@pytest.mark.parametrize(
    ("spoil", "waits_for"),
    [
        (lambda arm: arm.silent.add(2), "c: no reply"),
        (lambda arm: arm.changes[1].update(velocity=0.15), "at rest"),
        (lambda arm: setattr(arm.machine, "hindrance", "the watchdog to start"), "the watchdog to start"),
        (lambda arm: setattr(arm, "effort", None), "effort commands"),
        (lambda arm: setattr(arm, "effort_age", 0.06), "effort commands"),
        (lambda arm: arm.changes[2].update(position=2.6), "c to be moved by -5.8 degrees, within its limits -46"),
    ],
)
def test_the_checks_wait_and_name_what_they_wait_for(spoil, waits_for):
    arm = SafetyRun()
    spoil(arm)
    arm.enable()
    arm.cycle(2.0)
    assert arm.machine.state is State.CHECKING
    assert waits_for in arm.machine.waiting_for
    assert not arm.drive.powered


def test_the_checks_require_a_whole_second_without_trouble():
    arm = SafetyRun()
    arm.enable()
    for _ in range(5):
        arm.cycle(0.9)
        arm.silent.add(1)
        arm.cycle(0.1)
        arm.silent.clear()
    assert arm.machine.state is State.CHECKING


def test_efforts_may_be_late_for_a_moment_in_the_checks_as_while_the_arm_is_carried():
    arm = SafetyRun().enable()
    for _ in range(6):
        arm.effort_age = 0.06
        arm.cycle(0.02)
        arm.effort_age = 0.002
        arm.cycle(0.23)
    assert arm.machine.state is not State.CHECKING


@pytest.mark.parametrize("stall", [0.004, 0.09, 0.2, 2.0])
def test_a_turn_that_an_encoder_loses_while_the_loop_stands_still_in_the_proof_is_a_fault(stall):
    arm = SafetyRun().enable().until(State.PROVING).cycle(0.05)
    arm.now += stall
    arm.changes[1].update(position=math.radians(40.0))
    arm.cycle(0.1)
    assert arm.fault_code == "position_jump"
    arm.until_off()


@pytest.mark.parametrize(("change", "code"), [({"error": 5}, "motor_error"), ({"temperature": 95}, "over_temperature")])
def test_a_fault_during_the_checks_is_latched(change, code):
    arm = SafetyRun()
    arm.changes[2].update(change)
    arm.enable()
    arm.cycle(1.0)
    assert arm.machine.state is State.FAULT
    assert arm.fault_code == code
    assert "c:" in arm.machine.fault.reason


def test_an_arm_away_from_home_is_refused_until_it_has_been_carried_once():
    arm = SafetyRun()
    arm.changes[1].update(position=math.radians(40.0))  # a turn of an AK80-9's motor
    arm.enable()
    arm.cycle(1.0)
    assert arm.fault_code == "implausible_zero"
    assert "b: 0.698 rad at the start" in arm.machine.fault.reason

    arm = SafetyRun().until_active()
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    for step in range(31):  # moved by hand
        arm.changes[1].update(position=0.02 * step, velocity=1.0)
        arm.cycle(0.02)
    arm.changes[1].update(velocity=0.0)
    arm.enable()
    arm.until(State.ACTIVE)

    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.silent.add(2)  # its supply was interrupted, and its zero may have changed
    arm.cycle(0.4)
    arm.silent.clear()
    arm.enable()
    arm.cycle(1.0)
    assert arm.fault_code == "implausible_zero"


class YieldingArm(SafetyRun):
    """An arm whose joints yield to torque: by `mobility` (4,) rad/s per Nm beyond 0.45 Nm of friction.

    parallel: joints (0..) whose angles add up to the one by which the last of them is asked to lift; () for none.
    largest_effort: Nm of each joint so far.
    """

    def __init__(self, mobility: Sequence[float], parallel: Sequence[int] = ()) -> None:
        super().__init__(sign_check_torque=1.5)
        self.mobility, self.parallel = mobility, parallel
        self.position = [0.0] * 4
        self.largest_effort = [0.0] * 4

    def cycle(self, seconds: float = PERIOD) -> YieldingArm:
        for _ in range(max(1, round(seconds / PERIOD))):
            for i, (effort, mobility) in enumerate(zip(self.drive.effort, self.mobility, strict=True)):
                self.largest_effort[i] = max(self.largest_effort[i], effort)
                excess = effort - max(-0.45, min(0.45, effort))
                self.position[i] += excess * mobility * PERIOD
                self.changes[i] = {"position": self.position[i]}
            if self.parallel:
                asked = [0.0] * 4
                asked[self.parallel[-1]] = 3.6 * sum(self.position[i] for i in self.parallel)
                self.effort = asked
            super().cycle()
        return self


def test_each_joints_sign_is_checked_once_and_gently_before_the_arm_is_carried():
    arm = YieldingArm((0.5, 0.2, 0.5, 0.5))
    arm.effort = (0.0,) * 4
    arm.enable()
    arm.cycle(1.5)
    assert arm.machine.state is State.PROVING
    arm.until(State.ACTIVE, limit=16.0)
    assert all(-0.05 < position < 0.06 for position in arm.position)
    assert max(arm.steps) <= MAX_EFFORT_RATE * PERIOD * 1.0001
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.largest_effort = [0.0] * 4
    arm.enable()
    arm.until(State.ACTIVE)
    assert arm.largest_effort == [SWITCH_ON.torque] * 4  # the check that the motors are on


@pytest.mark.parametrize(("mobility", "code"), [(-0.5, "wrong_sign"), (0.0, "sign_unproven")])
def test_a_joint_that_moves_backwards_or_not_at_all_under_the_test_torque_is_refused(mobility, code):
    arm = YieldingArm((0.5, 0.2, mobility, 0.5))
    arm.enable()
    arm.cycle(20.0)
    assert arm.machine.state is State.FAULT
    assert arm.fault_code == code
    assert arm.machine.fault.reason.startswith("c: ")
    assert arm.largest_effort[3] == 0.0


@pytest.mark.parametrize(
    ("mobility", "parallel", "code"),
    [
        ((0.5, 0.2, 0.2, 0.5), (2, 3), None),
        ((0.5, 0.2, 0.5, 0.2), (2, 3), "joints_exchanged"),
        ((0.5, 0.2, 0.5, 0.2), (3,), None),  # gravity turns the last joint alone: no axis is parallel to its own
        ((0.5, 0.2, 0.5, 0.2), (), None),
    ],
)
def test_of_two_parallel_joints_the_one_nearer_to_the_base_must_be_the_slower_one(mobility, parallel, code):
    arm = YieldingArm(mobility, parallel)
    arm.effort = (0.0,) * 4
    arm.enable()
    while arm.machine.state in (State.CHECKING, State.PROVING):
        arm.cycle()
    assert arm.fault_code == code
    assert code is None or arm.machine.fault.reason.startswith("c moved sooner than d, which it carries: ")


def test_efforts_that_are_nan_while_signs_are_proven_compare_no_joints_and_are_refused_before_they_are_applied():
    arm = YieldingArm((0.5, 0.2, 0.5, 0.2))
    arm.effort = (math.nan,) * 4
    arm.enable()
    while arm.machine.state in (State.CHECKING, State.PROVING):
        arm.cycle()
    assert arm.fault_code == "command_impossible"
    assert max(map(abs, arm.drive.effort)) < 0.1


@pytest.mark.parametrize("code", ["", "position_jump", "motor_error", "outside_limits", "torque_not_delivered"])
def test_after_a_fault_that_may_have_moved_them_or_a_jump_while_the_arm_is_off_zeros_are_checked_again(code):
    arm = SafetyRun().until_active()
    if code:
        arm.machine.trip(FaultCode(code), "test", arm.now)
        arm.cycle(10.0)
        assert arm.machine.clear(arm.now)
    else:
        arm.machine.disable(arm.now)
        arm.cycle(8.0)
    arm.changes[1].update(position=math.radians(40.0))  # one turn of an AK80-9's motor
    arm.cycle(2 * PERIOD)
    arm.enable().cycle(1.0)
    assert arm.fault_code == "implausible_zero"


def test_a_motor_that_is_found_off_is_switched_on_again_once_with_damping_and_without_torque():
    arm = SafetyRun().until_active()
    arm.off.add(1)
    since = arm.now
    while Send.ENTER not in arm.drive.send:
        arm.cycle()
    assert arm.now - since <= 0.06
    assert arm.drive.send == (Send.COMMAND, Send.ENTER, Send.COMMAND, Send.COMMAND)
    assert arm.fault_code == "torque_not_delivered"
    assert "b: -4.00 Nm commanded" in arm.machine.fault.reason
    assert abs(arm.drive.effort[1]) < 0.1
    arm.changes[1] = {"velocity": 1.0}  # it sinks
    arm.cycle(0.3)
    assert arm.drive.damping[1] > 3.0 and arm.drive.effort[1] < -3.0
    arm.off.add(1)
    sent = [arm.cycle().drive.send[1] for _ in range(500)]
    assert Send.ENTER not in sent


def test_a_motor_with_an_error_is_not_switched_on_again():
    arm = SafetyRun().until_active()
    arm.off.add(1)
    arm.changes[1] = {"error": 5}
    sent = [arm.cycle().drive.send[1] for _ in range(2500)]
    assert Send.ENTER not in sent
    assert arm.fault_code == "motor_error"


def test_a_start_is_refused_in_time_while_a_motor_is_not_off_whose_error_is_to_be_cleared():
    arm = SafetyRun().until_active()
    arm.silent.add(1)
    arm.cycle(30.0)
    assert arm.machine.state is State.FAULT and arm.machine.clear(arm.now)
    arm.enable()
    arm.cycle(LIMITS.enable_timeout + 1.0)
    assert arm.machine.state is State.DISABLED and arm.machine.refusal


def test_a_motor_that_does_not_switch_on_is_refused_at_every_start():
    arm = SafetyRun().until_active()
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.changes[3].update(effort=0.02)
    arm.enable().cycle(1.6)
    assert arm.fault_code == "torque_not_delivered"
    assert "d: the motor did not switch on: 0 % of the commanded torque replied" in arm.machine.fault.reason
    assert "in servo mode" in arm.machine.fault.reason


def test_a_motor_that_missed_its_enter_gets_another_one():
    arm = SafetyRun()
    arm.off.update((0, 3))
    arm.enable().cycle(1.2)
    assert not arm.off
    arm.until(State.ACTIVE)


class Joint:
    """The first joint alone: it yields at 0.2 rad/s per Nm beyond `friction`, and to a `hand`: rad/s at a time in s."""

    def __init__(self, hand: Callable[[float], float], friction: float) -> None:
        self.check = SignCheck(("a", "b", "c", "d"), (1.5, 0.0, 0.0, 0.0))
        self.pushes: list[float] = []
        self._hand = hand
        self._friction = friction
        self._position = self._now = 0.0

    def run(self, seconds: float) -> Fault | None:
        """Run the check for `seconds` or until it ends; return its fault."""
        for _ in range(round(seconds / PERIOD)):
            effort = self.check.effort[0]
            self.pushes.append(effort)
            yielding = effort - max(-self._friction, min(self._friction, effort))
            velocity = 0.2 * yielding + self._hand(self._now)
            self._position += velocity * PERIOD
            self._now += PERIOD
            sample = reading(position=self._position, velocity=velocity, effort=effort, time=self._now)
            fault = self.check.step(PERIOD, (sample,) * 4, (0.0,) * 4)
            if fault or self.check.done:
                return fault
        return None


HANDS = {  # joint speed (rad/s) over time (s), friction (Nm), and the message to the wearer
    "moves it before it is pushed": (lambda now: 0.5 if 0.2 < now < 0.3 else 0.0, 10.0, ""),
    "keeps moving it": (lambda now: 1.0 if now % 0.5 > 0.25 else 0.0, 10.0, "hold still"),
    "shakes it": (lambda now: (0.2 if now % 0.04 < 0.02 else -0.2) if now > 0.3 else 0.0, 0.3, ""),
    "drags it up": (lambda now: 0.04 if now > 0.4 else 0.0, 10.0, ""),
    "drags it down": (lambda now: -0.04 if now > 0.4 else 0.0, 10.0, ""),
}


@pytest.mark.parametrize(("hand", "friction", "told"), HANDS.values(), ids=HANDS)
def test_a_hand_that_moves_a_joint_proves_no_sign_and_the_joint_is_not_pushed_on_and_on(hand, friction, told):
    joint = Joint(hand, friction)
    fault = joint.run(60.0)
    assert not joint.check.done
    assert fault is not None and fault.code in ("sign_unproven", "wrong_sign") and told in fault.reason
    assert max(map(abs, joint.pushes)) < friction
