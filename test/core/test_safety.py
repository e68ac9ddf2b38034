# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Faults of a carried arm in the safety machine, and what holds under random sequences of events."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.safety.descent import DESCENT
from exo_gravity.core.safety.drive import CARRYING, Fault, FaultCode, Send, State
from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.safety.limits import DAMPING, MAX_EFFORT_RATE
from exo_gravity.core.safety.monitors import RIDE

from ..support.safety_run import EFFORT, LIMITS, PERIOD, SafetyRun
from ..support.simulated_device import OFF

FAULTS = [
    (lambda arm: arm.silent.add(3), "motor_silent"),
    (lambda arm: arm.changes[0].update(error=2), "motor_error"),
    (lambda arm: arm.changes[0].update(temperature=81), "over_temperature"),
    (lambda arm: arm.changes[1].update(velocity=5.2), "over_speed"),
    (lambda arm: arm.off.add(1), "torque_not_delivered"),
    (lambda arm: arm.changes[1].update(position=0.2), "position_jump"),
    (lambda arm: setattr(arm, "effort_age", 0.051), "command_stale"),
    (lambda arm: setattr(arm, "effort", None), "command_withdrawn"),
    (lambda arm: setattr(arm, "effort", (0.0, math.nan, 0.0, 0.0)), "command_impossible"),
    (lambda arm: setattr(arm, "effort", (0.0, 1e308, 0.0, 0.0)), "command_impossible"),
    (lambda arm: arm.machine.trip(FaultCode.BUS_ERROR, "unplugged", arm.now), "bus_error"),
]


@pytest.mark.parametrize(("spoil", "code"), FAULTS, ids=[code for _, code in FAULTS])
def test_after_a_fault_the_arm_is_let_down_gently_and_the_fault_stays_latched(spoil, code):
    arm = SafetyRun().until_active()
    arm.steps.clear()
    spoil(arm)
    arm.cycle(0.15)
    assert arm.machine.state is State.LETTING_DOWN
    assert arm.fault_code == code
    assert arm.drive.powered
    assert all(damping > 0.0 for damping in arm.drive.damping) or code == "motor_silent"
    arm.silent.clear()
    arm.changes = [{} for _ in range(4)]
    arm.effort, arm.effort_age = EFFORT, 0.002
    arm.until(State.FAULT, 20.0).until_off()
    assert max(arm.steps) <= MAX_EFFORT_RATE * PERIOD * 1.0001
    arm.cycle(1.0)
    assert arm.machine.state is State.FAULT


def test_the_motors_are_switched_off_once_nothing_holds_the_arm_and_it_rests():
    arm = SafetyRun().until_active()
    arm.machine.disable(arm.now)
    for step in range(1500):  # creeps for 6 s at 0.02 rad/s, less than the velocity's resolution
        arm.changes[2].update(position=-0.02 * PERIOD * step)
        arm.cycle()
        assert arm.drive.powered
    assert arm.drive.effort == arm.drive.damping == OFF.effort
    arm.cycle(2.1)
    assert arm.machine.state is State.DISABLED
    arm.until_off()


def test_a_silent_motor_is_damped_and_faded_and_lowered_from_what_it_applies_when_it_replies_again():
    arm = SafetyRun().until_active()
    arm.silent.add(1)
    arm.cycle(0.5)
    assert arm.machine.state is State.LETTING_DOWN
    assert arm.drive.damping[1] == DAMPING and arm.drive.effort[1] == -4.0
    arm.cycle(5.0)
    assert arm.drive.damping[1] == DAMPING and -3.0 < arm.drive.effort[1] < -2.0
    arm.cycle(12.0)
    assert arm.machine.state is State.FAULT
    assert arm.machine.is_unreached
    assert arm.drive.powered and arm.drive.send[1] is Send.COMMAND and arm.drive.effort == (0.0,) * 4
    arm.silent.clear()
    arm.cycle(0.05)
    assert arm.machine.state is State.LETTING_DOWN
    arm.until(State.FAULT, 20.0).until_off()
    assert arm.fault_code == "motor_silent"


def test_a_motor_that_lost_its_power_while_silent_is_not_pushed_when_it_replies_again():
    arm = SafetyRun().until_active()
    arm.silent.add(1)
    arm.cycle(1.0)
    arm.silent.clear()
    arm.applied[1] = 0.0
    arm.steps.clear()
    arm.cycle(1.0)
    assert max(abs(effort) for effort in (arm.applied[1], arm.drive.effort[1])) < 0.01


def test_only_the_operator_clears_a_fault_and_clearing_enables_nothing():
    arm = SafetyRun().until_active()
    arm.machine.trip(FaultCode.BUS_ERROR, "unplugged", arm.now)
    arm.cycle(8.0)
    assert not arm.machine.enable(arm.now)
    assert arm.machine.clear(arm.now)
    arm.cycle(5.0)
    assert arm.machine.state is State.DISABLED
    assert arm.machine.enable(arm.now)


