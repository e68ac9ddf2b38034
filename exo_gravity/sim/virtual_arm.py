# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated arm that is carried in virtual time by what carries a real one: control loop, motor bus, safety machine.

Offline trials, studies and tests use it. The controller is the caller's: a compensator without messages, the tour of a
calibration, or one that is late on purpose. Only what takes time on a real computer takes none here.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt, gravity_in_trunk
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import HANGING, Limits
from exo_gravity.hardware.can_port import CanPort
from exo_gravity.hardware.control_loop import Controller, ControlLoop
from exo_gravity.hardware.motor_bus import MotorBus
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_time import Played, Wire


class TrunkReading(NamedTuple):
    """What the node `imu` publishes, vectors (3,) in the trunk's axes."""

    gravity: Sequence[float]  #: unit vector
    specific_force: Sequence[float] | None = None  #: m/s^2, as measured
    angular_velocity: Sequence[float] = ZERO  #: rad/s, as measured


# Called for each sample of an IMU with its time in s. Returns a reading, or None for a sample that is not published.
TrunkSensor = Callable[[float, TrunkState], TrunkReading | None]


def resting(pitch: float, roll: float) -> TrunkSensor:
    """Return the sensor of a trunk that stays at this measured tilt in rad, and of whose motion nothing is known."""
    reading = TrunkReading(gravity_in_trunk(pitch, roll).tolist())
    return lambda now, state: reading


class VirtualArm:
    """One arm and its control loop.

    device: the arm as it is.
    controller: what turns samples into efforts.
    motors, limits: the arm as the controller's side assumes it; whoever starts a simulated arm has seen it hang.
    rate: cycles of the loop per s.
    wire: the bus; by default one of its own, whose clock is at 0 s.
    bus, played: how loop and device are connected to it; by default by one port each.

    clock, wire, loop, safety, bus: what runs the arm.
    """

    def __init__(
        self,
        device: SimulatedDevice,
        controller: Controller,
        motors: Sequence[JointMotor],
        limits: Limits,
        rate: float,
        wire: Wire | None = None,
        bus: MotorBus | None = None,
        played: Played | None = None,
    ) -> None:
        self.device = device
        self.wire = wire or Wire(start=0.0)
        self.clock = self.wire.clock
        self._played = played or self.wire.play(device, tick=None)
        self.bus = bus or MotorBus(
            [CanPort(self.wire.open(), self.clock, self.wire.open, any(device.is_fd))] * len(motors),
            motors,
            clock=self.clock,
        )
        self.loop = ControlLoop(self.bus, replace(limits, start_pose=HANGING), 1.0 / rate, controller)
        self.safety = self.loop.safety

    @property
    def now(self) -> float:
        """The time in s."""
        return self.clock.monotonic()

    def enable(self) -> None:
        """Start the checks, after which the arm is carried."""
        self.safety.enable(self.now)

    def cycle(self) -> bool:
        """Run one cycle of the loop; return False once it has ended."""
        return self.loop.cycle()

    def run(self, duration: float) -> None:
        """Run the loop for `duration` s, or until it has ended."""
        self.run_until(lambda: False, duration)

    def run_until(self, condition: Callable[[], object], timeout: float = 60.0) -> bool:
        """Run the loop until `condition()` holds; return whether it did within `timeout` s, before the loop ended."""
        end = self.now + timeout
        while not condition():
            if self.now >= end or not self.cycle():
                return False
        return True

    def check_controller(self) -> None:
        """Raise RuntimeError if the controller has failed: the loop would only let the arm down."""
        if self.loop.cycle_errors:
            raise RuntimeError(f"the controller failed: {self.loop.cycle_error}")

    def catch_up(self) -> None:
        """Let the device's time pass until now, e.g. before its motion is read."""
        self._played.catch_up()

    def add_imu(self, sensor: TrunkSensor, compensator: Compensator, period: float) -> None:
        """Read the trunk every `period` s; each reading arrives a period later, the first of a running IMU at once.

        sensor: what reads it.
        compensator: that of the controller.
        """
        self._read_trunk(sensor, compensator, 0.0)
        self.clock.run(0.0)
        self.clock.every(period, partial(self._read_trunk, sensor, compensator, period))

    def _read_trunk(self, sensor: TrunkSensor, compensator: Compensator, delay: float) -> None:
        self.catch_up()
        if reading := sensor(self.now, self.device.trunk):
            self.clock.later(delay, partial(self._deliver, compensator, reading, self.now))

    def _deliver(self, compensator: Compensator, reading: TrunkReading, taken: float) -> None:
        with contextlib.suppress(ParameterError):  # the node refuses it, too
            self.tell(compensator, reading, taken)

    def tell(self, compensator: Compensator, reading: TrunkReading, taken: float) -> None:
        """Deliver a reading of the trunk, which was taken at `taken` s, to compensator and safety machine."""
        now, gravity, turning = self.now, reading.gravity, reading.angular_velocity
        compensator.tilt.set_gravity(now, gravity, turning, now - taken)
        self.safety.motion.follow(now, Tilt.of_gravity(self.device.side, gravity), compensator.tilt.overtaken)
        if reading.specific_force:
            compensator.motion.add(now, reading.specific_force, turning, now - taken)
