# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The simulated Damiao motor does what its firmware does: a frame, what it answers, and what the joint feels."""

from __future__ import annotations

import struct

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import FAMILY
from exo_gravity.core.motors.damiao import CLEAR_ERROR, DAMIAO_MIT, LOST, ON, PMAX, REGISTERS, TIMEOUT, TMAX
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER, EXIT, SET_ZERO
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim.motors import class_of, simulated
from exo_gravity.sim.motors.damiao import DamiaoMotor
from exo_gravity.sim.motors.firmware import FIRMWARES

STEP = 0.001  # s


class Bench:
    """A motor whose joint is held at 0.3 rad."""

    def __init__(self, timeout: float = 0.2) -> None:
        joint = JointMotor(MOTORS["DM-J4310"], 3, wire_format=DAMIAO_MIT, timeout=timeout)
        self.joint, self.motor = joint, DamiaoMotor(joint)
        self.angle, self.time = 0.3, 0.0

    def send(self, data: bytes, frame_id: int = 3) -> bytes:
        answer = self.motor.receive(data, self.angle, 0.0, self.time, frame_id)
        assert answer is not None
        return answer

    def state(self, data: bytes, frame_id: int = 3) -> int:
        return self.send(data, frame_id)[0] >> 4

    def push(self, torque: float, frame_id: int = 3) -> int:
        return self.state(self.joint.command(torque, 0.0), frame_id)

    def wait(self, duration: float) -> float:
        torque = 0.0
        for _ in range(round(duration / STEP)):
            self.time += STEP
            torque = self.motor.advance(self.angle, 0.0, STEP)
        return torque

    def ask(self, register: int, operation: int = 0x33, value: bytes = bytes(4)) -> bytes | None:
        data = bytes((3, 0, operation, register)) + value
        return self.motor.receive(data, self.angle, 0.0, self.time, REGISTERS)

    def ask_float(self, register: int) -> float:
        return struct.unpack("<f", self.ask(register)[4:])[0]

    def without_power_for_a_moment(self) -> None:
        self.motor.unplugged = True
        self.motor.unplugged = False


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_command_while_off_is_kept_and_enter_carries_it_out(bench: Bench) -> None:
    assert bench.push(2.0) == 0 and bench.wait(0.01) == 0.0
    assert bench.state(ENTER) == ON
    assert bench.wait(0.01) == pytest.approx(2.0, abs=0.01)
    assert bench.state(EXIT) == 0
    assert bench.state(ENTER) == ON and bench.wait(0.01) == 0.0


def test_a_motor_without_commands_lets_go_and_ignores_enter_until_its_error_is_cleared(bench: Bench) -> None:
    bench.state(ENTER)
    bench.push(2.0)
    assert bench.wait(0.19) == pytest.approx(2.0, abs=0.01)
    assert bench.wait(0.02) == 0.0 and bench.motor.dips == 1
    assert bench.push(2.0) == LOST and bench.state(ENTER) == LOST and bench.wait(0.01) == 0.0
    assert bench.state(CLEAR_ERROR) == 0
    assert bench.state(ENTER) == ON


def test_every_id_with_its_lowest_8_bits_restarts_its_time_out_but_another_mode_moves_nothing(bench: Bench) -> None:
    assert set(bench.motor.received_ids) == {3 + 0x100 * mode for mode in range(8)} | {REGISTERS}
    bench.state(ENTER)
    for _ in range(5):
        bench.push(5.0, 0x103)
        assert bench.wait(0.15) == 0.0
    assert bench.motor.entered
    assert bench.state(EXIT, 0x203) == 0 and not bench.motor.entered


def test_an_error_switches_the_motor_off_and_comes_back_while_its_cause_stays(bench: Bench) -> None:
    bench.state(ENTER)
    bench.motor.error = 0x9
    bench.wait(STEP)
    assert bench.push(0.0) == 0x9 and not bench.motor.entered
    assert bench.state(CLEAR_ERROR) == 0x9 and bench.state(ENTER) == 0x9
    bench.motor.error = 0
    assert bench.state(CLEAR_ERROR) == 0 and bench.state(ENTER) == ON
    bench.motor.temperature = 101.0
    bench.wait(STEP)
    assert bench.push(0.0) == 0xC  # a hot coil


def test_registers_are_told_and_what_is_written_counts_until_the_power_goes(bench: Bench) -> None:
    assert [struct.unpack("<I", bench.ask(number)[4:])[0] for number in (7, 9, 10)] == [0x13, 4000, 1]
    assert [bench.ask_float(number) for number in (20, 21, 22, 23)] == [10.0, 12.5, 30.0, 10.0]
    assert bench.ask(99) is None
    assert bench.motor.receive(bytes((4, 0, 0x33, 21, 0, 0, 0, 0)), 0.0, 0.0, 0.0, REGISTERS) is None  # another's
    bench.ask(TMAX, 0x55, struct.pack("<f", 20.0))
    bench.ask(TIMEOUT, 0x55, struct.pack("<I", 0))
    bench.state(ENTER)
    bench.push(2.0)
    assert bench.wait(1.0) == pytest.approx(4.0, abs=0.02)  # the same code, another torque; and no time-out
    bench.without_power_for_a_moment()
    assert bench.ask_float(TMAX) == 10.0


def test_a_stored_register_and_the_zero_survive_a_power_cycle_and_a_refresh_tells_the_state(bench: Bench) -> None:
    bench.ask(PMAX, 0x55, struct.pack("<f", 12.566))
    bench.ask(1, 0xAA)
    bench.without_power_for_a_moment()
    assert bench.ask_float(PMAX) == pytest.approx(12.566)
    bench.state(ENTER)
    refreshed = bench.ask(0, 0xCC)
    assert refreshed[0] == 0x13
    assert refreshed == bench.send(bytes(8), 0x103)  # which commands nothing in MIT mode either
    assert bench.state(EXIT) == 0 and bench.state(SET_ZERO) == 0
    bench.without_power_for_a_moment()
    reply = DAMIAO_MIT.unpack_reply(bench.motor.joint.spec, 3, bench.send(EXIT))
    assert reply.position == pytest.approx(0.0, abs=0.001)


def test_a_motor_is_simulated_by_the_class_of_its_family() -> None:
    joint = JointMotor(MOTORS["AK80-64"], 1)
    assert type(simulated(joint)) is class_of(FAMILY)
    with pytest.raises(ParameterError, match="motor = 'unheard'"):
        class_of("unheard")
    with pytest.raises(ParameterError, match=r"firmware\.variant = 'vendor': must be one of usual"):
        simulated(Bench().joint, FIRMWARES["vendor"])