def test_a_fault_with_a_later_time_than_the_next_cycle_does_no_harm():
    arm = SafetyRun().until_active()
    arm.machine.trip(FaultCode.BUS_ERROR, "late", arm.now + 10 * PERIOD)
    arm.cycle()
    assert max(arm.drive.damping) == 0.0
    assert arm.drive.effort == pytest.approx(EFFORT)


def test_the_first_fault_stays():
    arm = SafetyRun().until_active()
    arm.machine.trip(FaultCode.BUS_ERROR, "cause", arm.now)
    arm.machine.trip(FaultCode.MOTOR_SILENT, "consequence", arm.now)
    arm.cycle(8.0)
    assert arm.fault_code == "bus_error"


SET = {  # of an event, what its value sets
    "off": lambda arm, joint: arm.off.add(joint),
    "silent": lambda arm, joint: arm.silent.add(joint),
    "replies": lambda arm, joint: arm.silent.discard(joint),
    "effort": lambda arm, effort: setattr(arm, "effort", effort),
    "age": lambda arm, age: setattr(arm, "effort_age", age),
    "reading": lambda arm, change: arm.changes.__setitem__(0, change),
    "trip": lambda arm, _: arm.machine.trip(FaultCode.BUS_ERROR, "test", arm.now),
    **{name: lambda arm, _, name=name: getattr(arm.machine, name)(arm.now) for name in ("enable", "disable", "clear")},
    "time": lambda arm, _: None,
}
VALUES = {
    **dict.fromkeys(("off", "silent", "replies"), st.integers(0, 3)),
    **dict.fromkeys(("enable", "disable", "clear", "trip"), st.none()),
    "effort": st.lists(st.floats(width=32), min_size=4, max_size=4) | st.none(),
    "age": st.floats(0.0, 0.2),
    "reading": st.dictionaries(st.sampled_from(["position", "velocity"]), st.floats(-9, 9)),
    "time": st.floats(0.004, 3.0),
}
EVENTS = st.one_of(*(st.tuples(st.just(name), values) for name, values in VALUES.items()))


@settings(max_examples=60, deadline=None)
@given(st.lists(EVENTS, max_size=25), st.sampled_from([0.0, 1.5]))
def test_no_sequence_of_events_lets_torque_flow_without_fresh_input_or_step(events, sign_check_torque):
    arm = SafetyRun(sign_check_torque=sign_check_torque)
    for event, value in events:
        SET[event](arm, value)
        had_fault = arm.machine.fault
        arm.cycle(value if event == "time" else PERIOD)
        check(arm, had_fault if event != "clear" else None)
    assert max(arm.steps, default=0.0) <= MAX_EFFORT_RATE * PERIOD * 1.0001


def check(arm: SafetyRun, had_fault: Fault | None) -> None:
    """Assert what must hold after every cycle; `had_fault`: a fault latched before it."""
    machine, drive = arm.machine, arm.drive
    assert all(map(math.isfinite, drive.effort))
    assert all(abs(e) <= limit for e, limit in zip(drive.effort, LIMITS.max_effort, strict=True))
    if machine.state in CARRYING:
        assert arm.effort is not None
        assert arm.effort_age <= RIDE.longest_age + 1e-9
        is_damped = machine.state is State.PROVING or min(drive.damping) > 0.0
        assert arm.effort_age <= LIMITS.command_timeout + 1e-9 or is_damped
        assert all(arm.now - joint.time <= LIMITS.reply_timeout + 1e-9 for joint in arm.joints)
        assert machine.fault is None
    elif machine.is_off:
        assert not drive.powered and drive.effort == drive.damping == OFF.effort
    elif machine.state is not State.LETTING_DOWN and not machine.is_unreached:
        assert not any(send in (Send.ENTER, Send.CLEAR) for send in drive.send)
    if had_fault:
        assert machine.fault == had_fault


def test_late_efforts_are_ridden_through_under_rising_damping_which_falls_again():
    arm = SafetyRun().until_active()
    arm.steps.clear()
    arm.effort_age = LIMITS.command_timeout + PERIOD
    arm.cycle()
    assert 0.0 < min(arm.drive.damping) < 0.2
    arm.cycle(0.1)
    assert arm.machine.state is State.ACTIVE and arm.machine.ride.rides == 1
    assert min(arm.drive.damping) == pytest.approx(DAMPING * 0.104 / DESCENT.damping_rise)
    assert arm.drive.effort == pytest.approx(EFFORT)
    arm.effort_age = 0.002
    arm.cycle(0.12)
    assert arm.machine.state is State.ACTIVE and max(arm.drive.damping) == 0.0
    assert max(arm.steps) <= 1e-6


