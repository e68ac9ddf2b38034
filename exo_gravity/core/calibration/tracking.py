"""Moves the arm along a slow reference: expected gravity torque, friction, and a PID controller in joint space.

What is expected is a mean and a standard deviation for every pose. Each joint has moments of its own, in the Nm that
its motor is commanded: its unknown torque scale is then part of them. They start from the parameter file's arm with a
wide uncertainty, and every measured pose narrows it (a Kalman update).

The controller's output is an acceleration, which the arm's approximate mass matrix turns into torques: so all joints
have the same natural frequency, however they are coupled.
"""

import math
from collections.abc import Generator, Iterator, Sequence

import numpy as np

from exo_gravity.core.calibration.motion import LEAD, Line, Station, Sweep
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import LAWS, Torque, regressor
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.numbers import JOINT_COUNT, Vector

UNSURE = 0.4  # of a moment: masses and torque scales that are each off by 30 %
UNSURE_MOMENT = 0.02  # kg m, in addition: off-axis moments of which the file knows nothing
UNEXPLAINED = 0.05  # Nm: standard deviation of what no moment explains
# kg m^2 added to each joint: with it a 1 kg weight on link 4 at 100 Hz is carried without sticking (measured).
ADDED = 0.005
FREQUENCY_PER_RATE = 0.12  # natural frequency in rad/s per control cycle per s; two cycles of delay cost 27 degrees
MAX_FREQUENCY = 20.0  # rad/s
INTEGRAL_SHARE = 0.4  # of the frequency, at which the integral part acts; unstable from 2 on
# Times the smallest inertia in any direction, that the integral part adds in all. Without it, two joints that stick on
# opposite sides of their path would cancel each other's integral where the inertia of both together is small.
FLOOR = 2.0
USUAL_FRICTION = 0.15  # Nm, until it is measured
# Of the friction, per s, by which its compensation changes: a joint that rests anywhere within its friction would jump.
FRICTION_RATE = 6.0
# rad ahead of the reference, and rad/s faster, from which on no more friction is compensated
AHEAD, FASTER = 0.003, 0.03
SLOW_ERROR, STOP_ERROR = 0.04, 0.08  # rad behind the reference, from which on it slows down, and at which it waits
FULL_FRICTION_SPEED = 0.03  # rad/s of the reference, from which on friction is compensated fully


