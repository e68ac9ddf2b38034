# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""can_bridge in this process: its report, its services, who operates it, and every transition of its lifecycle."""

import copy
import math
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import rclpy
from diagnostic_msgs.msg import KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from exo_gravity.core.compensation.compensator import Compensation
from exo_gravity.core.errors import BusError, ParameterError
from exo_gravity.core.motors.boards import Boards
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import UNKNOWN, JointMotor, JointSample, Traffic
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety import descent, guidance, machine
from exo_gravity.core.safety.command import NO_EFFORTS, Efforts, FaultCode, State
from exo_gravity.core.safety.lease import LEASE_TIME, Lease
from exo_gravity.core.safety.limits import Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.vocabulary import NO_REASON
from exo_gravity.hardware import owned_bus
from exo_gravity.hardware.bus_lock import BusLock
from exo_gravity.hardware.can_port import ArmOnBus
from exo_gravity.nodes.can_bridge import node as can_bridge
from exo_gravity.nodes.can_bridge import operation
from exo_gravity.nodes.can_bridge.effort_exchange import EffortExchange
from exo_gravity.nodes.can_bridge.node import CanBridge
from exo_gravity.nodes.can_bridge.operation import (
    THERMAL_TIME,
    WATCH_PERIOD,
    BridgeReport,
    BridgeServices,
    MotorLoad,
    Operator,
)
from exo_gravity.nodes.compensator.arm import JointStateInterface
from exo_gravity.nodes.ros import inner
from exo_gravity.nodes.ros.inner import NodeExecutor
from exo_gravity.nodes.ros.messages import OK, WARN, Diagnostics
from exo_gravity.nodes.ros.subscriptions import MANY_REQUESTS
from exo_gravity.sim import ArmConfig

from ..hardware.arms import NoWatchdog, SimulatedRig, raised_arm
from ..support.keys import broken
from ..support.simulated_device import make_device
from ..support.waiting import wait_until

real_time = pytest.mark.real_time
NAMES = ("a", "b", "c", "elbow")
MOTORS_OF_ARM = tuple(JointMotor(MOTORS["AK60-6"], can_id) for can_id in (1, 2, 3, 4))


def carrying(n, effort=1.0, cycles=25, temperature=40):
    """Return what a bridge reports on in its nth report: an arm carried at rest, the elbow with `effort` Nm."""
    safety = SafetyMachine(Limits(NAMES), 0.004)
    safety.state = State.ACTIVE
    samples = [JointSample(0.5, 2.0, torque, 40, 0, 0.0) for torque in (0.0, 0.0, 0.0, effort)]
    boards = Boards(MOTORS_OF_ARM)
    for joint, sample in enumerate(samples):
        boards.take(joint, sample if joint else sample._replace(temperature=temperature))
    counts = {"cycles": cycles * n, **dict.fromkeys(("late", "incomplete", "cycle_errors"), 0)}
    bus = SimpleNamespace(ignored={}, boards=boards)
    return SimpleNamespace(safety=safety, samples=samples, bus=bus, failure=None, **counts)


@pytest.fixture
def sent(node, monkeypatch):
    """A function that lets a bridge report on `loop(n)`, `count` times, 0.1 s apart; it returns the reports.

    answered: when the answered joint states were measured, s; None for always now.
    """
    reports, clock = [], SimpleNamespace(now=1000.0)
    monkeypatch.setattr(Diagnostics, "report", lambda _, *report: reports.append(report))
    monkeypatch.setattr(operation, "time", SimpleNamespace(monotonic=lambda: clock.now))

    def sent(loop, count=30, answered=None):
        arm = ArmOnBus(("virtual", "arm", {}), MOTORS_OF_ARM, Limits(NAMES), 0.004)
        report = BridgeReport(node, arm, {"can0": Traffic(4)}, Lease(), SimpleNamespace(last=("none", "none")))
        for n in range(count):
            report.send(
                loop(n), NO_EFFORTS._replace(answered=clock.now if answered is None else answered), NO_REASON, ""
            )
            clock.now += 0.1
        return reports

    return sent


