# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The control loop on the simulated arm, in virtual time: whatever raises an exception, the arm is let down.

Also where its motors are on two buses.
"""

from __future__ import annotations

from dataclasses import replace

import can
import pytest

from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.core.safety.power import Power
from exo_gravity.hardware import control_loop
from exo_gravity.hardware.can.can_port import CanPort, message_of
from exo_gravity.hardware.can.motor_bus import FOREIGN_COMMAND, MotorBus
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.control_loop import HAND_OVER_TIME, LONGEST_ABSENCE, LOWERING, ControlLoop, NoController
from exo_gravity.sim.virtual_time import Wire

from ..support.thorough import quick
from .rig import CYCLE, FIRST, LIMITS, MOTORS_OF_ARM, SECOND, CarriedArm, TwoBusRig, VirtualRig, raised_arm
from .wires import Responder

OPPOSED_SPEED = 0.5  # rad/s, of 6 unopposed


def fail(*_: object) -> None:
    raise ZeroDivisionError("division by zero")


def test_stopping_lets_the_arm_down_and_switches_the_motors_off():
    arm = raised_arm()
    assert arm.loop.stop()
    arm.rig.assert_let_down()
    assert not arm.drives[-1].powered
    assert not arm.loop.cycle()


def test_an_arm_is_let_down_after_its_computer_was_suspended():
    arm = raised_arm()
    arm.clock.slept += 0.9  # less may be a thread that was not run
    arm.run(0.1)
    assert arm.safety.state is State.ACTIVE
    arm.clock.slept += 3600.0
    arm.run(2 * CYCLE)
    assert arm.safety.fault[:2] == ("motor_silent", "the computer was suspended for 3601 s")
    arm.assert_let_down()


@pytest.mark.parametrize(
    "error", [ValueError("garbled line"), pytest.param(OSError("no device"), marks=pytest.mark.thorough)]
)
def test_an_exception_of_the_bus_lets_the_arm_down_on_a_bus_that_was_opened_again(error):
    arm = raised_arm()
    arm.wire.break_down(error)
    arm.run_until(lambda: arm.wire.opened == 2)
    assert arm.safety.fault.code == "bus_error"
    assert str(error) in arm.safety.fault.reason
    arm.assert_let_down()


def test_a_bus_that_stays_away_is_tried_again_and_the_torque_continues_from_what_the_motors_hold():
    arm = raised_arm()
    held = arm.drives[-1].effort[1]
    arm.wire.refusal = BusError("no such device")
    arm.wire.break_down(OSError("no such device"))
    arm.run_until(lambda: arm.safety.is_unreached)
    arm.run(1.0)
    assert arm.rig.motors_on == [True] * 4
    assert not arm.loop.is_off
    assert arm.drives[-1].powered
    count = len(arm.drives)
    arm.wire.refusal = None
    arm.run_until(lambda: arm.wire.opened == 2)
    arm.run_until(lambda: len(arm.drives) > count + 10)
    first = [drive.effort[1] for drive in arm.drives[count:]]
    assert max(abs(effort - held) for effort in first[:5]) < 0.3
    arm.assert_let_down()


def test_a_controller_that_fails_at_samples_never_stops_the_control():
    arm = raised_arm()
    arm.controller.failures["take"] = ZeroDivisionError("division by zero")
    before = arm.loop.cycles
    arm.run(0.2)
    assert arm.loop.cycle_errors == arm.loop.cycles - before > 20
    assert arm.safety.state is State.ACTIVE
    assert arm.loop.cycle_error == "ZeroDivisionError: division by zero"


def test_failing_efforts_let_the_arm_down():
    arm = raised_arm()
    arm.controller.failures["efforts"] = RuntimeError("no middleware")
    arm.run(2 * CYCLE)
    assert arm.safety.fault.code == "internal_error"
    assert "no middleware" in arm.safety.fault.reason
    arm.assert_let_down()
    assert arm.loop.failure is None


def test_an_arm_whose_owner_stands_still_is_let_down(monkeypatch):
    """Services, the lease and the look at the watchdog are the owner's: without it no one could let the arm down."""
    monkeypatch.setattr(control_loop, "LONGEST_ABSENCE", 1.0)
    arm = raised_arm()
    for _ in range(2):
        arm.loop.attended = arm.clock.monotonic()
        arm.run(0.9)
        assert arm.safety.state is State.ACTIVE
    arm.run(0.2)
    assert arm.safety.fault[:2] == ("internal_error", "no service and no timer of the node has run for 1 s")
    arm.assert_let_down()


