# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""One arm with ordinary motors, sensors and computers, in virtual time: is it carried, and how well.

What carries it is what the nodes use: `VirtualArm`, Compensator and TrunkEstimator. The simulated device gives the
truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from exo_gravity.core.arm.rotation import ZERO
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.compensator import Compensator
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.ak import MIT_V3
from exo_gravity.core.safety.drive import State
from exo_gravity.hardware.trunk_estimator import ImuSample, TrunkEstimator
from exo_gravity.sim import SimulatedDevice, SimulatedImu, VirtualWearer
from exo_gravity.sim.controllers import DirectController, UnreliableController
from exo_gravity.sim.script import TrialScript
from exo_gravity.sim.virtual_arm import TrunkReading, VirtualArm
from exo_gravity.sim.virtual_time import Wire

from ..arms import Friction, PlayedArm, on_boards
from .drivers import Timing
from .motors import Electronics, motor_of

TILT_TIMEOUT = 0.08  # s
LOOK_PERIOD = 0.01  # s between two comparisons with the truth
SETTLED = 1.5  # s until a tilt must be there


def day_of(arm: PlayedArm) -> TrialScript:
    """Return what the wearer does while the arm is carried: reach, walk, bow and rest; the trunk only with an IMU."""
    first, second, third, rest = map(list, arm.poses)
    walk, bow, rise = {"walk": 5.0}, {"bow": 0.5, "over": 1.5}, {"bow": 0.0, "over": 1.5}
    steps = [
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
    return TrialScript.parse({"name": "a wearer's day", "steps": steps})


@dataclass(frozen=True)
class Equipment:
    """Ordinary equipment: the motors' electronics, the arm's friction, the CAN adapter, and a busy computer.

    electronics: None for ideal motors. loss: share of the frames lost each way. batch: s between two deliveries of the
    adapter. late: how often in 10 ms the bridge is late by
    20 ms, and the compensator.
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


class OrdinaryArm:
    """An arm of `equipment` and its wearer, whose trunk may carry an IMU behind the driver `timing`."""

    def __init__(
        self,
        arm: PlayedArm,
        equipment: Equipment,
        is_v3: bool,
        rate: float,
        timing: Timing | None = None,
        seed: int = 0,
    ) -> None:
        self.result = Result()
        settings = replace(arm.carried.settings, tilt_timeout=TILT_TIMEOUT)
        motors = on_boards(arm.motors, MIT_V3) if is_v3 else arm.motors
        boards = [motor_of(joint, equipment.electronics) for joint in motors]
        self.device = SimulatedDevice(arm.device_arm(equipment.friction), boards)
        self._side, self._robot, self._day = settings.side, settings.loaded, day_of(arm)
        wire = Wire()
        wire.loss, wire.batch = equipment.loss, equipment.batch
        limits = arm.limits(rate)
        self._compensator = Compensator(settings, limits.joint_names)
        controller = DirectController(self._compensator, limits)
        late = UnreliableController(controller, wire.clock, equipment.late / (0.01 * rate), seed)
        self._arm = VirtualArm(self.device, late, motors, limits, rate, wire)
        self.clock, self.safety, self.loop = wire.clock, self._arm.safety, self._arm.loop
        self._estimator = TrunkEstimator((0.0, 0.0, 0.0, 1.0))
        self._imu = SimulatedImu()
        self._begin = self._tilted = self.clock.monotonic()
        self.clock.every(LOOK_PERIOD, self._look)
        if timing:
            self._send_samples(timing)

    def play(self, duration: float, carried: float) -> Result:
        """Start the arm again and again for `duration` s, and let it down after it was carried for `carried` s."""
        end = self._begin + duration
        while self.clock.monotonic() < end:
            self._start(carried)
        self.result.time = self.clock.monotonic() - self._begin
        self.result.rides = self.safety.ride.rides
        self.loop.bus.close()
        return self.result

    def _start(self, carried: float) -> None:
        safety, result = self.safety, self.result
        safety.clear(self.clock.monotonic())
        safety.enable(self.clock.monotonic())
        result.starts += 1
        if not self._run_until((State.ACTIVE,), 60.0):
            cause = f"{safety.fault.code}: {safety.fault.reason}" if safety.fault else safety.waiting_for
            result.refused_starts.append(cause)
        elif self._carry(carried):
            safety.disable(self.clock.monotonic())
        else:
            assert safety.fault
            result.let_downs.append(f"{safety.fault.code}: {safety.fault.reason}")
        self._run_until((State.DISABLED, State.FAULT), 60.0)

    def _carry(self, duration: float) -> bool:
        """Carry the arm for `duration` s; return whether it still is."""
        end = script_end = self.clock.monotonic()
        end += duration
        while self.clock.monotonic() < end and self.safety.state is State.ACTIVE:
            if self.clock.monotonic() >= script_end:
                self.device.start(VirtualWearer(self._day))
                script_end += self._day.duration
            self.loop.cycle()
        self.device.start(VirtualWearer(self._day), delay=1e9)
        return self.safety.state is State.ACTIVE

    def _run_until(self, states: Sequence[State], timeout: float) -> bool:
        """Run until the state is one of these; return whether it is, within `timeout` s and without a new fault."""
        safety, starts = self.safety, State.ACTIVE in states
        self._arm.run_until(lambda: safety.state in states or (starts and safety.fault), timeout)
        self._arm.check_controller()
        return safety.state in states

    def _send_samples(self, timing: Timing) -> None:
        """Let the driver take its samples, and deliver them."""
        begin = self.clock.monotonic()
        columns = zip(timing.taken.tolist(), timing.stamps.tolist(), timing.arrivals.tolist(), strict=True)

        def take_next() -> None:
            if (row := next(columns, None)) is not None:
                taken, stamp, arrival = row
                self.clock.later(begin + taken - self.clock.monotonic(), lambda: take(stamp, arrival))

        def take(stamp: float, arrival: float) -> None:
            self._arm.catch_up()
            rate, force = self._imu.sample(self.device.trunk)
            sample = ImuSample(begin + stamp, rate.tolist(), force.tolist())
            self.clock.later(begin + arrival - self.clock.monotonic(), lambda: self._arrive(sample))
            take_next()

        take_next()

    def _arrive(self, sample: ImuSample) -> None:
        result, now = self.result, self.clock.monotonic()
        result.samples += 1
        try:
            if answer := self._estimator.update(sample, now):
                reading = TrunkReading(answer.gravity.tolist(), sample.acceleration, sample.angular_velocity or ZERO)
                self._arm.tell(self._compensator, reading, sample.time)
                self._note_tilt(now)
        except ParameterError:
            result.refused_samples += 1

    def _note_tilt(self, now: float) -> None:
        if self._tilted > self._begin + SETTLED:
            self.result.without_tilt = max(self.result.without_tilt, now - self._tilted)
        self._tilted = now

    def _look(self) -> None:
        """Compare the torque of the motors with gravity's, by the truth."""
        if self.safety.state is not State.ACTIVE:
            return
        arm, trunk = self.device.arm, self.device.trunk
        theta, velocity = arm.positions, arm.velocities
        at = zip(self.device.motors, theta, velocity, strict=True)
        applied = [motor.advance(angle, speed, 0.0) for motor, angle, speed in at]
        wanted = self._robot.torque(theta, Tilt.of(self._side, trunk.pitch, trunk.roll))
        self.result.largest_error = max(self.result.largest_error, float(np.max(np.abs(np.subtract(applied, wanted)))))
