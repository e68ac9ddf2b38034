# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One arm with ordinary motors, sensors and computers, in virtual time: is it carried, and how well.

Motors have a current loop that lags, a velocity that is filtered, and noise in the torque of their replies. What
carries the arm is what the nodes use: the rig's loop, Compensator and TrunkEstimator. The simulated device gives the
truth.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT_V3
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.command import State
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.sim import SimulatedDevice, SimulatedImu, SimulatedMotor
from exo_gravity.sim.motors import simulated
from exo_gravity.sim.rig import START, Rig
from exo_gravity.sim.trunk_motion import TrunkState
from exo_gravity.sim.virtual_arm import TrunkReading
from exo_gravity.sim.virtual_time import Wire

from ..arms import Friction, PlayedArm, of_family
from .drivers import Timing

TILT_TIMEOUT = 0.08  # s
LOOK_PERIOD = 0.01  # s between two comparisons with the truth
SETTLED = 1.5  # s until a tilt must be there


def day_of(arm: PlayedArm) -> list[Mapping[str, object]]:
    """Return the wearer's steps while the arm is carried: reach, walk, bow and rest; the trunk's only with an IMU."""
    first, second, third, rest = map(list, arm.poses)
    walk, bow, rise = {"walk": 5.0}, {"bow": 0.5, "over": 1.5}, {"bow": 0.0, "over": 1.5}
    return [
        {"move": first, "over": 1.6},
        {"hold": 2.0},
        {"move": second, "over": 1.3},
        {"push": list(arm.shove), "over": 0.4},
        {"hold": 1.0},
        *([walk] if arm.has_imu else []),
        {"move": third, "over": 1.3},
        *([bow, {"hold": 1.0}, rise] if arm.has_imu else [{"hold": 1.0}]),
        {"move": rest, "over": 1.4},
        {"hold": 3.0},
    ]


@dataclass(frozen=True)
class Electronics:
    """What an ordinary motor differs in from an ideal one."""

    #: s, time constant of the current loop. A reply carries the torque that the motor applies when the command arrives.
    current_lag: float
    velocity_filter: float  #: s, time constant of the speed in replies and for damping
    torque_noise: float = 0.0  #: Nm, standard deviation of the torque in one reply


class OrdinaryMotor(SimulatedMotor):
    """An ordinary motor. applied: Nm, that its current loop has reached."""

    def __init__(self, joint: JointMotor, electronics: Electronics) -> None:
        super().__init__(joint)
        self.applied = 0.0
        self._electronics = electronics
        self._speed = 0.0  # rad/s, filtered

    def advance(self, position: float, velocity: float, dt: float) -> float:
        """Let `dt` s pass, and return the torque in Nm; see `SimulatedMotor.advance`."""
        if self.firmware.timeout:  # it counts the time since the last command
            super().advance(position, velocity, dt)
        self._speed -= (velocity - self._speed) * math.expm1(-dt / self._electronics.velocity_filter)
        aim = super().torque(position, self._speed)
        self.applied -= (aim - self.applied) * math.expm1(-dt / self._electronics.current_lag)
        self.applied = self.applied if self.entered else 0.0
        return self.applied

    def torque(self, position: float, velocity: float) -> float:
        """Return the torque in Nm that a reply shows."""
        applied = self.applied if self.entered and not self.unplugged else 0.0
        return applied + self._random.gauss(0.0, self._electronics.torque_noise)

    def damps_at_once(self, torque: float) -> bool:
        """Return False: the current loop follows."""
        return False

    def _state(self, position: float, velocity: float) -> bytes:
        return super()._state(position, self._speed)


def motor_of(joint: JointMotor, electronics: Electronics | None) -> SimulatedMotor:
    """Return the motor of `joint`, an ideal one without `electronics`."""
    if electronics is None:
        return simulated(joint)
    return of_family(OrdinaryMotor, joint.spec.family)(joint, electronics)


@dataclass(frozen=True)
class Equipment:
    """Ordinary equipment: the motors' electronics, the arm's friction, the CAN adapter, and a busy computer.

    electronics: None for ideal motors. loss: share of the frames lost each way. batch: s between two deliveries of the
    adapter. late: how often in 10 ms the bridge is late by 20 ms, and the compensator.
    """

    name: str
    electronics: Electronics | None
    friction: Friction
    loss: float = 0.0
    batch: float = 0.0
    late: float = 0.0


@dataclass
class Result:
    """What happened. Times in s, errors in Nm."""

    time: float = 0.0
    starts: int = 0
    refused_starts: list[str] = field(default_factory=list)
    let_downs: list[str] = field(default_factory=list)
    samples: int = 0
    refused_samples: int = 0
    without_tilt: float = 0.0
    largest_error: float = 0.0
    rides: int = 0  #: through late efforts or a late tilt