def keys_of(report):
    """Return what programs read of a report, which must keep to docs/keys.md."""
    values = {"interface": "1", **{key: str(value) for key, value in report[2].items()}}
    assert not broken("right/can_bridge", values)
    return values


def test_a_motor_above_its_rated_torque_and_a_slow_loop_are_named_and_every_key_is_documented(sent):
    reports = sent(lambda n: carrying(n, 6.0, 20), 1200, answered=-math.inf)
    assert keys_of(reports[20])["warnings"] == "slow_loop"
    level, message, values = reports[-1]
    assert level == WARN and "slower than 225 Hz" in message
    assert "above rated torque for too long: elbow" in message
    assert 180 < int(values["elbow RMS of rated torque (%)"]) < 200
    expected = {
        "elbow power (W)": "12",
        "elbow torque (Nm)": "6",
        "a RMS of rated torque (%)": "0",
        "rate (Hz)": "200.0",
        "age of efforts (ms)": "none",
        "warnings": "above_rated_torque, slow_loop",
        "joints above rated torque": "elbow",
        "fault": "none",
    }
    assert expected.items() <= keys_of(reports[-1]).items()


def stale(n):
    loop = carrying(n)
    loop.safety.stale.step(1000.0, 0.004, 0.07, False)
    return loop


@pytest.mark.parametrize(
    ("loop", "at", "level", "said", "expected"),
    [
        (carrying, -1, OK, "active", {"temperatures when switched on": "plausible"}),
        (
            partial(carrying, temperature=-15),
            -1,
            WARN,
            "motor 1 read -15 degC when it was switched on, the others 40 to 40",
            {"temperatures when switched on": "implausible"},
        ),
        (stale, 15, WARN, "active, still used: efforts 70 ms old", {"rides": "1"}),
        (stale, -1, OK, "active", {}),
        (lambda _: None, 0, WARN, "inactive: enable it", {"state": "inactive", "control held by": "nobody"}),
    ],
)
def test_what_an_operator_must_know_is_in_the_headline_and_in_a_key(sent, loop, at, level, said, expected):
    report = sent(loop)[at]
    assert report[0] == level and said in report[1] and expected.items() <= keys_of(report).items()


def test_what_a_start_waits_for_and_why_it_ended_have_words_and_figures(sent):
    limits, loop = Limits(NAMES), carrying(0)
    hanging = JointSample(0.0, 0.0, 0.0, None, 0, math.inf)
    loop.samples = [hanging] * 3 + [hanging._replace(position=limits.position_max[3] + math.radians(2.0))]
    loop.safety = safety = SafetyMachine(limits, 0.004)
    safety.enable(0.0)
    safety.step(0.0, loop.samples, NO_EFFORTS)
    values = keys_of(sent(lambda _: loop, 1)[-1])
    waits = {"state": "checking", "motors": "off", "waiting for": "joint_limits", "joints outside limits": "elbow"}
    assert {**waits, "refusal": "none", "elbow temperature (degC)": "unknown"}.items() <= values.items()
    assert float(values["turn back (deg)"]) == pytest.approx(-2.0, abs=0.11)
    safety.step(100.0, loop.samples, NO_EFFORTS)  # longer than any start waits
    values = keys_of(sent(lambda _: loop, 1)[-1])
    assert (values["state"], values["waiting for"], values["refusal"]) == ("disabled", "none", "joint_limits")


# Services


@pytest.fixture
def ask(node):
    """A function that asks for a service of a bridge whose control thread is `loop`; it returns why not, or ''.

    last: the keys `request` and `answer` after it.
    """

    def ask(service, loop, data=None, zero=0.0, refusal=""):
        motors = [JointMotor(MOTORS["AK60-6"], can_id, zero=zero) for can_id in (1, 2, 3, 4)]
        services = BridgeServices(node, lambda: loop, motors, lambda: refusal)
        response = finish(services.answer(getattr(services, service), SimpleNamespace(data=data), SimpleNamespace()))
        ask.last = services.last
        return "" if response.success else response.message

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
    assert ask("confirm_pose", loop).startswith("nothing to confirm")
    assert ask("enable", None, True) == "the node is not active" and ask.last == ("enable", "inactive")


