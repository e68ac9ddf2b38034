# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The control loop on the simulated arm, in virtual time: whatever raises an exception, the arm is let down.

Also where its motors are on two buses, where another owner left them on, and where replies are late.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import can
import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.ak import MIT, MIT_V3
from exo_gravity.core.motors.frames import WireFormat
from exo_gravity.core.numbers import NO_TORQUE
from exo_gravity.core.safety.command import FaultCode, State
from exo_gravity.core.safety.limits import DAMPING
from exo_gravity.core.safety.watch import Power
from exo_gravity.hardware import control_loop
from exo_gravity.hardware.can_port import CanPort, message_of
from exo_gravity.hardware.clock import COMPUTER_CLOCK
from exo_gravity.hardware.control_loop import HAND_OVER_TIME, LOWERING, ControlLoop, NoController
from exo_gravity.hardware.motor_bus import FOREIGN_COMMAND, MotorBus
from exo_gravity.hardware.request_age import AGE, Requests
from exo_gravity.sim.virtual_time import VirtualBus

from ..support.simulated_device import command_of
from ..support.thorough import quick
from .arms import (
    CYCLE,
    DRIVEN,
    FIRST,
    LIMITS,
    MOTORS_OF_ARM,
    ON_TWO,
    REAL_RATE,
    SECOND,
    CarriedArm,
    Responder,
    cut,
    lose_bus,
    raised_usual_arm,
)
from .arms import raised_arm as raised


def fail(*_: object) -> None:
    raise ZeroDivisionError("division by zero")


def test_an_arm_is_let_down_after_its_computer_was_suspended():
    arm = raised()
    arm.clock.slept += 0.9  # less may be a thread that was not run
    arm.run(0.1)
    assert arm.state is State.ACTIVE and arm.safety.watch.trusted
    arm.clock.slept += 3600.0
    arm.run(2 * CYCLE)
    assert (*arm.safety.fault[:2], arm.safety.watch.trusted) == (
        "motor_silent", "the computer was suspended for 3601 s", False,  # a supply may have been cut meanwhile
    )  # fmt: skip
    arm.assert_let_down()


def test_a_bus_that_fails_is_opened_again_and_the_torque_continues_from_what_the_motors_hold():
    arm = raised()
    held = arm.notes.command.effort[1]
    arm.wire.refusal = BusError("no such device")
    arm.wire.break_down(ValueError("garbled line"))
    assert arm.run_until(lambda: arm.safety.is_unreached)
    assert arm.fault == "bus_error" and "garbled line" in arm.safety.fault.reason
    arm.run(1.0)
    assert all(arm.motors_on) and not arm.loop.is_off and arm.notes.command.powered
    arm.wire.refusal = None
    assert arm.run_until(lambda: arm.wire.opened == 2)
    for _ in range(5):
        arm.cycle()
        assert abs(arm.notes.command.effort[1] - held) < 0.3
    arm.assert_let_down()


def test_a_controller_that_fails_at_samples_never_stops_the_control():
    arm = raised()
    take, before = arm.controller.take, arm.loop.cycles

    def take_and_fail(now, samples):
        take(now, samples)
        fail()

    arm.controller.take = take_and_fail
    arm.run(0.2)
    assert arm.loop.cycle_errors == arm.loop.cycles - before > 20
    assert arm.state is State.ACTIVE and arm.loop.cycle_error == "ZeroDivisionError: division by zero"


def test_failing_efforts_let_the_arm_down():
    arm = raised()
    arm.controller.efforts = fail
    arm.run(2 * CYCLE)
    assert arm.fault == "internal_error" and "division by zero" in arm.safety.fault.reason
    arm.assert_let_down()
    assert arm.loop.failure is None


def test_an_arm_whose_owner_stands_still_is_let_down(monkeypatch):
    """Services, the lease and the look at the watchdog are the owner's: without it no one could let the arm down."""
    monkeypatch.setattr(control_loop, "LONGEST_ABSENCE", 1.0)
    waiting, arm = raised(), raised()
    waiting.safety.disable(waiting.now)  # until the arm is down, which is no fault
    for each in (waiting, arm, arm):
        each.loop.attended = each.now
        each.run(0.9)
    waiting.run(0.2)
    assert (waiting.fault, arm.state) == ("", State.ACTIVE)
    arm.run(0.2)
    assert arm.safety.fault[:2] == ("internal_error", "no service and no timer of the node has run for 1 s")


class Killed(BaseException):
    """What the watchdog does to the process."""


def kill() -> None:
    raise Killed


