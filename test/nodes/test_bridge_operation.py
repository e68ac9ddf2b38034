# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What an operator of can_bridge sees and may do: its report on /diagnostics, and its services."""

from __future__ import annotations

import math
import time
from concurrent.futures import Future
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import KeyValue
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from exo_gravity.core.compensation.compensator import Compensation
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.boards import Boards
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor, JointSample, Traffic
from exo_gravity.core.safety.drive import NO_EFFORTS, FaultCode, State
from exo_gravity.core.safety.lease import LEASE_TIME, Lease
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.vocabulary import NO_REASON
from exo_gravity.hardware.can.can_port import ArmOnBus
from exo_gravity.nodes.can_bridge import operation
from exo_gravity.nodes.can_bridge.effort_exchange import EffortExchange
from exo_gravity.nodes.can_bridge.operation import WATCH_PERIOD, BridgeReport, BridgeServices, Operator
from exo_gravity.nodes.compensator.arm import JointStateInterface
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics

from ..hardware.rig import raised_arm
from ..support.keys import broken
from ..support.waiting import wait_until

NAMES = ("a", "b", "c", "elbow")
MOTORS_OF_ARM = tuple(JointMotor(MOTORS["AK60-6"], can_id) for can_id in (1, 2, 3, 4))


def carrying(effort, cycles=0, temperature=40):
    """Return what a bridge reports on: an arm that is carried at rest, the elbow with `effort` Nm."""
    safety = SafetyMachine(Limits(NAMES), 0.004)
    safety.state = State.ACTIVE
    samples = [JointSample(0.5, 2.0, torque, 40, 0, 0.0) for torque in (0.0, 0.0, 0.0, effort)]
    boards = Boards(MOTORS_OF_ARM)
    for joint, sample in enumerate(samples):
        boards.take(joint, sample if joint else sample._replace(temperature=temperature))
    counts = dict.fromkeys(("late", "incomplete", "cycle_errors"), 0)
    bus = SimpleNamespace(ignored={}, boards=boards)
    return SimpleNamespace(safety=safety, samples=samples, bus=bus, failure=None, cycles=cycles, **counts)


@pytest.fixture
def sent(node, monkeypatch):
    """A function that lets a bridge report on `loop(n)`, `count` times, 0.1 s apart; it returns the reports.

    answered: when the answered joint states were measured, s; None for always now.
    """
    reports, clock = [], SimpleNamespace(now=1000.0)
    monkeypatch.setattr(Diagnostics, "report", lambda _, *report: reports.append(report))
    monkeypatch.setattr(operation, "time", SimpleNamespace(monotonic=lambda: clock.now))

    def sent(loop, count, answered=None):
        arm = ArmOnBus(("virtual", "arm", {}), MOTORS_OF_ARM, Limits(NAMES), 0.004)
        report = BridgeReport(node, arm, {"can0": Traffic(4)}, Lease(), SimpleNamespace(last=("none", "none")))
        for n in range(count):
            report.send(loop(n), NO_EFFORTS._replace(answered=clock.now if answered is None else answered), NO_REASON)
            clock.now += 0.1
        return reports

    return sent


def test_a_motor_that_stays_above_its_rated_torque_is_named_with_load_and_power(sent):
    reports = sent(lambda n: carrying(6.0, 25 * n), 1200, answered=-math.inf)
    assert reports[20][:2] == (OK, "active")
    level, message, values = reports[-1]
    assert (level, message) == (WARN, "active, above rated torque for too long: elbow")
    assert values["elbow power (W)"] == "12" and values["elbow torque (Nm)"] == "6"
    assert 180 < int(values["elbow RMS of rated torque (%)"]) < 200 and values["a RMS of rated torque (%)"] == "0"
    assert values["rate (Hz)"] == "250.0" and values["age of efforts (ms)"] == "none"


def test_a_motor_that_did_not_read_room_temperature_when_it_was_switched_on_is_reported(sent):
    assert sent(lambda n: carrying(1.0, 25 * n), 30)[-1][2]["temperatures when switched on"] == "plausible"
    level, message, values = sent(lambda n: carrying(1.0, 25 * n, temperature=-15), 30)[-1]
    assert level == WARN and "motor 1 read -15 degC when it was switched on, the others 40 to 40" in message
    assert values["temperatures when switched on"] == "implausible"