class OrdinaryArm(Rig):
    """An arm of `equipment` and its wearer, whose trunk may carry an IMU behind the driver `timing`."""

    def __init__(
        self, arm: PlayedArm, equipment: Equipment, is_v3: bool, rate: float, timing: Timing | None = None
    ) -> None:
        settings = replace(arm.carried.settings, tilt_timeout=TILT_TIMEOUT)
        motors = arm.carried.motors
        if is_v3:
            motors = tuple(replace(each, spec=MIT_V3.ranged(each.spec), wire_format=MIT_V3) for each in motors)
        boards = [motor_of(joint, equipment.electronics) for joint in motors]
        device, wire = SimulatedDevice(arm.device_arm(equipment.friction), boards), Wire()
        super().__init__(device, settings, motors, arm.limits(rate), rate, wire, equipment.late / (0.01 * rate))
        device.truth = None  # of an hour
        wire.loss, wire.batch = equipment.loss, equipment.batch
        self.result, self._day = Result(), day_of(arm)
        self._estimator, self._imu = TrunkEstimator((0.0, 0.0, 0.0, 1.0)), SimulatedImu()
        self._begin = self._tilted = self.now
        self.clock.every(LOOK_PERIOD, self._look)
        if timing:
            for taken, stamp, arrival in np.transpose((timing.taken, timing.stamps, timing.arrivals)).tolist():
                self.clock.later(taken, partial(self._take, self._begin + stamp, self._begin + arrival))

    def play(self, duration: float, carried: float) -> Result:
        """Start the arm again and again for `duration` s, and let it down after it was carried for `carried` s."""
        while self.now < self._begin + duration:
            self._start(carried)
        self.result.time, self.result.rides = self.now - self._begin, self.safety.stale.count
        self.loop.bus.close()
        return self.result

    def _start(self, carried: float) -> None:
        """Carry the arm once, unless the start is refused, and let it down."""
        self.safety.clear(self.now)
        self.safety.enable(self.now)
        self.result.starts += 1
        if self.run_until(lambda: self.state is State.ACTIVE or self.safety.fault, START) and not self.safety.fault:
            end = day_ends = self.now
            while self.now < end + carried and self.state is State.ACTIVE:
                if self.now >= day_ends:
                    self.act(*self._day)
                    day_ends += self.device.wearer.script.duration
                self.cycle()
            self.act()
            if self.safety.fault:
                self.result.let_downs.append(": ".join(self.safety.fault[:2]))
            else:
                self.safety.disable(self.now)
        else:
            fault = self.safety.fault
            self.result.refused_starts.append(": ".join(fault[:2]) if fault else self.safety.waiting_for.text)
        self.run_until(lambda: self.state in (State.DISABLED, State.FAULT), START)
        self.check_controller()

    def _sense(self, _now: float, trunk: TrunkState) -> None:
        """Return nothing: a driver's samples take the place of the rig's readings."""

    def _take(self, stamp: float, arrival: float) -> None:
        self.catch_up()
        rate, force = self._imu.sample(self.device.trunk)
        sample = ImuSample(stamp, rate.tolist(), force.tolist())
        self.clock.later(arrival - self.now, partial(self._arrive, sample))

    def _arrive(self, sample: ImuSample) -> None:
        self.result.samples += 1
        try:
            if answer := self._estimator.update(sample, self.now):
                reading = TrunkReading(answer.gravity.tolist(), sample.acceleration, sample.angular_velocity or ZERO)
                self.tell(self.compensator, reading, sample.time)
                if self._tilted > self._begin + SETTLED:
                    self.result.without_tilt = max(self.result.without_tilt, self.now - self._tilted)
                self._tilted = self.now
        except ParameterError:
            self.result.refused_samples += 1

    def _look(self) -> None:
        """Compare the torque of the motors with gravity's, by the truth."""
        if self.state is not State.ACTIVE:
            return
        arm, trunk, settings = self.device.arm, self.device.trunk, self.settings
        theta, velocity = arm.positions, arm.velocities
        at = zip(self.device.motors, theta, velocity, strict=True)
        applied = [motor.advance(angle, speed, 0.0) for motor, angle, speed in at]
        wanted = settings.loaded.torque(theta, Tilt.of(settings.side, trunk.pitch, trunk.roll))
        self.result.largest_error = max(self.result.largest_error, float(np.max(np.abs(np.subtract(applied, wanted)))))