def test_an_owner_that_waits_until_its_arm_is_down_causes_no_fault():
    arm = raised_arm()
    arm.loop.attended = arm.clock.monotonic()
    arm.safety.disable(arm.clock.monotonic())
    arm.assert_let_down()
    arm.run(2.0 * LONGEST_ABSENCE)
    assert arm.safety.fault is None


class Killed(BaseException):
    """What the watchdog does to the process."""


def test_a_failing_state_machine_hands_the_arm_over_to_the_watchdog_and_sends_nothing_until_it_is_killed():
    listeners: list[Responder] = []

    def hand_over(reason: str) -> bool:
        assert reason == "the control loop failed: ZeroDivisionError: division by zero"
        listeners.append(Responder(arm.wire))
        arm.clock.later(HAND_OVER_TIME - 0.01, kill)
        return True

    def kill() -> None:
        raise Killed

    arm = CarriedArm(hand_over=hand_over)
    arm.safety.step = fail
    with pytest.raises(Killed):
        arm.run(1.0)
    assert all(len(message.data) == 8 and message.data[0] < 5 for message in listeners[0].received)  # replies
    assert arm.rig.motors_on == [True] * 4
    assert arm.drives[-1].powered
    assert isinstance(arm.loop.failure, ZeroDivisionError)


def test_without_a_watchdog_a_failing_state_machine_is_replaced_by_damping_until_the_arm_is_down(monkeypatch):
    monkeypatch.setattr(control_loop, "LOWERING", replace(LOWERING, fade=4.0, rest=4.0))  # the whole: test_supply
    arm = raised_arm()
    arm.safety.step = fail
    while arm.loop.cycle():
        pass
    arm.rig.assert_let_down()


def test_a_failing_state_machine_ends_the_loop_of_an_arm_whose_motors_are_off():
    rig = VirtualRig(pose=NO_TORQUE, carried=False)
    loop = rig.loop_with().loop
    loop.safety.step = fail
    assert loop.cycle() and loop.cycle() and not loop.cycle()
    assert isinstance(loop.failure, ZeroDivisionError)
    assert rig.motors_on == [False] * 4


def test_a_call_runs_between_two_cycles_and_a_cancelled_one_never():
    loop = VirtualRig(pose=NO_TORQUE, carried=False).loop_with().loop
    calls: list[str] = []
    assert loop.call(lambda: calls.append("cancelled")).cancel()
    future, failing = loop.call(lambda: "result"), loop.call(fail)
    loop.cycle()
    assert future.result(0.0) == "result"
    assert isinstance(failing.exception(0.0), ZeroDivisionError)
    pending = loop.call(lambda: calls.append("too late"))
    loop.stop()
    assert pending.cancelled()
    assert calls == []


def test_a_cycle_that_took_too_long_is_counted_and_not_made_up():
    rig = VirtualRig(pose=NO_TORQUE, carried=False)
    loop = rig.loop_with().loop
    loop.cycle()
    loop.call(lambda: rig.clock.sleep(5.0 * CYCLE))
    loop.cycle()
    before = rig.clock.monotonic()
    loop.cycle()
    assert loop.late == 1
    assert rig.clock.monotonic() - before == pytest.approx(CYCLE)


def test_the_thread_runs_the_cycles_until_the_loop_is_stopped():
    wire = can.Bus(interface="virtual", channel="test_control_loop")
    bus = MotorBus([CanPort(wire, COMPUTER_CLOCK)] * len(MOTORS_OF_ARM), MOTORS_OF_ARM)
    loop = ControlLoop(bus, SafetyMachine(LIMITS, CYCLE), CYCLE, NoController())
    loop.start()
    assert loop.call(lambda: loop.cycles).result(10.0) >= 0
    assert loop.stop(10.0)
    assert not loop.cycle()


@pytest.mark.parametrize("echoes", [False, True])
def test_our_own_frames_are_never_foreign(echoes: bool):
    arm = raised_arm(echoes)
    arm.run(1.0)
    assert arm.bus.foreign_commands == 0
    assert arm.safety.state is State.ACTIVE
    assert ("echo" in arm.bus.ignored) == echoes


# An arm whose motors are on two buses: one safety unit.

FORMATS = pytest.mark.parametrize("wire_format", quick([MIT], [MIT, MIT_V3]), ids=["mit", "mit_v3"])