def test_the_answer_to_a_request_has_a_word_of_its_own_for_each_reason(ask, monkeypatch):
    loop = standing()
    assert ask("enable", loop, True, refusal="leaves") == "leaves" and ask.last == ("enable", "leaving")
    assert ask("enable", loop, False, refusal="leaves") == "" and ask.last == ("let_down", "done")
    monkeypatch.setattr(operation, "CALL_TIMEOUT", 0.0)
    run, (waiting, broken, overtaken) = loop.call, (Future() for _ in range(3))
    broken.set_exception(BusError("unplugged"))
    overtaken.cancel()
    for service, future, said, word in (
        ("resume", waiting, "did not respond", "no_response"),
        ("resume", broken, "unplugged", "bus_error"),
        ("confirm_pose", overtaken, "asked to be let down", "overtaken"),
    ):
        loop.call = Mock(return_value=future)
        assert said in ask(service, loop) and ask.last == (service, word)
    assert not waiting.set_running_or_notify_cancel()  # as the control thread asks: nothing happens later
    loop.call = run
    monkeypatch.setattr(inner, "REQUEST_LIFE", -1.0)
    assert "0.0 s old" in ask("enable", loop, True) and ask.last == ("enable", "too_old")
    assert ask("enable", loop, False) == ""


def test_one_request_resumes_or_is_refused_with_the_reason(ask, monkeypatch):
    loop = standing()
    assert ask("resume", loop) == f"refused: {loop.safety.why_not_resumed}"
    loop.safety.enable(0.0)
    loop.safety.trip(FaultCode.COMMAND_STALE, "late", 1.0)
    assert ask("resume", loop).startswith("refused: zeros are no longer sure")
    monkeypatch.setattr(SafetyMachine, "why_not_resumed", NO_REASON)  # as tested with the machine
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


# Requests over DDS, and what waits for the control thread


@pytest.mark.parametrize("data", [True, False])
def test_an_enable_that_has_waited_is_refused_and_a_let_down_is_not(served, monkeypatch, data):
    monkeypatch.setattr(inner, "REQUEST_LIFE", 0.2)
    loop = standing()
    loop.safety.enable(1.0)
    if data:
        loop.safety.disable(1.0)
    BridgeServices(served.node, lambda: loop, (), lambda: "")
    future = served.send(SetBool, "enable", SetBool.Request(data=data))
    time.sleep(0.3)
    response = served.answer(future)
    assert response.success is not data and loop.safety.state == "disabled"
    assert ("s old" in response.message) is data


def test_a_let_down_is_not_pushed_out_by_a_hundred_other_requests(served, monkeypatch):
    monkeypatch.setattr(inner, "REQUEST_LIFE", 0.0)  # those are refused
    loop = standing()
    loop.safety.enable(1.0)
    services = BridgeServices(served.node, lambda: loop, (), lambda: "")
    answered: list[tuple[str, str]] = []
    other = served.client.create_client(SetBool, "served/enable", qos_profile=MANY_REQUESTS)
    wait_until(other.service_is_ready)
    let_down = served.send(SetBool, "enable", SetBool.Request(data=False))
    others = [other.call_async(SetBool.Request(data=True)) for _ in range(100)]
    time.sleep(0.1)
    wait_until(others[-1].done, lambda: served.spin() or answered.append(services.last))
    assert loop.safety.state == "disabled" and ("let_down", "done") in answered
    assert let_down.done() and let_down.result().success


def test_a_let_down_does_not_wait_behind_enables_which_then_never_run(served):
    """The control thread stands still, and goes on once both have asked."""
    loop, calls = standing(), []

    def call(function):
        calls.append((function, Future()))
        return calls[-1][1]

    loop.call = call
    BridgeServices(served.node, lambda: loop, (), lambda: "")
    enable = served.send(SetBool, "enable", SetBool.Request(data=True))
    wait_until(lambda: len(calls) == 1, served.spin)
    disable = served.send(SetBool, "enable", SetBool.Request(data=False))
    wait_until(lambda: len(calls) == 2, served.spin)
    for function, future in calls:
        if future.set_running_or_notify_cancel():
            future.set_result(function())
    assert served.answer(disable).success
    refused = served.answer(enable)
    assert not refused.success and "let down" in refused.message
    assert loop.safety.state == "disabled"


