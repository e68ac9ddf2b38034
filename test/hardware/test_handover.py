"""Letting down an arm that a dead process left with its motors on."""

import itertools

import pytest

from exo_gravity.core.errors import BusError
from exo_gravity.core.motors.specs import ENTER, EXIT, MOTORS, unpack_command
from exo_gravity.core.safety.drive import NOTHING, Drive
from exo_gravity.core.safety.limits import MAX_EFFORT_RATE
from exo_gravity.hardware.ownership import handover
from exo_gravity.hardware.ownership.handover import Charge, let_down

from .simulated_rig import LIMITS, MOTORS_OF_ARM, PERIOD


def commands(listener, can_id):
    """Return the commands to motor `can_id` on the bus so far; ENTER and EXIT are None."""
    frames = [bytes(m.data) for m in iter(lambda: listener.recv(0.0), None) if m.arbitration_id == can_id]
    spec = MOTORS_OF_ARM[can_id - 1].spec
    return [None if f in (ENTER, EXIT) else unpack_command(spec, f) for f in frames if f[0] != can_id]


def test_the_arm_is_lowered_from_the_noted_torques_and_its_motors_are_switched_off(make_rig):
    rig = make_rig(carried=True)
    with rig.open() as listener:
        notes = []
        assert let_down(rig.charge, Drive(rig.carrying, NOTHING, True), notes.append)
        torques = [command.torque for command in commands(listener, 2) if command]
    assert torques[0] == pytest.approx(rig.carrying[1], abs=0.02)
    largest = max(abs(after - before) for before, after in itertools.pairwise(torques))
    assert largest <= MAX_EFFORT_RATE * PERIOD + 2 * MOTORS["AK80-9"].torque_range / 4095
    assert notes[0].powered and not notes[-1].powered
    rig.assert_let_down()


def test_the_noted_damping_is_kept(make_rig):
    rig = make_rig(carried=True)
    with rig.open() as listener:
        assert let_down(rig.charge, Drive(rig.carrying, (5.0,) * 4, True))
        damping = [command.kd for command in commands(listener, 2)[:50] if command]
    assert min(damping) == pytest.approx(5.0, abs=0.01)


def test_a_motor_that_has_lost_its_power_is_not_pushed_by_the_noted_torque(make_rig):
    """The operator cut the supply: the motors are off, and the arm hangs."""
    rig = make_rig(pose=NOTHING)
    assert let_down(rig.charge, Drive((0.0, 6.0, 2.0, 1.0), NOTHING, True))
    assert rig.top_speed < 0.01
    assert rig.motors_on == [False] * 4


def test_a_motor_that_does_not_reply_may_still_be_powered(make_rig):
    rig = make_rig(carried=True)
    rig.device.bus_silent = True
    log, notes = [], []
    assert not let_down(rig.charge, Drive(rig.carrying, NOTHING, True), notes.append, log.append, is_endless=False)
    assert log == ["a motor does not reply; it may still be powered; trying again"]
    assert notes[-1].powered
    assert notes[-1].effort[1] == pytest.approx(rig.carrying[1], abs=0.2)


def test_a_bus_that_cannot_be_opened_is_tried_again_and_the_log_is_honest(make_rig, monkeypatch):
    rig = make_rig(carried=True)
    failures = iter([BusError("CAN bus can0 cannot be opened"), BusError("CAN bus can0 cannot be opened")])

    def open_late(*address):
        for error in failures:
            raise error
        return open_bus(*address)

    open_bus = handover.open_bus
    monkeypatch.setattr(handover, "open_bus", open_late)
    log = []
    assert let_down(rig.charge, Drive(rig.carrying, NOTHING, True), log=log.append)
    assert log == ["CAN bus can0 cannot be opened; the motors may still be powered; trying again"]
    rig.assert_let_down()


def test_a_single_attempt_at_a_bus_that_cannot_be_opened_fails_with_the_reason():
    log = []
    charge = Charge(("no_such_interface", "x", {}), MOTORS_OF_ARM, LIMITS, PERIOD)
    assert not let_down(charge, Drive(NOTHING, NOTHING, True), log=log.append, is_endless=False)
    assert "CAN bus no_such_interface x" in log[0]