def carried(wire_format: WireFormat = MIT) -> CarriedArm:
    return raised_arm(wire_format=wire_format, kind=TwoBusRig)


def silence(wire: Wire, silent: bool = True) -> None:
    wire.loss = float(silent)


@FORMATS
def test_an_arm_on_two_buses_is_carried_and_each_motor_is_commanded_on_its_own(wire_format: WireFormat) -> None:
    arm = carried(wire_format)
    before, counted = arm.loop.incomplete, arm.loop.cycles
    arm.run(1.0)
    assert arm.rig.is_raised and arm.loop.cycles > counted + 100
    assert arm.loop.incomplete == before
    assert not any(half.strays for half in arm.rig.halves)
    arm.safety.disable(arm.clock.monotonic())
    arm.assert_let_down()


def test_both_buses_are_sent_their_commands_before_the_replies_of_either_are_awaited() -> None:
    """The replies take 0.2 to 0.4 ms on each bus: awaited one after the other they take longer than together."""
    rig = TwoBusRig()
    bus = MotorBus(rig.arm.ports(rig.clock), rig.motors, clock=rig.clock)
    rig.first.batch = rig.second.batch = 0.003  # the adapters deliver both together
    for _ in range(20):
        start = rig.clock.monotonic()
        assert bus.exchange(rig.drive, start + 0.007)
        assert rig.clock.monotonic() - start < 0.005


@FORMATS
@pytest.mark.parametrize("dead", quick([SECOND], [FIRST, SECOND]), ids=["first", "second"])
def test_a_silent_bus_lets_the_whole_arm_down_and_its_motors_once_they_reply(
    wire_format: WireFormat, dead: str
) -> None:
    arm = carried(wire_format)
    rig = arm.rig
    live = [0, 1] if dead == SECOND else [2, 3]
    silence(rig.wires[dead])
    arm.run(0.2)
    assert arm.safety.state is State.LETTING_DOWN and arm.safety.fault
    assert arm.safety.fault.code is FaultCode.MOTOR_SILENT
    assert f"no motor on {dead} replies: the bus is lost, or the supply is cut" in arm.safety.fault.reason
    assert all(rig.damping[joint] > 0.3 * DAMPING for joint in live)
    arm.run_until(lambda: arm.safety.is_unreached)
    assert not any(arm.safety.limits.is_silent(arm.clock.monotonic(), arm.loop.samples[joint]) for joint in live)
    assert not arm.loop.is_off
    silence(rig.wires[dead], False)
    arm.assert_let_down()


def test_a_bus_that_fails_does_not_keep_the_other_from_its_commands() -> None:
    arm = carried()
    rig = arm.rig
    rig.second.refusal = BusError("no such device")
    rig.second.break_down(can.CanOperationError("No buffer space available"))
    arm.run(0.2)
    assert arm.safety.fault and arm.safety.fault.code is FaultCode.BUS_ERROR
    assert all(damping > 0.3 * DAMPING for damping in rig.damping[:2])
    assert rig.damping[2:] == [0.0, 0.0]
    rig.second.refusal = None  # it is plugged in again
    rig.second.broken = set()
    arm.assert_let_down()


def test_motors_on_a_bus_that_fails_while_they_are_switched_off_are_not_taken_for_off() -> None:
    arm = carried()
    rig = arm.rig
    arm.safety.disable(arm.clock.monotonic())
    arm.run_until(lambda: arm.safety.power[2].state is Power.LEAVING)
    rig.second.refusal = BusError("no such device")
    rig.second.break_down(can.CanOperationError("Network is down"))
    arm.run(0.5)
    assert not arm.loop.is_off
    rig.second.refusal = None
    rig.second.broken = set()
    arm.run_until(lambda: arm.loop.is_off)
    assert rig.motors_on == [False] * 4


def test_a_command_to_a_motor_that_is_on_the_other_bus_is_no_foreign_command() -> None:
    rig = TwoBusRig()
    bus = MotorBus(rig.arm.ports(rig.clock), rig.motors, clock=rig.clock)
    command = message_of((3, rig.motors[2].command(1.0, 0.0)))
    rig.first.carry(None, command)
    bus.receive_until(rig.clock.monotonic() + CYCLE)
    assert bus.ignored == {"foreign frame": 1} and not bus.foreign_commands
    rig.second.carry(None, command)
    bus.receive_until(rig.clock.monotonic() + CYCLE)
    assert bus.ignored[FOREIGN_COMMAND] == bus.foreign_commands == 1
