# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The inertia of an arm from a URDF, by Pinocchio: of links, load, wearer and rotors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from exo_gravity.core.arm.gravity import Torque
from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.hardware.urdf_model import UrdfJoints

POSES = 500  # at random, for the least inertia


class UrdfLinks:
    """The inertia of an arm by Pinocchio: `Links` of core/arm/interface.py.

    moves: how the joints of `model` move.
    rotors: (n,) kg m^2 at the joints.
    """

    def __init__(self, pin: Any, model: Any, moves: UrdfJoints, rotors: Sequence[float]) -> None:
        self._pin, self._moves, self._rotors = pin, moves, np.array(rotors)
        self._model, self._data = model, model.createData()

    def torque(self, theta: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]) -> Torque:
        """Return the torque (n,) in Nm for theta rad, velocity rad/s and acceleration rad/s^2, (n,) each."""
        self._model.gravity.linear = self._model.gravity.angular = np.zeros(3)
        rates = (self._moves.own @ values for values in (velocity, acceleration))
        torque = self._pin.rnea(self._model, self._data, self._moves.configuration(theta), *rates)
        return tuple((self._moves.own.T @ torque + self._rotors * acceleration).tolist())

    def momentum(
        self, theta: Sequence[float], velocity: Sequence[float], turning: Floats3 = ZERO
    ) -> tuple[Torque, Torque]:
        """Return the generalized momentum p = M v, (n,) kg m^2/s, and C^T v, (n,) Nm, with M' = C + C^T.

        turning: angular velocity of the base, (3,) rad/s, whose part is neglected.
        """
        speed, at = self._moves.own @ velocity, self._moves.configuration(theta)
        momentum = self.matrix(theta) @ np.asarray(velocity)
        coriolis = self._pin.computeCoriolisMatrix(self._model, self._data, at, speed)
        return tuple(momentum.tolist()), tuple((self._moves.own.T @ (coriolis.T @ speed)).tolist())

    def matrix(self, theta: Sequence[float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 at `theta` (n,) rad."""
        upper = np.triu(self._pin.crba(self._model, self._data, self._moves.configuration(theta)))
        own = self._moves.own
        return np.asarray(own.T @ (upper + np.triu(upper, 1).T) @ own + np.diag(self._rotors))

    @cached_property
    def least(self) -> tuple[float, ...]:
        """The least inertia (n,) in kg m^2 that each joint feels, the other joints being free, in poses at random."""
        poses = np.random.default_rng(0).uniform(-math.pi, math.pi, (POSES, len(self._moves.names)))
        return tuple(np.min([1.0 / np.diag(np.linalg.inv(self.matrix(pose))) for pose in poses], axis=0).tolist())
