# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Motors whose torque depends on their temperature, on the bus in virtual time, judged by what the motors give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import LARGEST_WARMING, JointMotor
from exo_gravity.core.safety.drive import Send
from exo_gravity.hardware.can.can_port import CanPort
from exo_gravity.hardware.can.motor_bus import WARMING, MotorBus
from exo_gravity.sim import ArmConfig, Firmware, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.virtual_time import Wire

from ..support.simulated_device import drive_of, sending
from .test_motor_bus import MOTORS_OF_ARM, WEIGHTLESS

SLOPE, EFFORT = -0.0015, (1.0, -4.0, 1.5, -0.8)
MOTORS = tuple(replace(motor, torque_scale=0.9, scale_slope=SLOPE) for motor in MOTORS_OF_ARM)
HALF_A_CODE = np.array([motor.spec.torque_range / 4095 * motor.torque_scale for motor in MOTORS])


class Bus(MotorBus):
    """The bus of a device that is locked in place, whose motors have `temperature` degC."""

    def __init__(self, temperature: float, firmware: Firmware | None = None) -> None:
        wire = Wire()
        stuck = SimulatedArm(ArmConfig(links=WEIGHTLESS, coulomb_friction=(10.0,) * 4))
        self.device = SimulatedDevice(stuck, [SimulatedMotor(motor, firmware) for motor in MOTORS])
        self.warm(temperature)
        wire.play(self.device)
        super().__init__([CanPort(wire.open(), wire.clock)] * len(MOTORS), MOTORS, clock=wire.clock)
        self.exchange(sending(Send.ENTER), self.clock.monotonic() + 0.01)

    def warm(self, temperature: float) -> None:
        for motor in self.device.motors:
            motor.temperature = motor.ambient = temperature

    def cycle(self) -> np.ndarray:
        """Command EFFORT for a cycle of 10 ms; return the true torque (4,) in Nm."""
        end = self.clock.monotonic() + 0.01
        self.exchange(drive_of(EFFORT), end)
        self.receive_until(end)
        return np.array([motor.torque(0.0, 0.0) for motor in self.device.motors])


@pytest.mark.parametrize("temperature", [5.0, 25.0, 70.0])
def test_a_motor_of_any_temperature_gives_and_reports_the_torque_asked_for_within_half_a_code(temperature):
    bus = Bus(temperature)
    bus.cycle()
    true = bus.cycle()
    assert np.all(np.abs(true - EFFORT) <= 1.1 * HALF_A_CODE)
    reported = [sample.effort for sample in bus.samples]
    assert np.all(np.abs(np.subtract(reported, true)) <= 1.1 * HALF_A_CODE)


def test_a_motor_that_reports_no_temperature_gives_its_torque_at_25_degrees():
    bus = Bus(25.0, Firmware(reply_length=6))
    assert np.all(np.abs(bus.cycle() - EFFORT) <= 1.1 * HALF_A_CODE)
    bus.warm(65.0)
    np.testing.assert_allclose(bus.cycle() / EFFORT, 1.0 + SLOPE * 40.0, atol=0.01)


def test_a_reading_that_jumps_moves_the_torque_no_faster_than_a_motor_warms():
    bus = Bus(30.0)
    bus.cycle()
    commanded = [bus._motors[1].command(EFFORT[1], 0.0, temperature=t) for t in (30.0, 31.0)]
    bus.warm(215.0)  # as a sensor reads whose wire is broken
    for _ in range(100):
        bus.cycle()
    sent = bus._command(1, bus.clock.monotonic())[1]
    assert sent in commanded and WARMING == 1.0
    ratio = MOTORS[0].scale_at(215.0) / MOTORS[0].torque_scale
    assert ratio == pytest.approx(1.0 + SLOPE * LARGEST_WARMING)


@pytest.mark.parametrize(("name", "value"), [("scale_slope", 0.1), ("scale_temperature", 300.0)])
def test_a_slope_in_percent_or_a_temperature_in_kelvin_is_refused(name, value):
    with pytest.raises(ParameterError, match=f"torque_{name}"):
        JointMotor(MOTORS[0].spec, 1, **{name: value})
