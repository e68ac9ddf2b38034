# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What is late, in virtual time: efforts, over which the arm is carried on; and replies, behind a queue or lost frames.

Judged by the arm's true motion.
"""

from __future__ import annotations

import numpy as np
import pytest

from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.hardware.request_age import AGE, Requests
from exo_gravity.sim.virtual_time import VirtualBus

from .arms import REAL_RATE, raised_usual_arm

CYCLE = 1.0 / REAL_RATE  # s
SPEED = 0.6  # rad/s
STEP = 0.35  # Nm within 2 ms: a frame may change the torque by 0.2, and the hand moves the damped joint


def test_a_wearer_who_moves_is_slowed_gently_while_efforts_are_late():
    """An arm that is held: rows of the fault matrix."""
    arm = raised_usual_arm((0.0, 1.3, 0.0, 0.3), has_wearer=False, mode="one_g")
    position = arm.device.arm.positions
    arm.act({"move": np.add(position, (0.0, -0.5, 0.0, 0.5)).tolist(), "over": 1.25})
    arm.run(0.45)
    assert max(map(abs, arm.device.arm.velocities)) > 0.9
    arm.forget()
    last = arm.controller.efforts(arm.now)
    arm.controller.change = lambda efforts: last
    arm.run(0.1)
    arm.controller.change = None
    arm.run(0.4)
    assert arm.state is State.ACTIVE and arm.safety.ride.rides == 1
    beyond = np.abs(arm.records["torque"] - arm.records["weight"]).max()
    step = np.abs(np.diff(arm.records["torque"][::2], axis=0)).max()
    assert arm.fastest < 1.1 and beyond < 1.8 and step < STEP


# Queues between the bridge and its motors, and lost frames, which look the same for a while.


class Line:
    """A motor behind a line, asked in every cycle. delay: s for which a command is under way, with its reply.

    lost: whether the command of a cycle is lost. asked: count of the commands that were sent.
    """

    def __init__(self, cycle: float = CYCLE) -> None:
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
        line.now += CYCLE
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
    assert line.asked - asked >= 2.0 / CYCLE - 6
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

    def failing(*_):
        raise OSError(105, "No buffer space available")

    for _ in range(10):
        monkeypatch.setattr(VirtualBus, "send", failing)
        arm.cycle()
        monkeypatch.setattr(VirtualBus, "send", send)
        arm.run(0.1)
    assert arm.state is State.ACTIVE, arm.safety.fault
    monkeypatch.setattr(VirtualBus, "send", failing)
    arm.run(0.02)
    assert (arm.state, arm.fault) == (State.LETTING_DOWN, FaultCode.BUS_ERROR)
