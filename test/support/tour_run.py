"""A tour on the simulated device without ROS, bus or clock: safety machine and tour, cycle by cycle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from exo_gravity.core import ArmModel
from exo_gravity.core.arm.gravity import Torque, load_moments, moments_of
from exo_gravity.core.arm.kinematics import LinkInertia
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.tracking import Station
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import ENTER, EXIT, MOTORS
from exo_gravity.core.safety.drive import Drive, EffortCommand, State
from exo_gravity.core.safety.limits import UNKNOWN, JointSample, Limits
from exo_gravity.core.safety.machine import SafetyMachine
from exo_gravity.lab.calibration.poses import Itinerary, TorqueGuess
from exo_gravity.lab.calibration.tour import Tour
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from .active_wearer import attach

NAMES = ("rotation", "abduction", "flexion", "elbow")
MOTORS_AS_MOUNTED = tuple(
    JointMotor(MOTORS[kind], number + 1) for number, kind in enumerate(("AK60-6", "AK80-9", "AK60-6", "AK60-6"))
)
START_TIMEOUT, LONGEST = 30.0, 400.0  # s

Disturb = Callable[[float, SimulatedDevice], Sequence[float] | None]


@dataclass
class TourRun:
    """truth: the device's arm; assumed: the file's. motors: the true ones; the controller assumes MOTORS_AS_MOUNTED.

    disturb(time, device): called each physics step from the first carried one; may set faults, and returns torques.
    """

    truth: ArmConfig = field(default_factory=ArmConfig)
    assumed: ArmModel = DEFAULT_LINKS
    motors: Sequence[JointMotor] = MOTORS_AS_MOUNTED
    limits: Limits = field(default_factory=lambda: Limits(NAMES, sign_check_torque=0.0))
    tilt: tuple[float, float] = (0.1, -0.06)
    rate: float = 100.0
    load: tuple[float, float] = (0.0, 0.0)
    disturb: Disturb | None = None
    late: int = 0  # cycles by which efforts reach the bridge late

    def __post_init__(self) -> None:
        self.fastest = 0.0  # rad/s, of any joint while carried
        self.acted: set[str] = set()
        self.log: list[tuple[float, ...]] = []

    def run(self, itinerary: Itinerary | None = None) -> Tour:
        """Run a tour of twelve best poses, or another one, until the motors are off; return it."""
        device = SimulatedDevice(SimulatedArm(self.truth), [SimulatedMotor(motor) for motor in self.motors])
        device.pitch, device.roll = self.tilt
        tilt = Tilt.of("right", *self.tilt)
        moments = moments_of(self.assumed) + load_moments(self.assumed.length.tolist(), *self.load)
        guess = TorqueGuess(self.assumed.length, moments, tilt, self.assumed.gravity)
        tour = Tour(self.limits, guess, itinerary or Itinerary(self.limits, 12, 230.0), self.rate, self.load)
        safety = SafetyMachine(self.limits, 1.0 / self.rate, MOTORS_AS_MOUNTED)
        safety.enable(0.0)
        samples: list[JointSample] = [UNKNOWN] * 4
        effort: Torque | None = None
        queue: list[Torque | None] = []
        answered, powered, began = -math.inf, False, False
        for cycle in range(round(LONGEST * self.rate)):
            now = cycle / self.rate
            queue = [*queue, effort][-1 - self.late :]
            drive = safety.step(now, tuple(samples), EffortCommand(queue[0], answered))
            powered = self._exchange(device, drive, powered, samples, now)
            if not any(self.limits.is_silent(now, joint) for joint in samples):
                position, velocity = [row.position for row in samples], [row.velocity for row in samples]
                began = began or safety.state is State.ACTIVE
                if began and safety.state is State.ACTIVE:
                    if not self.log and (disturb := self.disturb):
                        attach(device, lambda time, *_: disturb(time, device) or (0.0,) * 4)
                    self.fastest = max(self.fastest, *map(abs, device.arm.velocities))
                    effort = tour.step(now, position, velocity, tilt)
                    tour.plan()
                    self.log.append((now, *device.arm.positions, *(effort or (0.0,) * 4)))
                elif not began:
                    effort = tour.wait(position, tilt)
                answered = now
            if tour.done:
                safety.disable(now)
            if safety.state in (State.DISABLED, State.FAULT) and now > 1.0:
                break
            device.advance(1.0 / self.rate)
        self.acted = set(safety.acted)
        self.safety, self.device = safety, device
        return tour

    def _exchange(
        self, device: SimulatedDevice, drive: Drive, powered: bool, samples: list[JointSample], now: float
    ) -> bool:
        for i, motor in enumerate(MOTORS_AS_MOUNTED):
            if drive.powered and (drive.enter[i] or not powered):
                device.exchange(motor.can_id, motor.command(0.0, 0.0))
                device.exchange(motor.can_id, ENTER)
            reply = device.exchange(motor.can_id, motor.command(drive.effort[i], drive.damping[i]))
            if powered and not drive.powered:
                reply = device.exchange(motor.can_id, EXIT)
            if reply:
                samples[i] = JointSample(*motor.joint_reply(reply[1])[1:], now)
        return drive.powered


def fixed(stations: Sequence[Station]) -> Itinerary:
    """Return the itinerary of `stations` alone."""
    return Itinerary(Limits(NAMES), 0, 0.0, stations)


def assert_close_to_device(inertia: LinkInertia, arm: SimulatedArm, atol: float) -> None:
    """`inertia` is within `atol` kg m^2 of the mass matrix of the simulated arm in three poses."""
    for theta in ((0.0,) * 4, (0.3, 0.8, 0.7, 0.5), (-0.5, 1.5, 1.2, 1.0)):
        arm.reset(theta)
        true = np.zeros((4, 4))
        mujoco.mj_fullM(arm.model, arm.data, true)
        np.testing.assert_allclose(inertia.matrix(theta), true, atol=atol)