def test_a_failing_state_machine_hands_the_arm_over_to_the_watchdog_and_sends_nothing_until_it_is_killed():
    listeners: list[Responder] = []

    def hand_over(reason: str) -> bool:
        assert reason == "the control loop failed: ZeroDivisionError: division by zero"
        listeners.append(Responder(arm.wire))
        arm.clock.later(HAND_OVER_TIME - 0.01, kill)
        return True

    arm = raised()
    arm.loop._hand_over = hand_over
    arm.safety.step = fail
    with pytest.raises(Killed):
        arm.run(1.0)
    assert all(len(message.data) == 8 and message.data[0] < 5 for message in listeners[0].received)  # replies
    assert all(arm.motors_on) and arm.notes.command.powered
    assert isinstance(arm.loop.failure, ZeroDivisionError)


@pytest.mark.parametrize("supply", [0.0, 2.0])
def test_without_a_watchdog_a_failing_state_machine_is_replaced_by_damping_until_the_arm_is_down(supply, monkeypatch):
    monkeypatch.setattr(control_loop, "LOWERING", replace(LOWERING, fade=4.0, rest=4.0))
    arm = raised()
    arm.safety.step = fail
    if supply:  # is cut for so many s, and the motors stay off when their supply returns
        arm.clock.later(1.0, partial(cut(supply), arm))
        arm.clock.later(1.0 + supply, arm.forget)
    while arm.loop.cycle():
        pass
    assert not supply or not arm.records["on"].any()
    arm.assert_down()


def test_a_failing_state_machine_ends_the_loop_of_an_arm_whose_motors_are_off():
    arm = CarriedArm()
    arm.safety.step = fail
    assert arm.cycle() and arm.cycle() and not arm.cycle()
    assert isinstance(arm.loop.failure, ZeroDivisionError) and not arm.device.powered


def test_a_call_runs_between_two_cycles_and_a_cancelled_one_never():
    loop, calls = CarriedArm().loop, []
    assert loop.call(lambda: calls.append("cancelled")).cancel()
    future, failing = loop.call(lambda: "result"), loop.call(fail)
    loop.cycle()
    assert future.result(0.0) == "result" and isinstance(failing.exception(0.0), ZeroDivisionError)
    pending = loop.call(lambda: calls.append("too late"))
    loop.stop()
    assert pending.cancelled() and calls == []


def test_a_cycle_that_took_too_long_is_counted_and_not_made_up():
    arm = CarriedArm()
    arm.cycle()
    arm.between_cycles(lambda now: arm.clock.sleep(5.0 * CYCLE))
    arm.cycle()
    before = arm.now
    arm.cycle()
    assert arm.loop.late == 1 and arm.now - before == pytest.approx(CYCLE)


def test_the_thread_runs_the_cycles_until_the_loop_is_stopped():
    wire = can.Bus(interface="virtual", channel="test_control_loop")
    bus = MotorBus([CanPort(wire, COMPUTER_CLOCK)] * len(MOTORS_OF_ARM), MOTORS_OF_ARM)
    loop = ControlLoop(bus, LIMITS, CYCLE, NoController())
    loop.start()
    assert loop.call(lambda: loop.cycles).result(10.0) >= 0
    assert loop.stop(10.0)
    assert not loop.cycle()


def test_our_own_frames_are_never_foreign():
    arm = raised(echoes=True)
    arm.run(1.0)
    assert arm.bus.foreign_commands == 0 and "echo" in arm.bus.ignored and arm.state is State.ACTIVE


# An arm whose motors are on two buses: one safety unit.


def test_both_buses_are_sent_their_commands_before_the_replies_of_either_are_awaited() -> None:
    """The replies take 0.2 to 0.4 ms on each bus: awaited one after the other they take longer than together."""
    arm = CarriedArm(channel=ON_TWO)
    for wire in arm.wires.values():
        wire.batch = 0.003  # the adapters deliver both together
    for _ in range(20):
        start = arm.now
        assert arm.bus.exchange(command_of(NO_TORQUE), start + 0.007)
        assert arm.now - start < 0.005


def silence(arm: CarriedArm, name: str) -> None:
    arm.wires[name].loss = 1.0


def plug_in(arm: CarriedArm, name: str) -> None:
    arm.wires[name].loss, arm.wires[name].refusal, arm.wires[name].broken = 0.0, None, set()


SILENT = (silence, FaultCode.MOTOR_SILENT, "no motor on {} replies: the bus is lost, or the supply is cut")
BROKEN = (lose_bus, FaultCode.BUS_ERROR, "No buffer space available")


LOST = [(MIT, SECOND, *SILENT), (MIT, FIRST, *SILENT), (MIT_V3, SECOND, *SILENT), (MIT, SECOND, *BROKEN)]


