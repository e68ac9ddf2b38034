"""Moves the arm along a slow reference: expected gravity torque, friction, and a PID controller in joint space.

The controller's output is an acceleration, which the arm's approximate mass matrix turns into torques: so all joints
have the same natural frequency, however they are coupled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from exo_gravity.core.model.gravity import Torque
from exo_gravity.core.model.moments import load_moments
from exo_gravity.core.numbers import JOINT_COUNT, Vector

ROTOR = (0.0015, 0.005, 0.0015, 0.0015)  # kg m^2 at the output: an AK80-9 at joint 2, else a little more than an AK60-6
# kg m^2 added to each joint: with it a 1 kg weight on link 4 at 100 Hz is carried without sticking (measured).
ADDED = 0.005
REACH = (0.8, 0.8, 0.8, 0.6)  # of a link's length, at which its mass is assumed
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
FULL_FRICTION_SPEED = 0.03  # rad/s of the reference, from which on friction is compensated fully


class MassMatrix:
    """The approximate mass matrix of an arm that is known by its first moments: one point of mass on each link.

    length: (4,) m. moment: M1..M4 in kg m, with the load. load: a weight in kg on link 4, and its distance from the
    elbow in m.
    """

    def __init__(self, length: Vector, moment: Vector, load: tuple[float, float] = (0.0, 0.0)) -> None:
        lengths = np.asarray(length, dtype=float)
        bare = np.asarray(moment, dtype=float) - load_moments(lengths.tolist(), *load)[:JOINT_COUNT]
        own = np.zeros(JOINT_COUNT)
        reach = np.maximum(lengths * REACH, 0.01)
        for link in reversed(range(JOINT_COUNT)):
            own[link] = max(0.0, bare[link] - own[link + 1 :].sum() * lengths[link]) / reach[link]
        self._length = lengths
        # Link, mass in kg, and distance from the link's joint in m.
        self._points = [*zip(range(JOINT_COUNT), own, reach, strict=True), (JOINT_COUNT - 1, *load)]

    def at(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (4, 4) in kg m^2 at `theta` (4,) rad."""
        s1, c1, s2, c2 = math.sin(theta[0]), math.cos(theta[0]), math.sin(theta[1]), math.cos(theta[1])
        x1, y1 = np.array((c1, s1, 0.0)), np.array((0.0, 0.0, -1.0))
        z1 = np.array((-s1, c1, 0.0))
        # Frame 2 is turned about z1 by theta_2 - 90 degrees; frames 3 and 4 about z2.
        x2, z2 = s2 * x1 - c2 * y1, -c2 * x1 - s2 * y1
        x3, x4 = (math.cos(a) * x2 + math.sin(a) * z1 for a in (theta[2], theta[2] + theta[3]))
        axes = np.array(((0.0, 0.0, 1.0), z1, z2, z2))
        along = np.array((x1, x2, x3, x4))
        origins = np.zeros((JOINT_COUNT, 3))
        origins[1:] = np.cumsum(along[:-1] * self._length[:-1, None], axis=0)
        matrix = np.diag(ROTOR) + ADDED * np.eye(JOINT_COUNT)
        for link, mass, reach in self._points:
            point = origins[link] + reach * along[link]
            jacobian = np.cross(axes[: link + 1], point - origins[: link + 1])
            matrix[: link + 1, : link + 1] += mass * jacobian @ jacobian.T
        return matrix


class Tracker:
    """The controller of the four joints.

    rate: control cycles per s. max_effort: (4,) Nm. friction: (4,) Nm, compensated in the direction of motion; the
    owner sets it as it becomes known. saturated: (4,) s for which each joint has wanted more than its `max_effort`.
    correction: (4,) Nm, what the controller added to gravity and friction in the last step.
    """

    def __init__(self, rate: float, max_effort: Sequence[float]) -> None:
        self.friction = np.full(JOINT_COUNT, USUAL_FRICTION)
        self.saturated = np.zeros(JOINT_COUNT)
        self.correction = np.zeros(JOINT_COUNT)
        self._frequency = min(MAX_FREQUENCY, FREQUENCY_PER_RATE * rate)
        self._max_effort = np.array(max_effort)
        self._integral = np.zeros(JOINT_COUNT)
        self._slide = np.zeros(JOINT_COUNT)  # Nm that compensate friction

    def shift(self, change: np.ndarray) -> None:
        """Take over a `change` (4,) Nm of the expected torque, so that the effort does not step."""
        self._integral -= change

    def step(
        self,
        dt: float,
        error: np.ndarray,
        speed_error: np.ndarray,
        heading: np.ndarray,
        expected: Sequence[float],
        matrix: np.ndarray,
    ) -> Torque:
        """Return the effort (4,) in Nm.

        error (4,) rad, speed_error (4,) rad/s: reference minus measurement. heading: (4,) rad/s, where the reference
        goes, also while it waits for the arm. expected: (4,) Nm, gravity's torque. matrix: (4, 4) kg m^2.
        """
        frequency = self._frequency
        stiff = matrix @ error * frequency**2
        push = stiff + matrix @ speed_error * 2.0 * frequency
        weakest = float(np.linalg.eigvalsh(matrix)[0])
        integral = self._integral + INTEGRAL_SHARE * frequency * dt * (stiff + FLOOR * weakest * error * frequency**2)
        self._compensate_friction(dt, error, speed_error, heading)
        torque = expected + self._slide + push + integral
        is_saturated = np.abs(torque) > self._max_effort
        self.saturated = np.where(is_saturated, self.saturated + dt, 0.0)
        # Without this the integral would wind up.
        self._integral = np.where(is_saturated & (torque * error > 0.0), self._integral, integral)
        self.correction = push + self._integral
        return tuple(np.clip(torque, -self._max_effort, self._max_effort).tolist())

    def _compensate_friction(self, dt: float, error: np.ndarray, speed_error: np.ndarray, heading: np.ndarray) -> None:
        step = FRICTION_RATE * self.friction * dt
        wanted = self.friction * np.clip(heading / FULL_FRICTION_SPEED, -1.0, 1.0)
        change = np.clip(wanted - self._slide, -step, step)
        way = np.sign(heading)
        is_ahead = (error * way < -AHEAD) | (speed_error * way < -FASTER)
        self._slide += np.where(is_ahead & (change * way > 0.0), 0.0, change)