# Joint states out, efforts in

EFFORT = (0.0, 1.0, 2.0, 3.0)


class Exchange:
    """The exchange of a bridge, with a compensator in its process if `answer` is given. trips: of its loop."""

    def __init__(self, node, answer=None):
        self.trips = []
        self.loop = SimpleNamespace(
            safety=SimpleNamespace(state=State.ACTIVE), trip=lambda code, reason: self.trips.append(code)
        )
        self.exchange = EffortExchange(node, Limits(NAMES), lambda: self.loop, answer)

    def take(self, now=100.0):
        """Publish joint states measured at `now` s; return the newest efforts then, and after a look at the topic."""
        self.exchange.take(now, [JointSample(0.5, 0.0, 0.0, 40, 0, now)] * 4)
        return self.exchange.newest, self.exchange.efforts(time.monotonic() + 0.02)

    @property
    def said(self):
        return self.exchange.refusal.code, self.trips


@pytest.mark.parametrize("is_one_process", [False, True])
def test_efforts_are_taken_once_and_those_of_a_second_publisher_let_the_arm_down(node, is_one_process):
    node.set_parameters([Parameter("use_sim_time", value=True)])  # and no /clock: every stamp is 0
    publisher, message = node.create_publisher(JointState, "effort_commands", 1), JointState(name=NAMES, effort=EFFORT)
    answers = [True]

    def answer(_state):
        publisher.publish(message)
        return message if answers.pop() else None

    bridge = Exchange(node, answer if is_one_process else None)
    wait_until(lambda: publisher.get_subscription_count() == 1)
    if is_one_process:  # they are there at once
        command, later = bridge.take()
        assert later is command
        answers += [False] * 3
    else:
        wait_until(lambda: bridge.take()[1].effort, lambda: publisher.publish(message))
        command = bridge.exchange.newest
    assert (tuple(command.effort), command.answered) == (EFFORT, 100.0)
    for now in (100.004, 100.008, 100.012) if is_one_process else ():  # the first answer has arrived by its topic
        assert bridge.take(now) == (command, command) and bridge.exchange.newest is command
    assert bridge.said == ("none", [])
    other = node.create_publisher(JointState, "effort_commands", 1)
    wait_until(lambda: other.get_subscription_count() == 1)
    other.publish(message)
    wait_until(lambda: bridge.trips, lambda: bridge.exchange.efforts(time.monotonic()))
    assert bridge.said == ("second_publisher", ["second_commander"])
    assert bridge.exchange.newest.effort is None


@pytest.mark.parametrize("held", ["", "trunk tilt older than 80 ms: held on"])
@pytest.mark.parametrize(("step", "answered"), [(0, 100.0), (-3600, 100.3), (3600, 100.3)])
def test_under_a_clock_that_stands_still_efforts_grow_old_and_one_that_is_set_changes_nothing(
    node, step, answered, held
):
    node.set_parameters([Parameter("use_sim_time", value=True)])
    compensator = JointStateInterface(node, NAMES)
    answer = Compensation(EFFORT, NO_REASON, (), "", (), False, held)
    bridge = Exchange(node, lambda message: compensator.send(0.0, message, answer))
    for now, seconds in ((100.0, 7200), (100.3, 7200 + step)):
        node.get_clock().set_ros_time_override(Time(seconds=seconds))
        found = bridge.take(now)[0]
    assert (tuple(found.effort), found.answered, found.damped, found.held) == (EFFORT, answered, False, bool(held))


