# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The lifecycle of can_bridge, in this process, with a simulated arm: every transition, and errors in each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import BusError
from exo_gravity.core.safety import descent
from exo_gravity.core.safety.drive import Efforts, State
from exo_gravity.hardware.ownership import owned_bus
from exo_gravity.hardware.ownership.bus_lock import BusLock
from exo_gravity.nodes.can_bridge import node as can_bridge
from exo_gravity.nodes.can_bridge.effort_exchange import EffortExchange
from exo_gravity.nodes.can_bridge.node import CanBridge
from exo_gravity.nodes.can_bridge.operation import BridgeReport
from exo_gravity.nodes.ros.inner import NodeExecutor

from ..hardware.simulated_rig import NoWatchdog, SimulatedRig
from ..support.node_thread import NodeThread
from ..support.waiting import wait_until

pytestmark = pytest.mark.real_time
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedRig]:
    monkeypatch.setattr(owned_bus, "ATTEMPT_TIME", 0.1)
    monkeypatch.setattr(descent, "DESCENT", replace(descent.DESCENT, rest_time=0.2))
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    rig = SimulatedRig(friction=0.5, pose=NO_TORQUE)  # more friction than the pushes of the switch-on check
    yield rig
    rig.close()


@pytest.fixture
def make_bridge(rig: SimulatedRig, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., CanBridge]]:
    """A function that makes a bridge of the simulated arm, which needs no efforts from outside."""
    bridges: list[CanBridge] = []
    command = Efforts(NO_TORQUE, 0.0, False, False)
    monkeypatch.setattr(EffortExchange, "efforts", lambda self, latest: command._replace(answered=time.monotonic()))

    def make_bridge(autostart: bool = False, start_pose: str = "hanging") -> CanBridge:
        parameters = {
            "autostart": autostart,
            "can.interface": rig.arm.address[0],
            "can.channel": rig.arm.address[1],
            "sign_check_torque": 0.0,
            "start_pose": start_pose,
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


def assert_bus_is_free(rig: SimulatedRig) -> None:
    BusLock(rig.arm.address, "a test").release()


def assert_nothing_runs(bridge: CanBridge, rig: SimulatedRig) -> None:
    assert bridge.loop is None
    assert "control" not in [thread.name for thread in threading.enumerate()]
    assert rig.motors_on == [False] * 4


def carry(bridge: CanBridge, rig: SimulatedRig) -> None:
    assert bridge.trigger_configure() is SUCCESS
    assert bridge.trigger_activate() is SUCCESS
    safety = bridge.loop.safety

    def has_ended() -> bool:
        rclpy.spin_once(bridge, timeout_sec=0.0)  # a node that stands still carries no arm
        return safety.state in (State.ACTIVE, State.FAULT)

    wait_until(has_ended)
    while safety.state is State.FAULT:  # as a busy machine causes
        bridge.loop.call(lambda: safety.clear(time.monotonic()) and safety.enable(time.monotonic())).result(5.0)
        wait_until(has_ended)
    assert rig.motors_on == [True] * 4


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
    wait_until(lambda: bridge.loop.safety.state in (State.CHECKING, State.ACTIVE))
    assert bridge.trigger_deactivate() is SUCCESS
    assert bridge.trigger_cleanup() is SUCCESS
    assert_nothing_runs(bridge, rig)
    assert_bus_is_free(rig)


def test_no_motor_is_switched_on_before_the_operator_has_confirmed_the_pose_through_the_service(rig, make_bridge):
    bridge = make_bridge(start_pose="confirm")
    user = Client("operator")
    try:
        confirm = partial(user.call, Trigger, "/can_bridge/confirm_pose", Trigger.Request(), bridge)
        assert bridge.trigger_configure() is SUCCESS and bridge.trigger_activate() is SUCCESS
        safety = bridge.loop.safety
        wait_until(lambda: rclpy.spin_once(bridge, timeout_sec=0.0) or safety.pose.asked)
        assert rig.motors_on == [False] * 4
        response = confirm()
        assert response.success and "right_elbow_flexion 0" in response.message, response.message
        wait_until(lambda: rclpy.spin_once(bridge, timeout_sec=0.0) or safety.state is not State.CHECKING)
        response = confirm()
        assert not response.success and "nothing to confirm: the arm is" in response.message
    finally:
        user.destroy_node()


class Client(Node):
    """A node that calls services while another one spins."""

    def call(self, kind: Any, name: str, request: Any, server: Node) -> Any:
        client = self.create_client(kind, name)
        wait_until(client.service_is_ready)
        sent = client.call_async(request)
        wait_until(lambda: [rclpy.spin_once(node, timeout_sec=0.01) for node in (server, self)] and sent.done())
        return sent.result()


def test_a_deactivation_lets_the_arm_down_while_requests_are_answered(rig, make_bridge):
    bridge = make_bridge()
    carry(bridge, rig)
    executor, asking = NodeExecutor(), NodeThread("asking")
    executor.add_node(bridge)
    change = asking.nodes[0].create_client(ChangeState, "/can_bridge/change_state")
    enable = asking.nodes[0].create_client(SetBool, "/can_bridge/enable")
    asking.start()

    def spin() -> None:
        executor.spin_once(0.01)

    wait_until(lambda: change.service_is_ready() and enable.service_is_ready(), spin)
    leave = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    left = change.call_async(leave)
    wait_until(lambda: bridge.loop.safety.state is State.LETTING_DOWN, spin)
    enabled, again = enable.call_async(SetBool.Request(data=True)), change.call_async(leave)
    wait_until(lambda: enabled.done() and again.done(), spin)
    assert not left.done()
    assert enabled.result().message == can_bridge.LEAVING and not again.result().success
    wait_until(left.done, spin)
    assert left.result().success
    assert_nothing_runs(bridge, rig)
    asking.close()
    executor.shutdown()


def test_no_motor_is_switched_on_before_the_watchdog_watches_nor_stays_on_without_it(rig, make_bridge, monkeypatch):
    monkeypatch.setattr(NoWatchdog, "is_starting", True)
    bridge = make_bridge()
    assert bridge.trigger_configure() is SUCCESS
    assert bridge.trigger_activate() is SUCCESS
    safety = bridge.loop.safety
    wait_until(lambda: safety.waiting_for == "the watchdog to start")
    monkeypatch.setattr(NoWatchdog, "alive", False)  # it never started
    wait_until(lambda: rclpy.spin_once(bridge, timeout_sec=0.2) or safety.fault)
    assert (safety.state, safety.fault.code) == (State.FAULT, "watchdog_dead")
    assert rig.motors_on == [False] * 4


def test_a_shutdown_lets_the_arm_down_reports_it_and_releases_the_bus(rig, make_bridge, monkeypatch):
    reported: list[str] = []
    monkeypatch.setattr(BridgeReport, "send", lambda self, loop, *_: reported.append(loop.safety.state.value))
    bridge = make_bridge()
    carry(bridge, rig)
    assert bridge.trigger_shutdown() is SUCCESS
    assert "letting down" in reported
    assert reported[-1] in ("disabled", "fault")  # the latter on a machine that was too busy meanwhile
    assert_nothing_runs(bridge, rig)
    assert_bus_is_free(rig)


def test_a_bus_that_is_held_or_cannot_be_opened_fails_the_configuration_and_the_next_one_works(
    rig, make_bridge, monkeypatch
):
    lock = BusLock(rig.arm.address, "another (PID 1)")
    bridge = make_bridge()
    assert bridge.trigger_configure() is FAILURE
    lock.release()
    with monkeypatch.context() as patch:
        patch.setattr(can_bridge.OwnedBus, "open", raises(BusError("CAN bus can0 cannot be opened")))
        assert bridge.trigger_configure() is FAILURE
    assert_bus_is_free(rig)
    assert bridge.trigger_configure() is SUCCESS


def test_autostart_without_a_bus_ends_the_node_with_the_reason(rig, make_bridge):
    lock = BusLock(rig.arm.address, "another (PID 1)")
    with pytest.raises(BusError, match=r"is held by another \(PID 1\)"):
        make_bridge(autostart=True)
    lock.release()


def test_a_failed_activation_leaves_nothing_running_and_a_dead_control_thread_is_a_failure_of_the_node(
    rig, make_bridge, monkeypatch
):
    bridge = make_bridge()
    assert bridge.trigger_configure() is SUCCESS
    with monkeypatch.context() as patch:
        patch.setattr(can_bridge, "request_real_time", raises(OSError("no such thread")))
        assert bridge.trigger_activate() is FAILURE
    assert_nothing_runs(bridge, rig)
    assert bridge.trigger_activate() is SUCCESS
    assert bridge.failure is None
    bridge.loop.safety.step = raises(RuntimeError("broken"))
    wait_until(lambda: bridge.failure)
    assert str(bridge.failure) == "broken"


def raises(error: Exception) -> Callable[..., None]:
    """Return a function that raises `error`."""

    def fail(*_: object) -> None:
        raise error

    return fail
