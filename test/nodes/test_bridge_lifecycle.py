"""The lifecycle of can_bridge, in this process, with a simulated arm: every transition, and errors in each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn

from exo_gravity.core.errors import BusError
from exo_gravity.core.safety.drive import NOTHING, State
from exo_gravity.hardware.control_loop import EffortCommand
from exo_gravity.hardware.ownership import bus_lock, owned_bus
from exo_gravity.hardware.ownership.bus_lock import BusLock
from exo_gravity.nodes.can_bridge import node as can_bridge
from exo_gravity.nodes.can_bridge import services as bridge_services
from exo_gravity.nodes.can_bridge.effort_exchange import EffortExchange
from exo_gravity.nodes.can_bridge.node import CanBridge
from exo_gravity.nodes.can_bridge.report import BridgeReport

from ..hardware.simulated_rig import NoWatchdog, SimulatedRig, wait_until

pytestmark = pytest.mark.real_time
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulatedRig]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(bus_lock, "ATTEMPT_TIME", 0.1)
    monkeypatch.setattr(owned_bus, "Watchdog", NoWatchdog)
    rig = SimulatedRig(friction=0.5, pose=NOTHING)  # more friction than the pushes of the switch-on check
    yield rig
    rig.close()


@pytest.fixture
def make_bridge(rig: SimulatedRig, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., CanBridge]]:
    """A function that makes a bridge of the simulated arm, which needs no efforts from outside."""
    bridges: list[CanBridge] = []
    command = EffortCommand(NOTHING, 0.0)
    monkeypatch.setattr(EffortExchange, "get_efforts", lambda self, latest: command._replace(answered=time.monotonic()))

    def make_bridge(autostart: bool = False) -> CanBridge:
        parameters = {
            "autostart": autostart,
            "can.interface": rig.arm.address[0],
            "can.channel": rig.arm.address[1],
            "sign_check_torque": 0.0,
            "command_timeout": 0.1,  # the tests share a busy machine
            "reply_timeout": 0.1,
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


def state_of(bridge: CanBridge) -> str:
    return bridge._state_machine.current_state[1]


def assert_bus_is_free(rig: SimulatedRig) -> None:
    BusLock(rig.arm.address, "a test").release()


def assert_nothing_runs(bridge: CanBridge, rig: SimulatedRig) -> None:
    assert bridge._loop is None
    assert "control" not in [thread.name for thread in threading.enumerate()]
    assert rig.motors_on == [False] * 4


def carry(bridge: CanBridge, rig: SimulatedRig) -> None:
    assert bridge.trigger_configure() is SUCCESS
    assert bridge.trigger_activate() is SUCCESS
    safety = bridge._loop.safety
    wait_until(lambda: safety.state in (State.ACTIVE, State.FAULT))
    while safety.state is State.FAULT:  # as a busy machine causes
        bridge._loop.call(lambda: safety.clear(time.monotonic()) and safety.enable(time.monotonic())).result(5.0)
        wait_until(lambda: safety.state in (State.ACTIVE, State.FAULT))
    assert rig.motors_on == [True] * 4


def test_configured_activated_deactivated_activated_again_and_cleaned_up(rig, make_bridge):
    bridge = make_bridge()
    carry(bridge, rig)
    with pytest.raises(BusError, match="is held by /can_bridge"):
        BusLock(rig.arm.address, "another")
    assert bridge.trigger_deactivate() is SUCCESS
    assert_nothing_runs(bridge, rig)
    assert bridge.trigger_activate() is SUCCESS
    wait_until(lambda: bridge._loop.safety.state is State.CHECKING)
    assert bridge.trigger_deactivate() is SUCCESS
    assert bridge.trigger_cleanup() is SUCCESS
    assert_nothing_runs(bridge, rig)
    assert_bus_is_free(rig)


def test_a_shutdown_lets_the_arm_down_reports_it_and_releases_the_bus(rig, make_bridge, monkeypatch):
    reported: list[str] = []
    monkeypatch.setattr(BridgeReport, "send", lambda self, loop, *_: reported.append(loop.safety.state.value))
    bridge = make_bridge()
    carry(bridge, rig)
    assert bridge.trigger_shutdown() is SUCCESS
    assert "letting down" in reported
    assert reported[-1] == "disabled"
    assert_nothing_runs(bridge, rig)
    assert_bus_is_free(rig)


def test_a_held_bus_fails_the_configuration(rig, make_bridge):
    lock = BusLock(rig.arm.address, "another (PID 1)")
    bridge = make_bridge()
    assert bridge.trigger_configure() is FAILURE
    assert state_of(bridge) == "unconfigured"
    lock.release()
    assert bridge.trigger_configure() is SUCCESS


def test_a_bus_that_cannot_be_opened_fails_the_configuration_and_is_released(rig, make_bridge, monkeypatch):
    bridge = make_bridge()
    monkeypatch.setattr(can_bridge.OwnedBus, "open", raises(BusError("CAN bus can0 cannot be opened")))
    assert bridge.trigger_configure() is FAILURE
    assert_bus_is_free(rig)


def test_autostart_without_a_bus_ends_the_node_with_the_reason(rig, make_bridge):
    lock = BusLock(rig.arm.address, "another (PID 1)")
    with pytest.raises(BusError, match=r"is held by another \(PID 1\)"):
        make_bridge(autostart=True)
    lock.release()


def test_a_failed_activation_leaves_nothing_running_and_the_next_one_works(rig, make_bridge, monkeypatch):
    bridge = make_bridge()
    assert bridge.trigger_configure() is SUCCESS
    with monkeypatch.context() as patch:
        patch.setattr(can_bridge, "request_real_time", raises(OSError("no such thread")))
        assert bridge.trigger_activate() is FAILURE
    assert state_of(bridge) == "inactive"
    assert_nothing_runs(bridge, rig)
    assert bridge.trigger_activate() is SUCCESS


def test_a_deactivation_fails_while_a_motor_does_not_reply(rig, make_bridge, monkeypatch):
    bridge = make_bridge()
    carry(bridge, rig)
    rig.device.bus_silent = True
    monkeypatch.setattr(can_bridge, "DESCENT_TIMEOUT", 1.0)
    assert bridge.trigger_deactivate() is FAILURE
    assert state_of(bridge) == "active"
    rig.device.bus_silent = False
    monkeypatch.setattr(can_bridge, "DESCENT_TIMEOUT", 60.0)
    assert bridge.trigger_deactivate() is SUCCESS
    assert_nothing_runs(bridge, rig)


def test_an_enable_that_timed_out_never_arms_the_arm_later(rig, make_bridge, monkeypatch):
    bridge = make_bridge()
    assert bridge.trigger_configure() is SUCCESS
    assert bridge.trigger_activate() is SUCCESS
    loop = bridge._loop
    loop.call(lambda: loop.safety.disable(time.monotonic())).result(5.0)
    monkeypatch.setattr(bridge_services, "CALL_TIMEOUT", 0.1)
    resume = threading.Event()
    loop.call(resume.wait)
    services = bridge_services.BridgeServices(bridge, lambda: loop, bridge._motors, bridge._limits)
    response = services._on_enable(SimpleNamespace(data=True), SimpleNamespace())
    assert not response.success
    assert response.message == "the control thread did not respond"
    resume.set()
    loop.call(lambda: None).result(5.0)
    assert loop.safety.state is State.DISABLED


def test_a_dead_control_thread_is_a_failure_of_the_node(rig, make_bridge):
    bridge = make_bridge()
    assert bridge.trigger_configure() is SUCCESS
    assert bridge.trigger_activate() is SUCCESS
    assert bridge.failure is None
    bridge._loop.safety.step = raises(RuntimeError("broken"))
    wait_until(lambda: bridge.failure)
    assert str(bridge.failure) == "broken"


def raises(error: Exception) -> Callable[..., None]:
    """Return a function that raises `error`."""

    def fail(*_: object) -> None:
        raise error

    return fail