@pytest.mark.parametrize(
    ("wire_format", "dead", "lose", "code", "said"),
    quick(LOST[:1], LOST),
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_bus_that_is_lost_lets_the_whole_arm_down_and_its_motors_once_they_are_reached(
    wire_format: WireFormat, dead: str, lose: Callable[[CarriedArm, str], None], code: FaultCode, said: str
) -> None:
    arm = raised(channel=ON_TWO, wire_format=wire_format)
    live = [0, 1] if dead == SECOND else [2, 3]
    before = [motor.damping for motor in arm.motors]
    lose(arm, dead)
    arm.run(0.2)
    assert arm.state is State.LETTING_DOWN and arm.safety.fault and arm.safety.fault.code is code
    assert said.format(dead) in arm.safety.fault.reason
    for joint, (motor, last) in enumerate(zip(arm.motors, before, strict=True)):
        assert motor.damping > 0.3 * DAMPING if joint in live else motor.damping == pytest.approx(last, abs=0.2)
    assert arm.run_until(lambda: arm.safety.is_unreached)
    assert not any(arm.safety.limits.is_silent(arm.now, arm.loop.samples[joint]) for joint in live)
    assert not arm.loop.is_off
    plug_in(arm, dead)
    arm.assert_let_down()


def test_motors_on_a_bus_that_fails_while_they_are_switched_off_are_not_taken_for_off() -> None:
    arm = raised(channel=ON_TWO)
    arm.safety.disable(arm.now)
    assert arm.run_until(lambda: arm.safety.watch.joints[2].power is Power.LEAVING)
    lose_bus(arm, SECOND)
    arm.run(0.5)
    assert not arm.loop.is_off
    plug_in(arm, SECOND)
    arm.assert_let_down()


def test_a_command_to_a_motor_that_is_on_the_other_bus_is_no_foreign_command() -> None:
    arm = CarriedArm(channel=ON_TWO)
    command = message_of((3, MOTORS_OF_ARM[2].command(1.0, 0.0)))
    for name, expected in ((FIRST, 0), (SECOND, 1)):
        arm.wires[name].carry(None, command)
        arm.bus.receive_until(arm.now + CYCLE)
        assert arm.bus.foreign_commands == arm.bus.ignored[FOREIGN_COMMAND] == expected
    assert arm.bus.ignored["foreign frame"] == 1


# Motors that another owner left.


def next_loop(arm: CarriedArm) -> ControlLoop:
    """Return the loop of an owner that knows nothing of the last one."""
    bus = MotorBus(arm.on_bus.ports(arm.clock), arm.on_bus.motors, clock=arm.clock)
    bus.listen()
    return ControlLoop(bus, arm.on_bus.limits, CYCLE, NoController())


@pytest.mark.parametrize(
    ("wire_format", "silent_for"),
    quick([(MIT_V3, 3.0)], [(MIT, 0.0), (MIT_V3, 3.0)]),
    ids=["at once", "reached late"],
)
def test_motors_that_an_owner_without_notes_left_on_are_damped_and_let_down(
    wire_format: WireFormat, silent_for: float
) -> None:
    arm = raised(wire_format=wire_format).leave()
    arm.device.bus_silent = silent_for > 0.0
    arm.clock.later(silent_for, partial(setattr, arm.device, "bus_silent", False))
    loop, end = next_loop(arm), arm.now + 30.0
    loop.safety.enable(arm.now)  # refused: the arm does not hang
    while arm.now < end and (arm.device.powered or not loop.is_off):
        loop.cycle()
    arm.assert_down()
    assert arm.fastest < DRIVEN  # 5.3 rad/s where the first frame is zero torque


@pytest.mark.parametrize(("make", "is_on"), [(CarriedArm, False), (raised, True)], ids=["off", "on"])
def test_a_loop_can_end_at_once_while_no_motor_was_ever_heard(make: Callable[[], CarriedArm], is_on: bool) -> None:
    arm = make().leave()
    arm.device.bus_silent = True
    loop = next_loop(arm)
    loop.cycle()
    arm.device.bus_silent = False
    loop.stop()
    assert arm.motors_on == [is_on] * 4  # not known, so nothing was sent


# Replies that are late, in virtual time: behind a queue between the bridge and its motors, or by lost frames.

REAL_CYCLE = 1.0 / REAL_RATE  # s
SPEED = 0.6  # rad/s


class Line:
    """A motor behind a line, asked in every cycle. delay: s for which a command is under way, with its reply.

    lost: whether the command of a cycle is lost. asked: count of the commands that were sent.
    """

    def __init__(self, cycle: float = REAL_CYCLE) -> None:
        self.requests, self.now, self.cycle = Requests(), 0.0, cycle
        self.asked = 0
        self._replies: list[float] = []

    def run(self, duration: float, delay=lambda now: 0.0003, lost=lambda count: False) -> float:
        """Let `duration` s pass, or less: until the replies are late; return how old the newest one is then."""
        end = self.now + duration
        while self.now < end and not self.requests.late:
            if self.requests.may_send(self.now, self.cycle):
                self.requests.sent(self.now, 1)
                self.asked += 1
                if not lost(self.asked):
                    self._replies.append(self.now + delay(self.now))
            self.now += self.cycle
            for due in [due for due in self._replies if due <= self.now]:
                self._replies.remove(due)
                self.requests.replied(due)
        return delay(self.now)


@pytest.mark.parametrize("rate", [100.0, 250.0, 1000.0])
def test_a_queue_that_grows_is_found_before_it_is_long(rate):
    line = Line(1.0 / rate)
    age = line.run(30.0, delay=lambda now: 0.0003 + 0.02 * now)
    assert line.requests.late > AGE.longest and AGE.longest < age < 0.08


def test_a_queue_that_is_there_at_once_is_found_and_forgotten_once_it_is_gone():
    line = Line()
    line.run(1.0)
    line.run(1.0, delay=lambda now: 0.1)
    assert line.requests.late > AGE.longest
    for _ in range(20):  # what was under way arrives
        line.now += REAL_CYCLE
        line.requests.may_send(line.now, line.cycle)
    line.run(1.0)
    assert not line.requests.late


NO_QUEUES = {
    "a device that stands still for 60 ms, five times a second, and then answers all at once": (
        (100.0, 250.0, 1000.0), lambda now: max(0.0003, 0.06 - now % 0.2), 10.0, 0),
    "6 % of the frames lost": ((50.0, 250.0, 1000.0), lambda now: 0.0003, 20.0, 16),
    "6 % of the frames lost, an adapter's timer of 16 ms": ((50.0, 250.0, 1000.0), lambda now: 0.016, 20.0, 16),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_QUEUES)
def test_what_is_no_queue_is_none_and_holds_up_few_commands(name):
    rates, delay, duration, lost = NO_QUEUES[name]
    for rate in rates:
        line = Line(1.0 / rate)
        line.run(duration, delay, lambda count: lost and count % lost == 0)
        assert line.now == pytest.approx(duration, abs=0.1)
        assert not line.requests.late
        assert not lost or line.asked > 0.9 * duration * rate


def test_a_motor_that_does_not_reply_is_still_asked_in_every_cycle_and_replies_that_come_back_are_no_queue():
    line = Line()
    line.run(1.0)
    asked = line.asked
    line.run(2.0, lost=lambda count: True)
    assert line.asked - asked >= 2.0 / REAL_CYCLE - 6
    line.run(5.0)
    assert not line.requests.late


def test_an_arm_behind_a_queue_that_grows_is_let_down_gently_before_the_queue_matters():
    arm = raised_usual_arm()
    begin, carry = arm.now, arm.wire.carry

    def queue(sender, message, *sent):
        is_command = sender is not None and message.arbitration_id and message.data[0] in (0x7F, 0x80)
        if is_command:
            arm.clock.later(0.02 * (arm.now - begin), lambda: carry(sender, message, *sent))
        else:
            carry(sender, message, *sent)

    arm.wire.carry = queue
    assert arm.run_until(lambda: arm.safety.state is not State.ACTIVE, 20.0)
    # The pause that is to tell can itself make a motor silent.
    assert arm.safety.fault.code in (FaultCode.REPLIES_LATE, FaultCode.MOTOR_SILENT)
    assert 0.02 * (arm.now - begin) < 0.1
    arm.run(8.0)
    assert arm.fastest < SPEED


def test_a_reading_is_as_old_as_the_command_that_it_answers():
    arm = raised_usual_arm()
    assert arm.run_until(lambda: all(arm.now - sample.time >= 0.0002 for sample in arm.bus.samples), 0.1)


def test_a_send_that_fails_once_is_a_lost_frame_and_a_bus_that_fails_for_longer_a_fault(monkeypatch):
    arm, send = raised_usual_arm(), VirtualBus.send

    for _ in range(10):
        monkeypatch.setattr(VirtualBus, "send", fail)
        arm.cycle()
        monkeypatch.setattr(VirtualBus, "send", send)
        arm.run(0.1)
    assert arm.state is State.ACTIVE, arm.safety.fault
    monkeypatch.setattr(VirtualBus, "send", fail)
    arm.run(0.02)
    assert (arm.state, arm.fault) == (State.LETTING_DOWN, FaultCode.BUS_ERROR)
