# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A tour on the simulated device, in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from bench.calibration.tour import Player
from exo_gravity.core import ArmModel
from exo_gravity.core.arm.gravity import NO_TORQUE
from exo_gravity.core.arm.kinematics import LinkInertia
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.tracking import Station
from exo_gravity.core.motors.ak import MIT
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.limits import Limits
from exo_gravity.lab.calibration.moment_model import PapersMoments
from exo_gravity.lab.calibration.poses import Itinerary, guess_for
from exo_gravity.lab.calibration.tour import Tour
from exo_gravity.sim import ArmConfig, SimulatedArm, SimulatedDevice, SimulatedMotor
from exo_gravity.sim.arm import DEFAULT_LINKS

from .active_wearer import attach
from .simulated_device import joints_of

NAMES = ("rotation", "abduction", "flexion", "elbow")
MOTORS_AS_MOUNTED = joints_of((MIT,) * 4)

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

    def run(self, itinerary: Itinerary | None = None) -> Tour:
        """Run a tour of twelve best poses, or another one, until the motors are off; return it."""
        device = SimulatedDevice(SimulatedArm(self.truth), [SimulatedMotor(motor) for motor in self.motors])
        device.pitch, device.roll = self.tilt
        tilt = Tilt.of("right", *self.tilt)
        guess = guess_for(PapersMoments(self.assumed, keeps_tilt=True), tilt, self.load)
        tour = Tour(self.limits, guess, itinerary or Itinerary(self.limits, 12, 230.0), self.rate, self.load)
        player = Player(tour, device, MOTORS_AS_MOUNTED, self.limits, self.rate, tilt, self._disturb)
        self.device, self.log = device, player.log
        self.safety = player.play()
        self.fastest = float(np.abs(np.array(player.log)[:, 5:9]).max())
        return tour

    def _disturb(self) -> None:
        if disturb := self.disturb:
            attach(self.device, lambda time, *_: disturb(time, self.device) or NO_TORQUE)


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
