"""The safety machine: when torque may flow, how it ends, and that a fault stays."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.drive import CARRYING, OFF, State
from exo_gravity.core.safety import SafetyMachine

PERIOD = 0.004
LIMITS = Limits(
    joint_names=("a", "b", "c", "d"),
    position_min=(-1.6, -0.2, -0.8, -0.2),
    position_max=(1.6, 3.1, 2.5, 3.1),
    max_velocity=(5.0, 5.0, 5.0, 6.0),
    max_effort=(3.0, 9.0, 3.0, 3.0),
    home=(0.5, 0.5, 0.5, 0.5),
    sign_check_torque=0.0,
)
EFFORT = (0.5, -4.0, 2.0, 1.0)


def reading(**changes) -> JointSample:
    return JointSample(**{"position": 0.5, "velocity": 0.0, "effort": 0.0, "temperature": 30, "error": 0, **changes})


class Arm:
    """Drives a machine through time, with whatever readings and efforts a test sets."""

    def __init__(self, **limits):
        self.machine = SafetyMachine(replace(LIMITS, **limits), PERIOD)
        self.now = 100.0
        self.changes = [{} for _ in range(4)]
        self.silent = set()
        self.effort = EFFORT
        self.effort_age = 0.002
        self.joints = [UNKNOWN] * 4
        self.drive = OFF
        self.steps = []

    def cycle(self, seconds=PERIOD):
        for _ in range(max(1, round(seconds / PERIOD))):
            self.now += PERIOD
            for i, change in enumerate(self.changes):
                if i not in self.silent:
                    self.joints[i] = reading(time=self.now - 0.001, **change)
            before = self.drive
            self.drive = self.machine.step(self.now, tuple(self.joints), self.effort, self.now - self.effort_age)
            self.steps.append(max(abs(a - b) for a, b in zip(self.drive.effort, before.effort, strict=True)))
        return self

    def carried(self):
        self.machine.enable(self.now)
        self.cycle(3.0)
        assert self.machine.state is State.ACTIVE
        return self


def test_a_new_machine_gives_nothing_and_switches_nothing_on():
    arm = Arm().cycle(1.0)
    assert arm.machine.state is State.DISABLED
    assert arm.drive == OFF


def test_torque_ramps_in_over_the_ramp_time_without_a_step():
    arm = Arm()
    arm.machine.enable(arm.now)
    arm.cycle(1.5)
    assert arm.machine.state is State.RAMPING_IN
    assert arm.drive.effort[1] == pytest.approx(-2.0, abs=0.05)
    arm.cycle(1.0)
    assert arm.drive.effort == pytest.approx(EFFORT)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD


@pytest.mark.parametrize(
    ("spoil", "waits_for"),
    [
        (lambda arm: arm.silent.add(2), "c: no reply"),
        (lambda arm: arm.changes[1].update(velocity=0.5), "at rest"),
        (lambda arm: setattr(arm, "effort", None), "effort commands"),
        (lambda arm: setattr(arm, "effort_age", 0.06), "effort commands"),
    ],
)
def test_the_start_gate_waits_and_says_for_what(spoil, waits_for):
    arm = Arm()
    spoil(arm)
    arm.machine.enable(arm.now)
    arm.cycle(2.0)
    assert arm.machine.state is State.CHECKING
    assert waits_for in arm.machine.waiting_for
    assert not arm.drive.powered


def test_the_start_gate_wants_a_whole_second_without_trouble():
    arm = Arm()
    arm.machine.enable(arm.now)
    for _ in range(5):
        arm.cycle(0.9)
        arm.silent.add(1)
        arm.cycle(0.1)
        arm.silent.clear()
    assert arm.machine.state is State.CHECKING


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"position": 2.51}, "outside_limits"),
        ({"error": 5}, "motor_error"),
        ({"temperature": 95}, "over_temperature"),
    ],
)
def test_the_start_gate_refuses_and_latches_why(change, code):
    arm = Arm()
    arm.changes[2].update(change)
    arm.machine.enable(arm.now)
    arm.cycle(1.0)
    assert arm.machine.state is State.FAULT
    assert arm.machine.fault.code == code
    assert "c:" in arm.machine.fault.reason


def test_an_arm_that_does_not_hang_at_home_is_refused_until_it_was_once_carried():
    arm = Arm()
    arm.changes[1].update(position=0.5 + math.radians(40.0))  # a turn of an AK80-9's motor
    arm.machine.enable(arm.now)
    arm.cycle(1.0)
    assert arm.machine.fault.code == "implausible_zero"
    assert "b: 1.198 rad at the start" in arm.machine.fault.reason

    arm = Arm().carried()
    arm.machine.disable(arm.now)
    arm.cycle(4.0)
    arm.changes[1].update(position=1.1)
    arm.cycle(0.1)
    arm.machine.enable(arm.now)
    arm.cycle(3.0)
    assert arm.machine.state is State.ACTIVE

    arm.machine.disable(arm.now)
    arm.cycle(4.0)
    arm.silent.add(2)  # switched off and on again: its zero may be another
    arm.cycle(0.1)
    arm.silent.clear()
    arm.machine.enable(arm.now)
    arm.cycle(1.0)
    assert arm.machine.fault.code == "implausible_zero"


class Hanging(Arm):
    """An arm whose joints give way to torque, each its own way: rad/s per Nm beyond 0.3 Nm of friction."""

    def __init__(self, gives):
        super().__init__(sign_check_torque=1.5)
        self.gives = gives
        self.position = [0.5] * 4
        self.most = [0.0] * 4

    def cycle(self, seconds=PERIOD):
        for _ in range(max(1, round(seconds / PERIOD))):
            for i, (effort, gives) in enumerate(zip(self.drive.effort, self.gives, strict=True)):
                self.most[i] = max(self.most[i], effort)
                self.position[i] += max(0.0, effort - 0.3) * gives * PERIOD
                self.changes[i] = {"position": self.position[i]}
            super().cycle()
        return self


def test_each_sign_is_tried_once_gently_before_the_arm_is_carried():
    arm = Hanging((0.5, 0.2, 0.5, 0.5))
    arm.effort = (0.0,) * 4
    arm.machine.enable(arm.now)
    arm.cycle(1.5)
    assert arm.machine.state is State.PROVING
    arm.cycle(6.0)
    assert arm.machine.state is State.ACTIVE
    assert all(0.52 < position < 0.6 for position in arm.position)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD
    arm.machine.disable(arm.now)
    arm.cycle(4.0)
    arm.most = [0.0] * 4
    arm.machine.enable(arm.now)
    arm.cycle(3.0)
    assert arm.machine.state is State.ACTIVE
    assert arm.most == [0.0] * 4


@pytest.mark.parametrize(("gives", "code"), [(-0.5, "wrong_sign"), (0.0, "sign_unproven")])
def test_a_joint_that_gives_way_backwards_or_not_at_all_is_refused(gives, code):
    arm = Hanging((0.5, 0.2, gives, 0.5))
    arm.machine.enable(arm.now)
    arm.cycle(8.0)
    assert arm.machine.state is State.FAULT
    assert arm.machine.fault.code == code
    assert arm.machine.fault.reason.startswith("c: ")
    assert arm.most[3] == 0.0


FAULTS = [
    (lambda arm: arm.silent.add(3), "motor_silent"),
    (lambda arm: arm.changes[0].update(error=2), "motor_error"),
    (lambda arm: arm.changes[0].update(temperature=81), "over_temperature"),
    (lambda arm: arm.changes[1].update(velocity=5.2), "over_speed"),
    (lambda arm: arm.changes[1].update(position=0.7), "position_jump"),
    (lambda arm: setattr(arm, "effort_age", 0.051), "command_stale"),
    (lambda arm: setattr(arm, "effort", None), "command_withdrawn"),
    (lambda arm: setattr(arm, "effort", (0.0, math.nan, 0.0, 0.0)), "command_impossible"),
    (lambda arm: setattr(arm, "effort", (0.0, 1e308, 0.0, 0.0)), "command_impossible"),
    (lambda arm: arm.machine.trip("bus_error", "unplugged", arm.now), "bus_error"),
]


@pytest.mark.parametrize(("spoil", "code"), FAULTS, ids=[code for _, code in FAULTS])
def test_a_fault_lets_the_arm_down_gently_and_stays_latched(spoil, code):
    arm = Arm().carried()
    arm.steps.clear()
    spoil(arm)
    arm.cycle(0.1)
    assert arm.machine.state is State.LETTING_DOWN
    assert arm.machine.fault.code == code
    assert arm.drive.powered
    assert arm.drive.damping > 0.0
    arm.silent.clear()
    arm.changes = [{} for _ in range(4)]
    arm.effort, arm.effort_age = EFFORT, 0.002
    arm.cycle(4.0)
    assert arm.machine.state is State.FAULT
    assert arm.drive == OFF
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD
    arm.cycle(10.0)
    assert arm.machine.state is State.FAULT


def test_the_damping_stays_until_the_arm_is_at_rest():
    arm = Arm().carried()
    arm.machine.disable(arm.now)
    for step in range(1500):  # creeps for 6 s at 0.02 rad/s, less than the velocity's resolution
        arm.changes[2].update(position=0.5 - 0.02 * PERIOD * step)
        arm.cycle()
    assert arm.machine.state is State.LETTING_DOWN
    assert arm.drive == ((0.0,) * 4, LIMITS.damping, True)
    arm.cycle(1.0)
    assert arm.machine.state is State.DISABLED


def test_a_motor_that_could_not_be_reached_gets_damping_when_it_answers_again_and_is_switched_off_at_rest():
    arm = Arm().carried()
    arm.silent.add(1)
    arm.cycle(4.9)
    assert arm.machine.state is State.LETTING_DOWN
    arm.cycle(30.0)
    assert arm.machine.state is State.FAULT
    assert arm.drive == ((0.0,) * 4, LIMITS.damping, True)
    arm.silent.clear()
    for step in range(500):  # it had gone on holding the arm, which now comes down
        arm.changes[1].update(position=0.5 - 0.2 * PERIOD * step)
        arm.cycle()
        assert arm.drive.powered
    arm.cycle(1.0)
    assert arm.drive == OFF
    assert arm.machine.fault.code == "motor_silent"


def test_only_the_operator_clears_a_fault_and_clearing_arms_nothing():
    arm = Arm().carried()
    arm.machine.trip("bus_error", "unplugged", arm.now)
    arm.cycle(4.0)
    assert not arm.machine.enable(arm.now)
    assert arm.machine.clear(arm.now)
    arm.cycle(5.0)
    assert arm.machine.state is State.DISABLED
    assert arm.machine.enable(arm.now)


def test_an_order_timed_later_than_the_next_cycle_does_no_harm():
    arm = Arm().carried()
    arm.machine.trip("late", "order", arm.now + 10 * PERIOD)
    arm.cycle()
    assert arm.drive.damping == 0.0
    assert arm.drive.effort == pytest.approx(EFFORT)


def test_the_first_fault_is_the_one_that_is_told():
    arm = Arm().carried()
    arm.machine.trip("first", "cause", arm.now)
    arm.machine.trip("second", "consequence", arm.now)
    arm.cycle(4.0)
    assert arm.machine.fault.code == "first"


def test_torque_never_exceeds_the_limit_nor_its_rate():
    arm = Arm().carried()
    arm.steps.clear()
    arm.effort = (39.0, -39.0, 39.0, -39.0)
    arm.cycle(1.0)
    assert arm.drive.effort == (3.0, -9.0, 3.0, -3.0)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD * 1.0001
    assert "max_effort (b)" in arm.machine.acted


def test_a_hot_motor_gets_less():
    arm = Arm().carried()
    arm.effort = (3.0, 9.0, 3.0, 3.0)
    arm.changes[1].update(temperature=75)
    arm.cycle(1.0)
    assert arm.drive.effort[1] == pytest.approx(6.75)
    assert "derating (b)" in arm.machine.acted


def test_before_a_joint_stop_a_wall_pushes_back():
    low, high = LIMITS.position_min[3], LIMITS.position_max[3]
    for position, sign in ((low + 0.05, 1), (high - 0.05, -1)):
        shaped, acted = LIMITS.shape(
            (0.0,) * 4, 1.0, [reading(position=position, time=0.0)] * 4, (sign * 2.5,) * 4, 1.0
        )
        assert shaped[3] == pytest.approx(sign * 2.5)
        assert "soft wall (d)" in acted


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_effort", (3.0, 9.0, 3.0)),
        ("max_velocity", (0.0,) * 4),
        ("position_max", (0.0,) * 4),
        ("command_timeout", 5.0),
        ("fade_time", 0.0),
        ("damping", math.nan),
        ("joint_names", ("a", "a", "b", "c")),
    ],
)
def test_an_impossible_limit_is_refused(field, value):
    with pytest.raises(ParameterError) as caught:
        Limits(**{**vars(LIMITS), field: value})
    assert caught.value.name == field


EVENTS = st.one_of(
    st.tuples(st.just("enable"), st.none()),
    st.tuples(st.just("disable"), st.none()),
    st.tuples(st.just("clear"), st.none()),
    st.tuples(st.just("trip"), st.none()),
    st.tuples(st.just("silence"), st.integers(0, 3)),
    st.tuples(st.just("speak"), st.integers(0, 3)),
    st.tuples(st.just("effort"), st.lists(st.floats(width=32), min_size=4, max_size=4) | st.none()),
    st.tuples(st.just("age"), st.floats(0.0, 0.2)),
    st.tuples(st.just("reading"), st.dictionaries(st.sampled_from(["position", "velocity"]), st.floats(-9, 9))),
    st.tuples(st.just("time"), st.floats(0.004, 3.0)),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(EVENTS, max_size=25), st.sampled_from([0.0, 1.5]))
def test_whatever_happens_torque_flows_only_on_fresh_input_and_never_in_steps(events, sign_check_torque):
    arm = Arm(sign_check_torque=sign_check_torque)
    for event, value in events:
        if event in ("enable", "disable", "clear"):
            getattr(arm.machine, event)(arm.now)
        elif event == "trip":
            arm.machine.trip("test", "test", arm.now)
        elif event == "silence":
            arm.silent.add(value)
        elif event == "speak":
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
    assert max(arm.steps, default=0.0) <= LIMITS.max_effort_rate * PERIOD * 1.0001


def check(arm, had_fault):
    machine, drive = arm.machine, arm.drive
    assert all(map(math.isfinite, drive.effort))
    assert all(abs(e) <= limit for e, limit in zip(drive.effort, LIMITS.max_effort, strict=True))
    if machine.state in CARRYING:
        assert arm.effort is not None
        assert arm.effort_age <= LIMITS.command_timeout + 1e-9
        assert all(arm.now - joint.time <= LIMITS.reply_timeout + 1e-9 for joint in arm.joints)
        assert machine.fault is None
    elif machine.state is not State.LETTING_DOWN:
        assert drive.effort == OFF.effort
    if had_fault:
        assert machine.fault == had_fault
