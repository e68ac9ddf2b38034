"""The trunk's IMU in a trial without ROS: what the simulated sensor measures, and what the `imu` node makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.tilt import rotation_matrix
from exo_gravity.hardware.trunk_estimator import VQF, ImuSample, TrunkEstimator
from exo_gravity.sim.imu import ImuConfig, SimulatedImu
from exo_gravity.sim.offline import TrunkReading
from exo_gravity.sim.trunk_motion import TrunkState


class TrunkImu:
    """A simulated IMU and the estimator that follows it, for `ArmSetup.trunk`."""

    def __init__(self, config: ImuConfig, rotation_trunk_from_imu: Sequence[float], cycle_rate: float) -> None:
        """Create the IMU `config`, which samples in every n-th of `cycle_rate` cycles per s.

        rotation_trunk_from_imu: the mounting that the controller assumes. Raises ParameterError.
        """
        self.cycles = max(1, round(cycle_rate / config.rate))
        rate = cycle_rate / self.cycles
        self._imu = SimulatedImu(replace(config, rate=rate))
        if VQF is None:
            raise ParameterError("vqf", None, "installed (extra imu) for a trial in which the trunk moves")
        ranges = config.gyroscope_range, config.accelerometer_range
        self._estimator = TrunkEstimator(rotation_trunk_from_imu, rate, *ranges)
        self._rotation = rotation_matrix(rotation_trunk_from_imu, "rotation_trunk_from_imu")

    def measure(self, now: float, state: TrunkState) -> TrunkReading | None:
        """Return what the trunk's IMU tells of `state` at `now` in s, None while it publishes nothing."""
        angular_velocity, acceleration = self._imu.sample_of(state)
        try:
            answer = self._estimator.update(ImuSample(now, angular_velocity.tolist(), acceleration.tolist()))
        except ParameterError:  # refused samples are not published
            return None
        if answer is None:
            return None
        force, turning = self._rotation @ acceleration, self._rotation @ angular_velocity
        return TrunkReading(answer.gravity.tolist(), force.tolist(), turning.tolist())