@pytest.mark.parametrize(
    ("spoil", "word", "tripped"),
    [
        (lambda message: message.effort.pop(), "invalid", ["command_impossible"]),
        (lambda message: message.name.__setitem__(3, "left_knee"), "invalid", ["command_impossible"]),
        (lambda message: message.velocity.append(0.5), "invalid", ["command_impossible"]),
        (lambda message: setattr(message.header.stamp, "sec", message.header.stamp.sec - 3600), "unknown_stamp", []),
    ],
    ids=["three efforts", "a wrong name", "a velocity", "a stamp an hour old"],
)
def test_efforts_that_are_malformed_let_the_arm_down_and_those_of_another_stamp_are_not_taken(
    node, spoil, word, tripped
):
    """What the arm does then: rows `effort NaN` and `compensator frozen` of the fault matrix."""

    def answer(state: JointState) -> JointState:
        message = JointState(header=copy.deepcopy(state.header), name=list(state.name), effort=EFFORT)
        spoil(message)
        return message

    bridge = Exchange(node, answer)
    assert bridge.take()[0].effort is None and bridge.said == (word, tripped)


# Who operates an arm


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


def test_an_arm_is_let_down_gently_when_its_operator_is_gone_but_not_after_a_release(operated):
    operated.run(LEASE_TIME + 0.2)
    operated.run(0.5, holding="anna")
    assert operated.operator.lease.holder == "anna"
    operated.operator.lease.request(operated.arm.clock.monotonic(), "anna", "release")
    operated.run(LEASE_TIME + 0.3)
    assert operated.safety.state is State.ACTIVE and not operated.safety.fault
    operated.run(0.5, holding="anna")
    operated.run(LEASE_TIME - 0.2)
    assert operated.safety.state is State.ACTIVE
    operated.run(0.5)
    assert operated.safety.state is State.LETTING_DOWN
    assert operated.safety.fault.code is FaultCode.CONTROL_LOST
    operated.arm.assert_let_down()


def test_requests_for_control_arrive_by_topic_and_an_operator_who_leaves_during_the_descent_leaves_no_fault(
    operated, node
):
    operated.run(1.0, holding="anna")
    operated.safety.disable(operated.arm.clock.monotonic())
    operated.run(3.0)
    operated.arm.assert_let_down()
    assert operated.safety.state is State.DISABLED
    publisher = node.create_publisher(KeyValue, "listener/control", 10)
    for kind, holder in (("hold", "anna"), ("release", "")):
        ask = KeyValue(key="anna", value=kind)
        wait_until(
            lambda holder=holder: operated.operator.lease.holder == holder,
            lambda ask=ask: publisher.publish(ask) or operated.operator.watch(),
        )


# The lifecycle, with a simulated arm in real time

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedRig]:
    monkeypatch.setattr(owned_bus, "ATTEMPT_TIME", 0.1)
    monkeypatch.setattr(descent, "DESCENT", replace(descent.DESCENT, rest_time=0.2))
    monkeypatch.setattr(machine, "START_GATE", replace(machine.START_GATE, calm=0.2))
    monkeypatch.setattr(guidance, "GUIDANCE", replace(guidance.GUIDANCE, time=0.2))
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    # More friction than the pushes of the switch-on check.
    rig = SimulatedRig(make_device(config=ArmConfig(coulomb_friction=(0.5,) * 4)))
    yield rig
    rig.close()


@pytest.fixture
def make_bridge(rig: SimulatedRig, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., CanBridge]]:
    """A function that makes a bridge of the simulated arm, which needs no efforts from outside."""
    bridges: list[CanBridge] = []
    command = Efforts(NO_TORQUE, 0.0, False, False)
    monkeypatch.setattr(EffortExchange, "efforts", lambda self, latest: command._replace(answered=time.monotonic()))

    def make_bridge(autostart: bool = False) -> CanBridge:
        parameters = {
            "autostart": autostart,
            "can.interface": rig.arm.address[0],
            "can.channel": rig.arm.address[1],
            "sign_check_torque": 0.0,
            "start_pose": "hanging",
            "rate": 100.0,  # the tests share a busy machine
            "command_timeout": 0.1,
        }
        given = [f"{name}:={str(value).lower()}" for name, value in parameters.items()]
        rclpy.init(args=["--ros-args", *(word for text in given for word in ("-p", text))])
        bridges.append(CanBridge())
        return bridges[-1]

    yield make_bridge
    for bridge in bridges:
        bridge.close()
        bridge.destroy_node()
    rclpy.try_shutdown()