@pytest.mark.parametrize("age", [0.002, LIMITS.command_timeout + PERIOD], ids=["a late tilt", "late efforts"])
def test_a_ride_ends_and_who_is_late_more_often_than_once_in_ten_is_let_down(age):
    arm = SafetyRun().until_active()
    arm.effort_age, arm.held = age, True
    arm.cycle(RIDE.longest - PERIOD)
    assert arm.machine.state is State.ACTIVE
    arm.cycle(2 * PERIOD)
    assert (arm.machine.state, arm.fault_code) == (State.LETTING_DOWN, "command_stale")

    arm = SafetyRun().until_active()
    for late, fresh in [(0.06, 0.6)] * 20:
        arm.effort_age, arm.held = age, True
        arm.cycle(late)
        arm.effort_age, arm.held = 0.002, False
        arm.cycle(fresh)
    assert arm.machine.state is State.ACTIVE and arm.machine.ride.rides == 20
    for late, fresh in [(0.06, 0.2)] * 4:
        arm.effort_age, arm.held = age, True
        arm.cycle(late)
        arm.effort_age, arm.held = 0.002, False
        arm.cycle(fresh)
    assert arm.fault_code == "command_stale"


def test_after_a_pause_of_the_loop_itself_only_the_age_of_the_efforts_counts():
    arm = SafetyRun().until_active()
    arm.now += 0.1  # the computer stood still: no motor was asked, and the ride has only begun
    arm.effort_age = 0.1
    arm.cycle()
    assert arm.machine.state is State.ACTIVE
    arm.effort_age = RIDE.longest_age + PERIOD
    arm.cycle()
    assert arm.fault_code == "command_stale"


def let_down_by(code: FaultCode) -> SafetyRun:
    arm = SafetyRun().until_active()
    arm.machine.trip(code, "test", arm.now)
    for step in range(400):  # as a One-G descent leaves a shoulder that no gravity turns back
        arm.changes[0].update(position=0.4 * PERIOD * step, velocity=0.4)
        arm.cycle()
    arm.changes[0].update(velocity=0.0)
    return arm.until(State.FAULT).until_off()


@pytest.mark.parametrize("code", [code for code in FaultCode if code.is_resumable])
def test_after_a_let_down_that_leaves_nothing_to_repair_resume_carries_the_arm_from_where_it_is(code):
    arm = let_down_by(code)
    assert arm.machine.resume(arm.now)
    arm.until(State.ACTIVE, limit=3.3)
    assert arm.machine.fault is None


def test_resume_is_refused_after_any_other_fault_and_in_any_other_state():
    for code in [code for code in FaultCode if not code.is_resumable][::4]:
        arm = let_down_by(code)
        assert not arm.machine.resume(arm.now)
        assert (arm.machine.state, arm.fault_code) == (State.FAULT, code)
        assert code in arm.machine.why_not_resumed
    arm = SafetyRun()
    assert not arm.machine.resume(arm.now)
    arm.until_active()
    assert not arm.machine.resume(arm.now)
    arm.machine.trip(FaultCode.COMMAND_STALE, "test", arm.now)
    arm.cycle()
    assert not arm.machine.resume(arm.now)
    arm.until(State.FAULT)
    arm.silent.add(1)
    arm.cycle(0.5)
    arm.silent.clear()
    arm.cycle(0.1)
    assert not arm.machine.resume(arm.now) and "zeros" in arm.machine.why_not_resumed


SILENCES = [(0.08, 0.0, True), (0.08, 0.698, False), (0.2, 0.0, True), (0.2, -0.698, False), (0.4, 0.0, False)]


@pytest.mark.parametrize(("silence", "turned", "is_trusted"), SILENCES)
def test_a_short_silence_keeps_zeros_trusted_unless_the_angle_has_lost_a_turn(silence, turned, is_trusted):
    arm = let_down_by(FaultCode.COMMAND_STALE)
    arm.silent.add(1)
    arm.cycle(silence)
    arm.silent.clear()
    arm.changes[1].update(position=turned)
    arm.cycle(0.1)
    assert (arm.machine.why_not_resumed == "") == is_trusted


def test_while_the_load_changes_only_a_joint_that_moves_is_damped_and_damping_neither_steps_nor_stays():
    run = SafetyRun().until_active()
    run.damped = True
    run.changes[1] = {"velocity": GUIDANCE.calm}
    run.changes[2] = {"velocity": -1.0}
    run.changes[3] = {"velocity": 0.4}
    steps = [run.drive.damping]
    for step in range(100):
        for change in run.changes[1:]:
            change["position"] = change["velocity"] * PERIOD * step
        steps.append(run.cycle().drive.damping)
    assert run.drive.damping[:2] == (0.0, 0.0)
    assert run.drive.damping[2] == pytest.approx(GUIDANCE.brake)
    assert 0.5 < 0.4 * run.drive.damping[3] < GUIDANCE.brake
    run.damped = False
    for change in run.changes[1:]:
        change["velocity"] = 0.0
    for _ in range(100):
        steps.append(run.cycle().drive.damping)
    assert run.drive.damping == NO_TORQUE
    largest = np.abs(np.diff(steps, axis=0)).max()
    assert largest <= DAMPING / DESCENT.damping_rise * PERIOD * 1.001
    assert run.machine.state is State.ACTIVE
