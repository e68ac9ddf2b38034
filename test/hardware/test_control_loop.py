"""The control loop on the simulated arm: whatever raises an exception, the arm is let down, and its log is honest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.joint_motor import peaks_of
from exo_gravity.core.motors.specs import EXIT
from exo_gravity.core.safety.drive import NOTHING, Drive, State
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.hardware import control_loop
from exo_gravity.hardware.can.motor_bus import MotorBus
from exo_gravity.hardware.control_loop import ControlLoop, EffortCommand
from exo_gravity.hardware.ownership import last_resort

from .simulated_rig import LIMITS, MOTORS_OF_ARM, PERIOD, SimulatedRig, wait_until

pytestmark = pytest.mark.real_time
OPPOSED_SPEED = 2.0  # rad/s, of 6 unopposed; here the loop, the motors and the other sender share one interpreter


class FailingBus(can.BusABC):
    """The bus of `rig`, which fails when told to. error: raised by each use; opened: how many buses were opened."""

    def __init__(self, rig: SimulatedRig) -> None:
        self._rig = rig
        self.error: Exception | None = None
        self.refusal: Exception | None = None
        self.opened = 0
        self.reopen()

    def reopen(self) -> FailingBus:
        if self.refusal:
            raise self.refusal
        self.opened += 1
        self._bus = self._rig.open()
        self.channel_info = self._bus.channel_info
        return self

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.error:
            raise self.error
        self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.error:
            raise self.error
        return self._bus.recv(timeout)

    def shutdown(self) -> None:
        self.error = None
        self._bus.shutdown()


class Carried:
    """An arm that a control loop carries, from a state machine that is already ACTIVE."""

    def __init__(self, rig: SimulatedRig, **options: Callable[..., object]) -> None:
        self.rig = rig
        self.bus = FailingBus(rig)
        self.drives: list[Drive] = []
        self.motors = MotorBus(self.bus, MOTORS_OF_ARM, powered=True, note=self.drives.append, reopen=self.bus.reopen)
        self.motors.exchange(Drive(rig.carrying, NOTHING, True), time.monotonic() + 1.0)
        self.safety = SafetyMachine(LIMITS, PERIOD, peaks_of(MOTORS_OF_ARM))
        self.safety.state = State.ACTIVE
        self.safety._sent = Drive(rig.carrying, NOTHING, True)
        self.failure_of_efforts: Exception | None = None
        self.loop = ControlLoop(self.motors, self.safety, PERIOD, get_efforts=self._get_efforts, **options)
        self.loop.start()

    def _get_efforts(self, latest: float) -> EffortCommand:
        if self.failure_of_efforts:
            raise self.failure_of_efforts
        return EffortCommand(self.rig.carrying, time.monotonic())

    def wait_until_down(self) -> None:
        wait_until(lambda: self.loop.is_off)
        self.rig.assert_let_down()


@pytest.fixture
def carry(make_rig: Callable[..., SimulatedRig]) -> Iterator[Callable[..., Carried]]:
    arms: list[Carried] = []

    def carry(interface: str = "virtual", **options: Callable[..., object]) -> Carried:
        arms.append(Carried(make_rig(interface=interface, carried=True), **options))
        time.sleep(0.2)
        assert arms[-1].safety.state is State.ACTIVE
        return arms[-1]

    yield carry
    for arm in arms:
        arm.loop.abandon()


def test_stopping_lets_the_arm_down_and_switches_the_motors_off(carry):
    arm = carry()
    assert arm.loop.stop(60.0)
    arm.rig.assert_let_down()
    assert not arm.drives[-1].powered


def test_an_abandoned_arm_receives_no_further_frame(carry):
    arm = carry()
    arm.loop.abandon()
    assert arm.rig.motors_on == [True] * 4
    assert arm.drives[-1].powered


@pytest.mark.parametrize("error", [ValueError("garbled line"), can.CanOperationError("down"), OSError("no device")])
def test_an_exception_of_the_bus_lets_the_arm_down_on_a_bus_that_was_opened_again(carry, error):
    arm = carry()
    arm.bus.error = error
    wait_until(lambda: arm.bus.opened == 2)
    assert arm.safety.fault.code == "bus_error"
    assert str(error) in arm.safety.fault.reason
    arm.wait_until_down()


def test_a_bus_that_stays_away_is_tried_again_without_end_and_the_torque_continues_from_what_the_motors_hold(carry):
    arm = carry()
    arm.bus.refusal = BusError("no such device")
    arm.bus.error = OSError("no such device")
    wait_until(lambda: arm.safety.is_unreached)
    assert arm.rig.motors_on == [True] * 4
    assert not arm.loop.is_off
    assert arm.drives[-1].powered
    held = arm.rig.device.motors[1]._command.torque
    count = len(arm.drives)
    arm.bus.refusal = None
    wait_until(lambda: arm.bus.opened == 2)
    wait_until(lambda: len(arm.drives) > count + 10)
    first = [drive.effort[1] for drive in arm.drives[count:]]
    assert max(abs(effort - held) for effort in first[:5]) < 0.3
    arm.wait_until_down()


def test_a_failing_publisher_never_stops_the_control(carry):
    def fail(now: float, samples: object) -> None:
        raise RuntimeError("no middleware")

    arm = carry(on_cycle=fail)
    wait_until(lambda: arm.loop.cycle_errors > 20)
    assert arm.safety.state is State.ACTIVE
    assert arm.loop.cycle_error == "RuntimeError: no middleware"


def test_failing_efforts_let_the_arm_down(carry):
    arm = carry()
    arm.failure_of_efforts = RuntimeError("no middleware")
    arm.wait_until_down()
    assert arm.safety.fault.code == "internal_error"
    assert arm.loop.failure is None


def test_a_failing_state_machine_hands_the_arm_over_to_the_watchdog(carry, monkeypatch):
    reasons: list[str] = []
    hand_over = threading.Event()

    def note(reason: str) -> bool:
        reasons.append(reason)
        hand_over.set()
        return True

    monkeypatch.setattr(control_loop, "HAND_OVER_TIME", 1.0)  # here nothing ends this process
    monkeypatch.setattr(last_resort, "lower", lambda *_: None)
    arm = carry(hand_over=note)
    arm.safety.step = lambda *_: 1 / 0
    assert hand_over.wait(1.0)
    assert reasons == ["the control loop failed: ZeroDivisionError: division by zero"]
    assert arm.rig.motors_on == [True] * 4
    assert arm.drives[-1].powered
    assert isinstance(arm.loop.failure, ZeroDivisionError)


def test_without_a_watchdog_a_failing_state_machine_is_replaced_by_damping_until_the_arm_is_down(carry, monkeypatch):
    monkeypatch.setattr(last_resort, "REST_TIME", 3.0)
    monkeypatch.setattr(last_resort, "FADE_TIME", 5.0)
    arm = carry()
    arm.safety.step = lambda *_: 1 / 0
    wait_until(lambda: not any(arm.rig.motors_on), 60.0)
    arm.rig.assert_let_down()


def test_a_failing_state_machine_ends_the_loop_of_an_arm_whose_motors_are_off(make_rig):
    rig = make_rig()
    safety = SafetyMachine(LIMITS, PERIOD)
    loop = ControlLoop(MotorBus(rig.open(), MOTORS_OF_ARM), safety, PERIOD)
    loop.start()
    safety.step = lambda *_: 1 / 0
    wait_until(lambda: not loop.is_alive)
    assert isinstance(loop.failure, ZeroDivisionError)
    assert rig.motors_on == [False] * 4


def test_a_cancelled_call_never_runs(make_rig):
    rig = make_rig()
    loop = ControlLoop(MotorBus(rig.open(), MOTORS_OF_ARM), SafetyMachine(LIMITS, PERIOD), PERIOD)
    calls: list[str] = []
    assert loop.call(lambda: calls.append("cancelled")).cancel()
    loop.start()
    loop.call(lambda: calls.append("called")).result(5.0)
    loop.stop()
    assert calls == ["called"]


class Foreigner:
    """Another sender that sends `data` to motor 2 every `period` s."""

    def __init__(self, rig: SimulatedRig, data: bytes, period: float) -> None:
        self._bus, self._data, self._period = rig.open(), data, period
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._stop.wait(self._period):
            self._bus.send(can.Message(arbitration_id=2, data=self._data, is_extended_id=False))


@pytest.mark.parametrize(
    ("interface", "data", "period"),
    [
        ("virtual", EXIT, 0.1),
        ("udp_multicast", EXIT, 0.004),
        ("virtual", MOTORS_OF_ARM[1].command(6.0, 0.0), 0.002),
        ("udp_multicast", MOTORS_OF_ARM[1].command(6.0, 0.0), 0.002),
        ("virtual", MOTORS_OF_ARM[1].command(0.0, 0.0), 0.01),
    ],
    ids=["EXIT at 10 Hz", "EXIT at 250 Hz", "6 Nm at 500 Hz", "6 Nm at 500 Hz, echoed", "0 Nm at 100 Hz"],
)
def test_foreign_commands_are_opposed_at_once_and_the_arm_is_let_down(carry, interface, data, period):
    arm = carry(interface)
    assert arm.motors.foreign_commands == 0
    with Foreigner(arm.rig, data, period):
        wait_until(lambda: arm.safety.fault)
        time.sleep(1.0)
        assert arm.safety.state is State.LETTING_DOWN
        assert arm.rig.top_speed < OPPOSED_SPEED
    assert arm.safety.fault.code == "foreign_command"
    assert "another sender commands motor 2" in arm.safety.fault.reason
    assert arm.rig.top_speed < OPPOSED_SPEED


@pytest.mark.parametrize("interface", ["virtual", "udp_multicast"])
def test_our_own_frames_are_never_foreign(carry, interface):
    arm = carry(interface)
    wait_until(lambda: arm.loop.cycles > 250)
    assert arm.motors.foreign_commands == 0
    assert arm.safety.state is State.ACTIVE
    assert ("echo" in arm.motors.ignored) == (interface == "udp_multicast")


def test_a_foreign_command_refuses_the_start(make_rig):
    rig = make_rig(pose=NOTHING)
    safety = SafetyMachine(LIMITS, PERIOD)
    loop = ControlLoop(MotorBus(rig.open(), MOTORS_OF_ARM), safety, PERIOD)
    loop.start()
    assert loop.call(lambda: safety.enable(time.monotonic())).result(5.0)
    with Foreigner(rig, EXIT, 0.05):
        wait_until(lambda: safety.state is State.FAULT)
    assert safety.fault.code == "foreign_command"
    loop.stop()