def test_a_ride_through_late_efforts_is_reported_and_counted(sent):
    def riding(n):
        loop = carrying(1.0, 25 * n)
        loop.safety.ride.step(1000.0, 0.004, 0.07, False)
        return loop

    reports = sent(riding, 30)
    assert reports[15][:2] == (WARN, "active, riding through: efforts 70 ms old")
    assert reports[15][2]["rides"] == 1
    assert reports[-1][:2] == (OK, "active")


def keys_of(report):
    """Return what programs read of a report, which must keep to docs/keys.md."""
    values = {"interface": "1", **{key: str(value) for key, value in report[2].items()}}
    assert not broken("right/can_bridge", values)
    return values


def test_what_a_start_waits_for_and_why_it_ended_have_words_and_figures(sent):
    limits, loop = Limits(NAMES), carrying(0.0)
    hanging = JointSample(0.0, 0.0, 0.0, None, 0, math.inf)
    loop.samples = [hanging] * 3 + [hanging._replace(position=limits.position_max[3] + math.radians(2.0))]
    loop.safety = safety = SafetyMachine(limits, 0.004)
    safety.enable(0.0)
    safety.step(0.0, loop.samples, NO_EFFORTS)
    values = keys_of(sent(lambda _: loop, 1)[-1])
    assert (values["state"], values["motors"], values["waiting for"]) == ("checking", "off", "joint_limits")
    assert (values["joints outside limits"], float(values["turn back (deg)"])) == (
        "elbow",
        pytest.approx(-2.0, abs=0.11),
    )
    assert values["refusal"] == "none" and values["elbow temperature (degC)"] == "unknown"
    safety.step(100.0, loop.samples, NO_EFFORTS)  # longer than any start waits
    values = keys_of(sent(lambda _: loop, 1)[-1])
    assert (values["state"], values["waiting for"], values["refusal"]) == ("disabled", "none", "joint_limits")
    loop.samples = [hanging] * 4
    values = keys_of(sent(lambda _: loop, 1)[-1])
    assert (values["joints outside limits"], values["turn back (deg)"]) == ("none", "none")


def test_an_inactive_bridge_has_its_state_and_who_controls_it(sent):
    values = keys_of(sent(lambda _: None, 1)[-1])
    assert (values["state"], values["source"], values["control held by"]) == ("inactive", "simulated", "nobody")


def test_every_key_of_a_carried_arm_is_documented(sent):
    report = sent(lambda n: carrying(6.0, 20 * n, temperature=-15), 1200)[-1]
    values = keys_of(report)
    assert "slower than 225 Hz" in report[1]
    assert values["warnings"] == "above_rated_torque, odd_temperature, slow_loop"
    assert values["joints above rated torque"] == "elbow" and values["fault"] == "none"


@pytest.fixture
def ask(node):
    """A function that asks for a service of a bridge whose control thread is `loop`; it returns why not, or ''.

    last: the keys `request` and `answer` after it.
    """

    def ask(service, loop, data=None, zero=0.0, hindrance=""):
        motors = [JointMotor(MOTORS["AK60-6"], can_id, zero=zero) for can_id in (1, 2, 3, 4)]
        services = BridgeServices(node, lambda: loop, motors, lambda: hindrance)
        assert services.last == ("none", "none")
        response = finish(services.answer(getattr(services, service), SimpleNamespace(data=data), SimpleNamespace()))
        ask.last = services.last
        if response.success:
            assert ("/diagnostics" in response.message) is (loop.safety.state is State.CHECKING)
            return ""
        return response.message

    return ask


def finish(callback):
    """Let a service's callback run to its end; return its response."""
    while True:
        try:
            callback.send(None)
        except StopIteration as end:
            return end.value