def spin_until(bridge: CanBridge, condition: Callable[[], object]) -> None:
    """Spin the bridge until `condition()` holds: a node that stands still carries no arm."""
    wait_until(condition, lambda: rclpy.spin_once(bridge, timeout_sec=0.01))


def assert_nothing_runs(bridge: CanBridge, rig: SimulatedRig) -> None:
    assert bridge.loop is None
    assert "control" not in [thread.name for thread in threading.enumerate()]
    assert rig.motors_on == [False] * 4


def carry(bridge: CanBridge, rig: SimulatedRig) -> None:
    """Configure and activate, until the arm is carried; a fault, as a busy machine causes, is cleared."""
    assert bridge.trigger_configure() is bridge.trigger_activate() is SUCCESS
    safety = bridge.loop.safety
    spin_until(bridge, lambda: safety.state in (State.ACTIVE, State.FAULT))
    while safety.state is State.FAULT:
        bridge.loop.call(lambda: safety.clear(time.monotonic()) and safety.enable(time.monotonic())).result(5.0)
        spin_until(bridge, lambda: safety.state in (State.ACTIVE, State.FAULT))
    assert rig.motors_on == [True] * 4


@real_time
def test_carried_deactivated_once_all_motors_reply_activated_again_and_cleaned_up(rig, make_bridge, monkeypatch):
    bridge = make_bridge()
    carry(bridge, rig)
    with pytest.raises(BusError, match="is held by /can_bridge"):
        BusLock(rig.arm.address, "another")
    rig.device.bus_silent = True
    with monkeypatch.context() as patch:
        patch.setattr(can_bridge, "TRANSITION_TIMEOUT", 1.0)
        assert bridge.trigger_deactivate() is FAILURE
    rig.device.bus_silent = False
    assert bridge.trigger_deactivate() is SUCCESS  # so the node had stayed active
    assert_nothing_runs(bridge, rig)
    assert bridge.trigger_activate() is SUCCESS
    wait_until(lambda: bridge.loop.safety.state is not State.DISABLED)
    assert bridge.trigger_deactivate() is SUCCESS
    assert bridge.trigger_cleanup() is SUCCESS
    assert_nothing_runs(bridge, rig)
    BusLock(rig.arm.address, "a test").release()  # the bus is free


@real_time
def test_a_deactivation_lets_the_arm_down_while_requests_are_answered(rig, make_bridge, node, monkeypatch):
    bridge = make_bridge()
    carry(bridge, rig)
    usual, leave = descent.DESCENT, Transition(id=Transition.TRANSITION_DEACTIVATE)
    # However late this thread runs, the arm is not down before the requests are answered.
    monkeypatch.setattr(descent, "DESCENT", replace(usual, rest_time=1e3, longest_rest=1e3))
    executor, own = NodeExecutor(), SingleThreadedExecutor(context=node.context)
    executor.add_node(bridge)
    own.add_node(node)

    def asked(kind: Any, name: str, **fields: Any) -> Future[Any]:
        client = node.create_client(kind, f"/can_bridge/{name}")
        wait_until(client.service_is_ready)
        return client.call_async(kind.Request(**fields))

    def spin_until(condition: Callable[[], object]) -> None:
        wait_until(condition, lambda: executor.spin_once(0.01) or own.spin_once(0.01))

    def answer_to_enable() -> str:
        enabled = asked(SetBool, "enable", data=True)
        spin_until(enabled.done)
        return enabled.result().message

    left = asked(ChangeState, "change_state", transition=leave)
    wait_until(lambda: answer_to_enable() == can_bridge.LEAVING)
    for transition in (leave, Transition(id=Transition.TRANSITION_ACTIVATE)):  # nor is the arm armed again afterwards
        again = asked(ChangeState, "change_state", transition=transition)
        spin_until(again.done)
        assert not left.done() and not again.result().success
    assert bridge.loop.safety.state is State.LETTING_DOWN
    monkeypatch.setattr(descent, "DESCENT", usual)
    spin_until(left.done)
    assert left.result().success
    assert_nothing_runs(bridge, rig)
    for each in (executor, own):
        each.shutdown()


