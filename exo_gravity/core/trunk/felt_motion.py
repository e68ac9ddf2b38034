"""What an arm will feel of a moving trunk, extrapolated from the last samples of the trunk's IMU.

An accelerometer measures specific force, acceleration less gravity: for the arm, its opposite is gravity. The motors'
torque takes effect 10 to 20 ms after the sample that it answers. Walking shakes a trunk at 2 and 4 Hz, so that a torque
15 ms late leaves 19 and 37 % of the disturbance. A parabola through the last 40 ms of samples, extrapolated to the
moment of the effect, leaves 1 and 7 %; from 10 Hz on, extrapolating is worse than ignoring the acceleration.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.arm import STANDARD_GRAVITY
from exo_gravity.core.model.rotation import Floats3, acceleration_of, plus

WINDOW = 0.045  # s; the samples that the parabola fits, 5 at 100 Hz
MIN_SAMPLES = 4  # that it fits at a lower rate, or after losses, if
LONGEST_WINDOW = 0.085  # s holds as many, as from 40 Hz on
# s, added to the sample's age: 3 ms of delay in the sensor's low-pass filter (MPU-6050, 94 Hz), and 6 ms until the
# middle of the 4 ms for which the motors apply the torque.
EFFECT = 0.009
MAX_LEAD = 0.03  # s beyond the newest sample; the parabola is not extrapolated farther
FELT_RANGE = (0.2 * STANDARD_GRAVITY, 3.0 * STANDARD_GRAVITY)  # m/s^2; sitting down hard is felt as 2.3 g


class Felt(NamedTuple):
    """Gravity less the trunk's acceleration, (3,) m/s^2, and angular acceleration, (3,) rad/s^2, in its axes."""

    gravity: Floats3
    angular_acceleration: Floats3


class FeltMotion:
    """Follows the samples of one IMU."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, list[float]]] = deque()
        self._time = -math.inf  # of the newest sample
        self._parabola: np.ndarray | None = None  # (3, 6), coefficients of (t^2, t, 1) for force and angular velocity

    def add(
        self, now: float, specific_force: Sequence[float], angular_velocity: Sequence[float], age: float = 0.0
    ) -> None:
        """Add the sample taken `age` s before `now`: (3,) m/s^2 and (3,) rad/s in the trunk's axes.

        An older sample than the newest is ignored. Raises ParameterError unless all numbers are finite.
        """
        values = [*map(float, specific_force), *map(float, angular_velocity)]
        if len(values) != 6 or not all(map(math.isfinite, values)):
            raise ParameterError("linear_acceleration, angular_velocity", values, "3 finite numbers each")
        time = now - max(0.0, age)
        if not time > self._time:
            return
        self._time = time
        self._samples.append((time, values))
        while self._samples[0][0] < time - (WINDOW if len(self._samples) > MIN_SAMPLES else LONGEST_WINDOW):
            self._samples.popleft()
        self._parabola = None
        if len(self._samples) >= MIN_SAMPLES:
            times = np.array([taken - time for taken, _ in self._samples])
            self._parabola = np.linalg.lstsq(np.vander(times, 3), [row for _, row in self._samples], rcond=None)[0]

    def at(self, time: float, shoulder_from_imu: Floats3 = (0.0, 0.0, 0.0)) -> Felt | None:
        """Return what the arm will feel when a torque computed at `time` (s) acts, None if too few samples tell it.

        shoulder_from_imu: (3,) m in the trunk's axes. Where the trunk turns, its places accelerate differently.
        """
        lead = time - self._time + EFFECT
        if self._parabola is None or lead > WINDOW + EFFECT:
            return None
        lead = min(lead, MAX_LEAD)
        bend, slope, newest = self._parabola
        values = newest + lead * (slope + lead * bend)
        a, b, c = (slope + 2.0 * lead * bend)[3:].tolist()
        x, y, z, *turning = values.tolist()
        x, y, z = plus((x, y, z), acceleration_of(shoulder_from_imu, (turning[0], turning[1], turning[2]), (a, b, c)))
        low, high = FELT_RANGE
        norm = math.hypot(x, y, z)
        share = max(low, min(high, norm)) / max(norm, 1e-9)
        return Felt((-share * x, -share * y, -share * z), (a, b, c))