class TorqueGuess:
    """The commanded torque that holds the arm, as far as it is known.

    length: (4,) m. moments: (8,) kg m, as in `core.model.gravity`, with the load. tilt: of the trunk or the stand.
    """

    def __init__(self, length: Vector, moments: Vector, tilt: Tilt, gravity: float) -> None:
        moments = np.asarray(moments, dtype=float)
        deviation = UNSURE * np.abs(moments) + UNSURE_MOMENT
        self.length = np.asarray(length, dtype=float)
        self.tilt = tilt
        self.gravity = gravity
        self._mean = np.tile(moments, (JOINT_COUNT, 1))  # of each joint
        self._covariance = np.tile(np.diag(deviation**2), (JOINT_COUNT, 1, 1))
        self._arms = self._as_arms()

    @property
    def common_moments(self) -> np.ndarray:
        """The moments (8,) in kg m as the joints show them on average; M_n is that of joint n."""
        return np.append(np.diag(self._mean[:, :JOINT_COUNT]), self._mean[:, JOINT_COUNT:].mean(axis=0))

    def torque(self, theta: Sequence[float]) -> Torque:
        """Return the expected torque (4,) in Nm at `theta` (4,) rad, in plain floats for the control loop."""
        law = LAWS["exact"]
        return tuple(law(arm, theta, self.tilt)[joint] for joint, arm in enumerate(self._arms))

    def torques(self, theta: np.ndarray, direction: Vector | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected torque and its standard deviation, both (n, 4) Nm, at `theta` (n, 4) rad.

        direction: (3,), gravity's unit vector in the base frame; by default as at present.
        """
        rows = regressor(theta, self.tilt.direction if direction is None else direction, self.gravity)
        mean = np.einsum("njk,jk->nj", rows, self._mean)
        variance = np.einsum("njk,jkl,njl->nj", rows, self._covariance, rows)
        return mean, np.sqrt(np.maximum(variance, 0.0))

    def learn(self, theta: Vector, effort: Vector, spread: Vector) -> None:
        """Take a measured torque `effort` (4,) Nm at `theta` (4,) rad, with its standard error `spread` (4,) Nm."""
        rows = regressor(np.asarray(theta, dtype=float)[None], self.tilt.direction, self.gravity)[0]
        for joint, (row, torque, error) in enumerate(zip(rows, effort, spread, strict=True)):
            covariance = self._covariance[joint]
            gain = covariance @ row / (row @ covariance @ row + error**2 + UNEXPLAINED**2)
            self._mean[joint] += gain * (torque - row @ self._mean[joint])
            self._covariance[joint] = covariance - np.outer(gain, row @ covariance)
        self._arms = self._as_arms()

    def _as_arms(self) -> list[ArmModel]:
        return [
            ArmModel.from_moments(self.length, np.maximum(row[:4], 0.0), row[4:], gravity=self.gravity)
            for row in self._mean
        ]


class Tracker:
    """Moves the four joints along lines, one after the other, and takes the samples of sweeps.

    rate: control cycles per s. max_effort: (4,) Nm. lines: to follow, each taken when it begins; the owner sets them
    before the first step. friction: (4,) Nm, compensated in the direction of motion, as far as the owner knows it.
    saturated: (4,) s for which each joint has wanted more than its `max_effort`. error: (4,) rad by which the arm is
    behind its path. correction: (4,) Nm, what the controller added to gravity and friction in the last step.
    """

    def __init__(self, rate: float, max_effort: Sequence[float]) -> None:
        self.friction = np.full(JOINT_COUNT, USUAL_FRICTION)
        self.saturated = np.zeros(JOINT_COUNT)
        self.error = np.zeros(JOINT_COUNT)
        self.correction = np.zeros(JOINT_COUNT)
        self._frequency = min(MAX_FREQUENCY, FREQUENCY_PER_RATE * rate)
        self._max_effort = np.array(max_effort)
        self._integral = np.zeros(JOINT_COUNT)
        self._slide = np.zeros(JOINT_COUNT)  # Nm that compensate friction
        self._effort: Torque = (0.0,) * JOINT_COUNT
        self.lines: Iterator[Line] = iter(())
        self._line = Line(self.error, self.error)
        self._time = math.inf  # s, on the present line; it is over
        self._samples: list[tuple[Vector, np.ndarray, Vector]] | None = None  # of the present sweep

    def sweep(self, station: Station) -> Generator[Line, None, list[Sweep]]:
        """Yield the ways through `station`, there and back; return their samples, without the expected torque."""
        sweeps, (low, high) = list[Sweep](), station.ends
        for ends in ((low, high), (high, low)):
            self._samples = []
            yield Line(*ends, station.speed)
            sweeps.append(Sweep(*map(np.array, zip(*self._samples, strict=True))))
        self._samples = None
        return sweeps

    def shift(self, change: np.ndarray) -> None:
        """Take over a `change` (4,) Nm of the expected torque, so that the effort does not step."""
        self._integral -= change

    def step(
        self, dt: float, position: Vector, velocity: Vector, expected: Torque, direction: Vector, matrix: np.ndarray
    ) -> Torque:
        """Return the effort (4,) in Nm, `dt` s after the last one.

        position, velocity: (4,), rad and rad/s. expected: (4,) Nm, gravity's torque. direction: (3,), of gravity, for
        the samples. matrix: (4, 4) kg m^2, the approximate mass matrix.
        """
        if self._time > self._line.duration:
            self._line, self._time = next(self.lines), -LEAD
        goal, heading = self._line.at(self._time)
        self.error = goal - position
        behind = float(np.abs(self.error).max())
        pace = max(0.0, min(1.0, (STOP_ERROR - behind) / (STOP_ERROR - SLOW_ERROR)))
        self._time += pace * dt
        if self._samples is not None and self._line.is_measured(self._time):
            # The effort of the last cycle brought the arm here.
            self._samples.append((position, np.subtract(self._effort, expected), direction))
        # Friction is compensated before the motion begins: a joint that breaks away late would jump.
        coming = self._line.at(self._time + LEAD)[1] if self._time < LEAD else heading
        speed_error = pace * heading - velocity
        self._compensate_friction(dt, coming, speed_error)
        self._effort = self._controlled(dt, speed_error, expected, matrix + ADDED * np.eye(JOINT_COUNT))
        return self._effort

    def _compensate_friction(self, dt: float, heading: np.ndarray, speed_error: np.ndarray) -> None:
        """Compensate friction by and by towards `heading` (4,) rad/s, and no further in a joint that is ahead."""
        most, way = FRICTION_RATE * self.friction * dt, np.sign(heading)
        wanted = self.friction * np.clip(heading / FULL_FRICTION_SPEED, -1.0, 1.0)
        change = np.clip(wanted - self._slide, -most, most)
        is_ahead = (self.error * way < -AHEAD) | (speed_error * way < -FASTER)
        self._slide += np.where(is_ahead & (change * way > 0.0), 0.0, change)

    def _controlled(self, dt: float, speed_error: np.ndarray, expected: Torque, matrix: np.ndarray) -> Torque:
        frequency = self._frequency
        stiff = matrix @ self.error * frequency**2
        push = stiff + matrix @ speed_error * 2.0 * frequency
        weakest = float(np.linalg.eigvalsh(matrix)[0])
        floor = FLOOR * weakest * self.error * frequency**2
        integral = self._integral + INTEGRAL_SHARE * frequency * dt * (stiff + floor)
        torque = expected + self._slide + push + integral
        is_saturated = np.abs(torque) > self._max_effort
        self.saturated = np.where(is_saturated, self.saturated + dt, 0.0)
        # Without this the integral would wind up.
        self._integral = np.where(is_saturated & (torque * self.error > 0.0), self._integral, integral)
        self.correction = push + self._integral
        return tuple(np.clip(torque, -self._max_effort, self._max_effort).tolist())
