# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Two public drivers' ways of talking to AK motors, written after their protocol, against the simulated boards.

In virtual time, on a python-can bus. The truth is that of the device: its motors, its angles, its torques.
"""

from __future__ import annotations

import can
import pytest

from exo_gravity.core.motors.families import MOTORS
from exo_gravity.sim import FIRMWARES, SimulatedDevice
from exo_gravity.sim.virtual_time import VirtualBus, Wire

from ..support.simulated_device import make_device

MOTOR = 1
SPECS = {"position": 12.5, "velocity": MOTORS["AK60-6"].velocity_range, "torque": MOTORS["AK60-6"].torque_range}


class PacedMaster:
    """The way of TMotorCANControl: a command in every cycle, replies are read as they come.

    Codes are truncated, 2^b of them to a range. No reply is awaited to ENTER, EXIT and SET_ZERO: a wait follows.
    """

    def __init__(self, bus: VirtualBus, wire: Wire) -> None:
        self.bus, self.wire = bus, wire
        self.state: dict[str, float] = {}

    def send(self, data: list[int]) -> None:
        self.bus.send(can.Message(arbitration_id=MOTOR, data=data, is_extended_id=False))

    def special(self, code: int) -> None:
        self.send([0xFF] * 7 + [code])
        self.wire.clock.sleep(1.5)
        self.read()

    def code(self, value: float, low: float, high: float, bits: int) -> int:
        ratio = (1 << bits) / (high - low)
        return int((min(max(value, low), high - 2.0 / ratio) - low) * ratio)

    def command(self, torque: float, kd: float = 0.0) -> None:
        limits = SPECS["position"], SPECS["velocity"], SPECS["torque"]
        position, velocity = (
            self.code(0.0, -limit, limit, bits) for limit, bits in zip(limits, (16, 12), strict=False)
        )
        gain, effort = self.code(kd, 0.0, 5.0, 12), self.code(torque, -limits[2], limits[2], 12)
        word = position << 48 | velocity << 36 | gain << 12 | effort
        self.send(list(word.to_bytes(8, "big")))

    def update(self, torque: float, kd: float = 0.0) -> None:
        self.command(torque, kd)
        self.wire.clock.sleep(0.005)
        self.read()

    def read(self) -> None:
        while message := self.bus.recv(0.0):
            data = message.data
            if data[0] != MOTOR:
                continue
            codes = data[1] << 8 | data[2], data[3] << 4 | data[4] >> 4, (data[4] & 0xF) << 8 | data[5]
            for (name, limit), code, bits in zip(SPECS.items(), codes, (16, 12, 12), strict=True):
                self.state[name] = code * 2.0 * limit / ((1 << bits) - 1) - limit
            self.state["temperature"] = data[6] - 40 if len(data) == 8 else float("nan")


class AwaitingMaster(PacedMaster):
    """The way of the open drive's own master: each frame is followed by its reply, of which 6 bytes are read.

    Codes are truncated too, 2^b - 1 of them to a range. EXIT follows a zero command.
    """

    def code(self, value: float, low: float, high: float, bits: int) -> int:
        return int((min(max(value, low), high) - low) * ((1 << bits) - 1) / (high - low))

    def send(self, data: list[int]) -> None:
        super().send(data)
        self.wire.clock.sleep(0.0006)
        self.state.clear()
        self.read()

    def special(self, code: int) -> None:
        self.send([0xFF] * 7 + [code])

    def update(self, torque: float, kd: float = 0.0) -> None:
        self.command(torque, kd)
        self.wire.clock.sleep(0.0044)


@pytest.fixture(params=["ak", "vendor", "open_drive"])
def device(request: pytest.FixtureRequest) -> SimulatedDevice:
    return make_device(FIRMWARES[request.param])


@pytest.fixture(params=[PacedMaster, AwaitingMaster])
def master(request: pytest.FixtureRequest, device: SimulatedDevice) -> PacedMaster:
    wire = Wire(bitrate=1_000_000)
    wire.play(device)
    return request.param(wire.open(), wire)


def test_a_public_master_switches_on_reads_pushes_zeroes_and_switches_off(master, device) -> None:
    motor = device.motors[0]
    master.special(0xFC)
    assert motor.entered
    master.update(0.0)
    start = device.arm.positions[0]
    assert master.state["position"] == pytest.approx(start, abs=0.02)
    for _ in range(40):
        master.update(1.5, kd=1.0)
    assert device.arm.positions[0] > start + 0.1
    assert motor.torque(0.0, 0.0) == pytest.approx(1.5, abs=0.03)
    assert master.state["position"] == pytest.approx(device.arm.positions[0], abs=0.05)
    for _ in range(200):
        master.update(0.0, kd=2.0)
    master.special(0xFD)
    assert not motor.entered and motor.torque(0.0, 0.0) == 0.0
    master.special(0xFE)
    master.wire.clock.sleep(1.5)
    master.update(0.0)
    assert master.state["position"] == pytest.approx(0.0, abs=0.02)
    assert not motor.entered and master.wire.collisions == 0