def standing():
    """A control loop whose arm is off and at rest, and which runs a call at once."""
    loop = SimpleNamespace(safety=SafetyMachine(Limits(NAMES), 0.004))
    loop.samples = (JointSample(0.0, 0.0, 0.0, 40, 0, math.inf),) * 4

    def call(function):
        future = Future()
        future.set_result(function())
        return future

    loop.call = call
    loop.safety.step(0.0, loop.samples, NO_EFFORTS)
    return loop


def test_an_operator_enables_disables_and_clears_or_reads_why_not(ask):
    loop = standing()
    assert ask("enable", loop, True) == "" and ask.last == ("enable", "done")
    assert ask("enable", loop, True).startswith("refused") and ask.last == ("enable", "refused")
    loop.safety.trip(FaultCode.BUS_ERROR, "unplugged", 1.0)
    assert "unplugged" in ask("enable", loop, True)
    assert ask("enable", loop, False) == ask("clear_fault", loop) == ""
    assert ask("clear_fault", loop).startswith("no fault to clear") and ask.last == ("clear_fault", "refused")
    assert ask("enable", None, True) == "the node is not active" and ask.last == ("enable", "inactive")


def test_the_answer_to_a_request_has_a_word_of_its_own_for_each_reason(ask, monkeypatch):
    loop = standing()
    assert ask("enable", loop, True, hindrance="leaves") == "leaves" and ask.last == ("enable", "leaving")
    assert ask("enable", loop, False, hindrance="leaves") == "" and ask.last == ("let_down", "done")
    run, waiting = loop.call, Future()
    loop.call = lambda function: waiting
    monkeypatch.setattr(operation, "CALL_TIMEOUT", 0.0)
    assert "did not respond" in ask("enable", loop, True) and ask.last == ("enable", "no_response")
    assert not waiting.set_running_or_notify_cancel()  # as the control thread asks: it never enables the arm later
    broken = Future()
    broken.set_exception(BusError("unplugged"))
    loop.call = lambda function: broken
    assert ask("resume", loop) == "unplugged" and ask.last == ("resume", "bus_error")
    overtaken = Future()
    overtaken.cancel()
    loop.call = lambda function: overtaken
    assert "asked to be let down" in ask("confirm_pose", loop) and ask.last == ("confirm_pose", "overtaken")
    loop.call = run
    monkeypatch.setattr(operation, "age_of_request", lambda node: 1.5)
    assert "1.5 s old" in ask("enable", loop, True) and ask.last == ("enable", "too_old")
    assert ask("enable", loop, False) == ""


def test_one_request_resumes_or_is_refused_with_the_reason(ask, monkeypatch):
    loop = standing()
    assert ask("resume", loop) == f"refused: {loop.safety.why_not_resumed}"
    loop.safety.enable(0.0)
    loop.safety.trip(FaultCode.COMMAND_STALE, "late", 1.0)
    assert ask("resume", loop).startswith("refused: zeros are no longer sure")
    monkeypatch.setattr(SafetyMachine, "why_not_resumed", "")  # as tested with the machine
    assert ask("resume", loop) == ""
    assert (loop.safety.state, loop.safety.fault) == (State.CHECKING, None)


def test_set_zero_is_refused_with_the_zeros_to_write_in_the_file(ask):
    loop = standing()
    loop.samples = (*loop.samples[:3], loop.samples[3]._replace(position=-0.25))
    assert "write zero: [0.1000, 0.1000, 0.1000, -0.1500] for can_bridge" in ask("set_zero", loop, zero=0.1)
    loop.samples = (*loop.samples[:3], loop.samples[3]._replace(position=math.nan))
    assert ask("set_zero", loop).endswith("write zero: in the file, once all reply")


def test_simulated_time_is_refused_with_a_real_bus_at_the_start_and_live(node):
    operation.refuse_simulated_time(node, "udp_multicast")
    assert node.set_parameters([Parameter("use_sim_time", value=True)])[0].successful
    with pytest.raises(ParameterError, match="use_sim_time = True: must be false with a real bus"):
        operation.refuse_simulated_time(node, "socketcan")
    node.set_parameters([Parameter("use_sim_time", value=False)])
    operation.refuse_simulated_time(node, "slcan")
    result = node.set_parameters([Parameter("use_sim_time", value=True)])[0]
    assert not result.successful and "read-only parameter: use_sim_time" in result.reason


