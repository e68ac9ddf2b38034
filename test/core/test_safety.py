"""The safety machine: when torque may flow, how it ends, and that a fault stays."""

import math
import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exo_gravity.core.delivery import TEST_TORQUE
from exo_gravity.core.drive import CARRYING, OFF, State
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.faults import FaultCode
from exo_gravity.core.limits import UNKNOWN, JointSample, Limits
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
    """Drives a machine through time, with the readings and efforts that a test sets.

    applied: (4,) Nm, what the motors truly apply: a silent motor keeps its torque, one that is off applies none.
    """

    def __init__(self, **limits):
        self.machine = SafetyMachine(replace(LIMITS, **limits), PERIOD)
        self.now = 100.0
        self.changes = [{} for _ in range(4)]
        self.silent = set()
        self.off = set()  # motors that are switched off behind the machine's back
        self.effort = EFFORT
        self.effort_age = 0.002
        self.joints = [UNKNOWN] * 4
        self.drive = OFF
        self.applied = [0.0] * 4
        self.steps = []

    def cycle(self, seconds=PERIOD):
        for _ in range(max(1, round(seconds / PERIOD))):
            self.now += PERIOD
            for i, change in enumerate(self.changes):
                if i not in self.silent:
                    velocity = change.get("velocity", 0.0)
                    torque = self.applied[i] - self.drive.damping[i] * velocity if i not in self.off else 0.0
                    self.joints[i] = reading(**{"time": self.now - 0.001, "effort": torque, **change})
            before = list(self.applied)
            self.drive = self.machine.step(self.now, tuple(self.joints), self.effort, self.now - self.effort_age)
            for i in range(4):
                if i not in self.silent:
                    self.applied[i] = self.drive.effort[i]
                if self.drive.enter[i]:
                    self.off.discard(i)
            self.steps.append(max(abs(a - b) for a, b in zip(self.applied, before, strict=True)))
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
    arm.cycle(1.65)
    assert arm.machine.state is State.RAMPING_IN
    assert arm.drive.effort[1] == pytest.approx(-2.0, abs=0.15)
    arm.cycle(1.0)
    assert arm.drive.effort == pytest.approx(EFFORT)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD * 1.0001


