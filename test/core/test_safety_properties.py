"""Invariants of the safety machine under random sequences of events."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.safety.drive import CARRYING, OFF, Fault, FaultCode, State
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE

from ..support.safety_run import LIMITS, PERIOD, SafetyRun

EVENTS = st.one_of(
    st.tuples(st.just("enable"), st.none()),
    st.tuples(st.just("disable"), st.none()),
    st.tuples(st.just("clear"), st.none()),
    st.tuples(st.just("trip"), st.none()),
    st.tuples(st.just("off"), st.integers(0, 3)),
    st.tuples(st.just("silent"), st.integers(0, 3)),
    st.tuples(st.just("replies"), st.integers(0, 3)),
    st.tuples(st.just("effort"), st.lists(st.floats(width=32), min_size=4, max_size=4) | st.none()),
    st.tuples(st.just("age"), st.floats(0.0, 0.2)),
    st.tuples(st.just("reading"), st.dictionaries(st.sampled_from(["position", "velocity"]), st.floats(-9, 9))),
    st.tuples(st.just("time"), st.floats(0.004, 3.0)),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(EVENTS, max_size=25), st.sampled_from([0.0, 1.5]))
def test_no_sequence_of_events_lets_torque_flow_without_fresh_input_or_step(events, sign_check_torque):
    arm = SafetyRun(sign_check_torque=sign_check_torque)
    for event, value in events:
        if event in ("enable", "disable", "clear"):
            getattr(arm.machine, event)(arm.now)
        elif event == "trip":
            arm.machine.trip(FaultCode.BUS_ERROR, "test", arm.now)
        elif event == "off":
            arm.off.add(value)
        elif event == "silent":
            arm.silent.add(value)
        elif event == "replies":
            arm.silent.discard(value)
        elif event == "effort":
            arm.effort = value
        elif event == "age":
            arm.effort_age = value
        elif event == "reading":
            arm.changes[0] = value
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
        assert arm.effort_age <= LIMITS.command_timeout + 1e-9
        assert all(arm.now - joint.time <= LIMITS.reply_timeout + 1e-9 for joint in arm.joints)
        assert machine.fault is None
    elif machine.state is not State.LETTING_DOWN and not machine.is_unreached:
        assert drive == OFF
    if had_fault:
        assert machine.fault == had_fault