@pytest.fixture
def exchange(node):
    """The bridge's end of the efforts, under a clock that stands still: every stamp is 0."""
    node.set_parameters([Parameter("use_sim_time", value=True)])  # and no /clock
    return EffortExchange(node, Limits(NAMES), lambda: SimpleNamespace())


def await_efforts(exchange, send):
    """Let `send` answer joint states until the exchange has an answer; return it."""

    def answer() -> None:
        send()
        exchange.efforts(time.monotonic() + 0.05)

    wait_until(lambda: exchange.newest.effort is not None, answer, seen=lambda: exchange.refusal)
    return exchange.newest


def test_under_a_clock_that_stands_still_efforts_grow_old(node, exchange):
    compensator = node.create_publisher(JointState, "effort_commands", 1)
    for now in (100.0, 100.004, 100.3):
        exchange.take(now, [JointSample(0.0, 0.0, 0.0, 40, 0, now)] * 4)
    command = await_efforts(exchange, lambda: compensator.publish(JointState(name=NAMES, effort=(0.0,) * 4)))
    assert command.answered == 100.0


@pytest.mark.parametrize("held", ["", "trunk tilt older than 80 ms: held on"])
def test_the_bridge_knows_efforts_of_a_late_tilt(node, exchange, held):
    compensator, effort = JointStateInterface(node, NAMES), (0.0, 1.0, 2.0, 3.0)
    exchange.take(100.0, [JointSample(0.0, 0.0, 0.0, 40, 0, 100.0)] * 4)
    command = await_efforts(
        exchange, lambda: compensator.send(0.0, JointState(), Compensation(effort, NO_REASON, (), "", (), False, held))
    )
    assert (tuple(command.effort), command.damped, command.held) == (effort, False, bool(held))


@pytest.fixture
def operated(node):
    """An arm that is carried in virtual time, who operates it, and a function that lets the bridge watch for a time."""
    arm = raised_arm()
    operator = Operator(node, lambda: arm.loop, arm.clock)

    def run(seconds, holding=""):
        for _ in range(round(seconds / WATCH_PERIOD)):
            if holding:
                operator.lease.request(arm.clock.monotonic(), holding, "hold")
            arm.run(WATCH_PERIOD)
            operator.watch()

    return SimpleNamespace(arm=arm, operator=operator, run=run, safety=arm.safety)


def test_an_arm_whose_operator_is_gone_is_let_down_gently(operated):
    operated.run(5.0, holding="anna")
    assert operated.safety.state is State.ACTIVE and operated.operator.lease.holder == "anna"
    operated.run(LEASE_TIME - 0.2)
    assert operated.safety.state is State.ACTIVE
    operated.run(0.5)
    assert operated.safety.state is State.LETTING_DOWN
    assert operated.safety.fault.code is FaultCode.CONTROL_LOST
    operated.arm.assert_let_down()


def test_an_arm_stays_carried_after_a_release_and_without_an_operator(operated):
    operated.run(2.0)
    operated.run(2.0, holding="anna")
    operated.operator.lease.request(operated.arm.clock.monotonic(), "anna", "release")
    operated.run(5.0)
    assert operated.safety.state is State.ACTIVE and not operated.safety.fault


def test_an_operator_who_leaves_during_the_descent_leaves_no_fault(operated):
    operated.run(1.0, holding="anna")
    operated.safety.disable(operated.arm.clock.monotonic())
    operated.run(3.0)
    operated.arm.assert_let_down()
    assert operated.safety.state is State.DISABLED and not operated.safety.fault


def test_requests_for_control_arrive_by_topic(operated, node):
    publisher = node.create_publisher(KeyValue, "listener/control", 10)
    for kind, holder in (("hold", "anna"), ("release", "")):

        def ask(kind: str = kind) -> None:
            publisher.publish(KeyValue(key="anna", value=kind))
            operated.operator.watch()

        wait_until(lambda holder=holder: operated.operator.lease.holder == holder, ask)