@pytest.mark.parametrize(
    ("spoil", "waits_for"),
    [
        (lambda arm: arm.silent.add(2), "c: no reply"),
        (lambda arm: arm.changes[1].update(velocity=0.5), "at rest"),
        (lambda arm: setattr(arm, "effort", None), "effort commands"),
        (lambda arm: setattr(arm, "effort_age", 0.06), "effort commands"),
        (lambda arm: arm.changes[2].update(position=2.6), "c to be moved by -0.10 rad, within its limits -0.8 to 2.5"),
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
    arm.cycle(8.0)
    for step in range(31):  # moved by hand
        arm.changes[1].update(position=0.5 + 0.02 * step)
        arm.cycle(0.02)
    arm.machine.enable(arm.now)
    arm.cycle(3.0)
    assert arm.machine.state is State.ACTIVE

    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.silent.add(2)  # switched off and on again: its zero may be another
    arm.cycle(0.1)
    arm.silent.clear()
    arm.machine.enable(arm.now)
    arm.cycle(1.0)
    assert arm.machine.fault.code == "implausible_zero"


class Hanging(Arm):
    """An arm whose joints give way to torque, each its own way: rad/s per Nm beyond 0.45 Nm of friction."""

    def __init__(self, gives):
        super().__init__(sign_check_torque=1.5)
        self.gives = gives
        self.position = [0.5] * 4
        self.most = [0.0] * 4

    def cycle(self, seconds=PERIOD):
        for _ in range(max(1, round(seconds / PERIOD))):
            for i, (effort, gives) in enumerate(zip(self.drive.effort, self.gives, strict=True)):
                self.most[i] = max(self.most[i], effort)
                excess = effort - max(-0.45, min(0.45, effort))  # beyond friction
                self.position[i] += excess * gives * PERIOD
                self.changes[i] = {"position": self.position[i]}
            super().cycle()
        return self


def test_each_sign_is_tried_once_gently_before_the_arm_is_carried():
    arm = Hanging((0.5, 0.2, 0.5, 0.5))
    arm.effort = (0.0,) * 4
    arm.machine.enable(arm.now)
    arm.cycle(1.5)
    assert arm.machine.state is State.PROVING
    arm.cycle(14.0)
    assert arm.machine.state is State.ACTIVE
    assert all(0.45 < position < 0.56 for position in arm.position)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD * 1.0001
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.most = [0.0] * 4
    arm.machine.enable(arm.now)
    arm.cycle(3.0)
    assert arm.machine.state is State.ACTIVE
    assert arm.most == [TEST_TORQUE] * 4  # the switch-on check alone


@pytest.mark.parametrize(("gives", "code"), [(-0.5, "wrong_sign"), (0.0, "sign_unproven")])
def test_a_joint_that_gives_way_backwards_or_not_at_all_is_refused(gives, code):
    arm = Hanging((0.5, 0.2, gives, 0.5))
    arm.machine.enable(arm.now)
    arm.cycle(20.0)
    assert arm.machine.state is State.FAULT
    assert arm.machine.fault.code == code
    assert arm.machine.fault.reason.startswith("c: ")
    assert arm.most[3] == TEST_TORQUE


FAULTS = [
    (lambda arm: arm.silent.add(3), "motor_silent"),
    (lambda arm: arm.changes[0].update(error=2), "motor_error"),
    (lambda arm: arm.changes[0].update(temperature=81), "over_temperature"),
    (lambda arm: arm.changes[1].update(velocity=5.2), "over_speed"),
    (lambda arm: arm.off.add(1), "torque_not_delivered"),
    (lambda arm: arm.changes[1].update(position=0.7), "position_jump"),
    (lambda arm: setattr(arm, "effort_age", 0.051), "command_stale"),
    (lambda arm: setattr(arm, "effort", None), "command_withdrawn"),
    (lambda arm: setattr(arm, "effort", (0.0, math.nan, 0.0, 0.0)), "command_impossible"),
    (lambda arm: setattr(arm, "effort", (0.0, 1e308, 0.0, 0.0)), "command_impossible"),
    (lambda arm: arm.machine.trip(FaultCode.BUS_ERROR, "unplugged", arm.now), "bus_error"),
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
    assert all(damping > 0.0 for damping in arm.drive.damping) or code == "motor_silent"
    arm.silent.clear()
    arm.changes = [{} for _ in range(4)]
    arm.effort, arm.effort_age = EFFORT, 0.002
    arm.cycle(10.0)
    assert arm.machine.state is State.FAULT
    assert arm.drive == OFF
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD * 1.0001
    arm.cycle(10.0)
    assert arm.machine.state is State.FAULT


def test_the_motors_are_switched_off_once_nothing_holds_the_arm_and_it_rests():
    arm = Arm().carried()
    arm.machine.disable(arm.now)
    for step in range(1500):  # creeps for 6 s at 0.02 rad/s, less than the velocity's resolution
        arm.changes[2].update(position=0.5 - 0.02 * PERIOD * step)
        arm.cycle()
        assert arm.drive.powered
    assert arm.drive.effort == arm.drive.damping == OFF.effort
    arm.cycle(2.1)
    assert arm.machine.state is State.DISABLED
    assert arm.drive == OFF


def test_a_motor_that_is_found_off_is_switched_on_again_with_the_torque_that_held_the_arm():
    arm = Arm().carried()
    arm.off.add(1)
    arm.steps.clear()
    since = arm.now
    while not any(arm.drive.enter):
        arm.cycle()
    assert arm.now - since <= 0.06
    assert arm.drive.enter == (False, True, False, False)
    assert arm.machine.fault.code == "torque_not_delivered"
    assert "b: -4.00 Nm commanded" in arm.machine.fault.reason
    assert arm.drive.effort[1] < -3.0


def test_a_silent_motors_torque_is_held_and_lowered_from_what_it_applies_when_it_replies_again():
    arm = Arm().carried()
    arm.silent.add(1)
    arm.cycle(4.9)
    assert arm.machine.state is State.LETTING_DOWN
    arm.cycle(30.0)
    assert arm.machine.state is State.FAULT
    assert arm.machine.is_unreached
    assert arm.drive.powered and arm.drive.effort == (0.0, -4.0, 0.0, 0.0)
    arm.silent.clear()
    arm.steps.clear()
    arm.cycle(0.5)
    assert arm.machine.state is State.LETTING_DOWN
    assert arm.drive.damping[1] == LIMITS.damping
    arm.cycle(10.0)
    assert max(arm.steps) <= LIMITS.max_effort_rate * PERIOD * 1.0001
    assert arm.machine.state is State.FAULT
    assert arm.drive == OFF
    assert arm.machine.fault.code == "motor_silent"


def test_a_motor_that_lost_its_power_while_silent_is_not_pushed_when_it_replies_again():
    arm = Arm().carried()
    arm.silent.add(1)
    arm.cycle(1.0)
    arm.silent.clear()
    arm.applied[1] = 0.0
    arm.steps.clear()
    arm.cycle(1.0)
    assert max(abs(effort) for effort in (arm.applied[1], arm.drive.effort[1])) < 0.01


@pytest.mark.parametrize("doubt", ["position_jump", "motor_error", "outside_limits", "torque_not_delivered"])
def test_after_a_fault_that_casts_doubt_on_them_zeros_are_checked_again(doubt):
    arm = Arm().carried()
    arm.machine.trip(FaultCode(doubt), "test", arm.now)
    arm.cycle(10.0)
    assert arm.machine.clear(arm.now)
    arm.changes[1].update(position=0.5 + math.radians(40.0))  # one turn of an AK80-9's motor
    arm.cycle()
    arm.machine.enable(arm.now)
    arm.cycle(1.0)
    assert arm.machine.fault.code == "implausible_zero"


def test_an_angle_that_jumps_while_the_arm_is_off_is_no_longer_trusted():
    arm = Arm().carried()
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.changes[1].update(position=0.5 + math.radians(40.0))
    arm.cycle()
    arm.machine.enable(arm.now)
    arm.cycle(1.0)
    assert arm.machine.fault.code == "implausible_zero"


def test_a_motor_that_does_not_switch_on_is_refused_at_every_start():
    arm = Arm().carried()
    arm.machine.disable(arm.now)
    arm.cycle(8.0)
    arm.off.add(3)
    arm.machine.enable(arm.now)
    arm.cycle(1.3)
    assert arm.machine.fault.code == "torque_not_delivered"
    assert "d: the motor did not switch on" in arm.machine.fault.reason


def test_noise_of_the_current_sensors_is_no_fault():
    arm = Arm().carried()
    dice = random.Random(3)
    for _ in range(5_000):  # 20 s
        for i, torque in enumerate(arm.applied):
            arm.changes[i] = {"effort": torque * dice.gauss(1.0, 0.05) + dice.gauss(0.0, 0.12)}
        arm.cycle()
    assert arm.machine.state is State.ACTIVE


def test_only_the_operator_clears_a_fault_and_clearing_arms_nothing():
    arm = Arm().carried()
    arm.machine.trip(FaultCode.BUS_ERROR, "unplugged", arm.now)
    arm.cycle(8.0)
    assert not arm.machine.enable(arm.now)
    assert arm.machine.clear(arm.now)
    arm.cycle(5.0)
    assert arm.machine.state is State.DISABLED
    assert arm.machine.enable(arm.now)


def test_a_call_timed_later_than_the_next_cycle_does_no_harm():
    arm = Arm().carried()
    arm.machine.trip(FaultCode.BUS_ERROR, "late", arm.now + 10 * PERIOD)
    arm.cycle()
    assert max(arm.drive.damping) == 0.0
    assert arm.drive.effort == pytest.approx(EFFORT)


def test_the_first_fault_is_the_one_that_is_latched():
    arm = Arm().carried()
    arm.machine.trip(FaultCode.BUS_ERROR, "cause", arm.now)
    arm.machine.trip(FaultCode.INTERNAL_ERROR, "consequence", arm.now)
    arm.cycle(8.0)
    assert arm.machine.fault.code == "bus_error"


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


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0, 250.0, 500.0, 1000.0])
@pytest.mark.parametrize("inertia", [0.005, 0.008, 0.03, 0.1, 0.3])
@pytest.mark.parametrize("speed", [0.1, 0.5, 2.0, 5.0])
def test_the_soft_wall_never_throws_a_joint_back_faster_than_it_came(rate, inertia, speed):
    """One joint without friction or gravity runs into its wall; the motor applies torque and damping at once."""
    period, limit = 1.0 / rate, LIMITS.position_max[0]
    position, velocity, torque = limit - 0.15, speed, 0.0
    for _ in range(int(4.0 * rate)):
        joints = [reading(position=position, velocity=round(velocity / 0.022) * 0.022, time=0.0)] * 4
        (torque, *_), _ = LIMITS.shape((0.0,) * 4, 1.0, joints, (torque,) * 4, period)
        damping = LIMITS.wall_damping(joints)[0]
        end = torque / damping if damping else math.inf  # rad/s, where the damping balances the torque
        if damping:
            decay = math.exp(-damping / inertia * period)
            position += end * period + (velocity - end) * (1.0 - decay) * inertia / damping
            velocity = end + (velocity - end) * decay
        else:
            position += (velocity + 0.5 * torque / inertia * period) * period
            velocity += torque / inertia * period
        assert velocity >= -speed
    assert position < limit + 6.0 * max(0.1, speed * period)


def test_a_wall_pushes_back_before_a_joint_limit():
    low, high = LIMITS.position_min[3], LIMITS.position_max[3]
    for position, sign in ((low + 0.05, 1), (high - 0.05, -1)):
        joints = [reading(position=position, time=0.0)] * 4
        shaped, acted = LIMITS.shape((0.0,) * 4, 1.0, joints, (0.0,) * 4, 1.0)
        assert shaped[3] == pytest.approx(sign * 1.25)
        assert LIMITS.wall_damping(joints)[3] == 5.0
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
    st.tuples(st.just("off"), st.integers(0, 3)),
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
            arm.machine.trip(FaultCode.BUS_ERROR, "test", arm.now)
        elif event == "off":
            arm.off.add(value)
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
    elif machine.state is not State.LETTING_DOWN and not machine.is_unreached:
        assert drive == OFF
    if had_fault:
        assert machine.fault == had_fault