@real_time
def test_no_motor_is_switched_on_before_the_watchdog_watches_nor_stays_on_without_it(rig, make_bridge, monkeypatch):
    monkeypatch.setattr(NoWatchdog, "is_starting", True)
    bridge = make_bridge()
    assert bridge.trigger_configure() is bridge.trigger_activate() is SUCCESS
    safety = bridge.loop.safety
    wait_until(lambda: safety.waiting_for.text == "the watchdog to start")
    monkeypatch.setattr(NoWatchdog, "alive", False)  # it never started
    spin_until(bridge, lambda: safety.fault)
    assert (safety.state, safety.fault.code) == (State.FAULT, "watchdog_dead")
    assert rig.motors_on == [False] * 4


@real_time
def test_a_shutdown_lets_the_arm_down_reports_it_and_releases_the_bus(rig, make_bridge, monkeypatch):
    reported: list[str] = []
    monkeypatch.setattr(BridgeReport, "send", lambda self, loop, *_: reported.append(loop.safety.state.value))
    bridge = make_bridge()
    carry(bridge, rig)
    assert bridge.trigger_shutdown() is SUCCESS
    assert "letting down" in reported
    assert reported[-1] in ("disabled", "fault")  # the latter on a machine that was too busy meanwhile
    assert_nothing_runs(bridge, rig)
    BusLock(rig.arm.address, "a test").release()  # the bus is free


@real_time
def test_a_bus_that_is_held_or_cannot_be_opened_fails_the_configuration_and_the_next_one_works(
    rig, make_bridge, monkeypatch
):
    lock = BusLock(rig.arm.address, "another (PID 1)")
    with pytest.raises(BusError, match=r"is held by another \(PID 1\)"):
        make_bridge(autostart=True)
    rclpy.try_shutdown()
    bridge = make_bridge()
    assert bridge.trigger_configure() is FAILURE
    lock.release()
    with monkeypatch.context() as patch:
        patch.setattr(can_bridge.OwnedBus, "open", Mock(side_effect=BusError("CAN bus can0 cannot be opened")))
        assert bridge.trigger_configure() is FAILURE
    BusLock(rig.arm.address, "a test").release()  # the bus is free
    assert bridge.trigger_configure() is SUCCESS


@real_time
def test_a_failed_activation_leaves_nothing_running_and_a_dead_control_thread_is_a_failure_of_the_node(
    rig, make_bridge, monkeypatch
):
    bridge = make_bridge()
    assert bridge.trigger_configure() is SUCCESS
    with monkeypatch.context() as patch:
        patch.setattr(can_bridge, "set_realtime_priority", Mock(side_effect=OSError("no such thread")))
        assert bridge.trigger_activate() is FAILURE
    assert_nothing_runs(bridge, rig)
    assert bridge.trigger_activate() is SUCCESS
    assert bridge.failure is None
    bridge.loop.safety.step = Mock(side_effect=RuntimeError("broken"))
    wait_until(lambda: bridge.failure)
    assert str(bridge.failure) == "broken"


def load_after(seconds: float, step: float, torque: float) -> list[tuple[float, float, float]]:
    """Return power, RMS torque and share of two motors; the second never replies."""
    load = MotorLoad((3.0, 9.0))
    return [
        load.update(number * step, (JointSample(0.0, 0.0, torque, 30, 0, 0.0), UNKNOWN))
        for number in range(round(seconds / step) + 1)
    ][-1]


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_constant_torque_warms_a_cold_motor_exponentially_whatever_the_period(step):
    (_, rms, share), (_, other, _) = load_after(THERMAL_TIME, step, 6.0)
    assert rms == pytest.approx(6.0 * math.sqrt(1.0 - math.exp(-1.0)), rel=1e-9)
    assert share == pytest.approx(rms / 3.0) and other == 0.0
