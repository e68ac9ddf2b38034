"""What is known of the arm's torques while it is being measured: a mean and a standard deviation for every pose.

Each joint has moments of its own, in the Nm that its motor is commanded: its unknown torque scale is then part of them.
They start from the parameter file's arm with a wide uncertainty, and every measured pose narrows it (a Kalman update).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import LAWS, Torque
from exo_gravity.core.model.moments import regressor
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.core.numbers import JOINT_COUNT, Vector

UNSURE = 0.4  # of a moment: masses and torque scales that are each off by 30 %
UNSURE_MOMENT = 0.02  # kg m, in addition: off-axis moments of which the file knows nothing
UNEXPLAINED = 0.05  # Nm: standard deviation of what no moment explains


class TorqueGuess:
    """The commanded torque that holds the arm, as far as it is known.

    length: (4,) m. moments: (8,) kg m, as in `core.model.moments`, with the load. tilt: of the trunk or the stand.
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
    def moments(self) -> np.ndarray:
        """The moments (4, 8) in kg m that each joint shows, in its commanded torque."""
        return self._mean

    @property
    def common_moments(self) -> np.ndarray:
        """The moments (8,) in kg m as the joints show them on average; M_n is that of joint n."""
        return np.append(np.diag(self._mean[:, :JOINT_COUNT]), self._mean[:, JOINT_COUNT:].mean(axis=0))

    def torque(self, theta: Sequence[float]) -> Torque:
        """Return the expected torque (4,) in Nm at `theta` (4,) rad, in plain floats for the control loop."""
        law = LAWS["exact"]
        return tuple(law.torque(arm, theta, self.tilt)[joint] for joint, arm in enumerate(self._arms))

    def torques(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected torque and its standard deviation, both (n, 4) Nm, at `theta` (n, 4) rad."""
        rows = regressor(theta, self.tilt.direction, self.gravity)
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
