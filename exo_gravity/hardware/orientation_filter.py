"""Orientation from gyroscope and accelerometer by VQF, fed with samples that are not evenly spaced.

VQF (D. Laidig, T. Seel, Information Fusion 91, 2023) averages the accelerometer in the frame that the gyroscope carries
along, and learns the gyroscope's bias at rest and in motion. Its sampling period is fixed, but samples come with jitter
and with gaps. So the rates are scaled such that VQF turns in its period as far as the IMU did between two samples, and
the accelerometer is passed on once for each period that has passed. On evenly spaced samples this is VQF alone.
"""

from __future__ import annotations

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.quaternion import Floats3, Quaternion

try:
    from vqf import VQF
except ImportError:  # needed only for an IMU that reports no orientation
    VQF = None


class OrientationFilter:
    """Follows one IMU; the heading is arbitrary. bias: (3,) rad/s, its standard deviation bias_sigma rad/s."""

    def __init__(self, rate: float) -> None:
        """Create a filter for samples at about `rate` Hz. Raises ParameterError if VQF is not installed."""
        if VQF is None:
            raise ParameterError("orientation", None, "reported by the IMU, or install vqf to fuse it")
        self._period = 1.0 / rate
        self._vqf = VQF(self._period)
        self._due = self._period  # s for which the accelerometer has not been passed on
        self.bias, self.bias_sigma = self._vqf.getBiasEstimate()

    def restart(self) -> None:
        """Forget the orientation, keep the bias."""
        self._vqf.resetState()
        self._vqf.setBiasEstimate(self.bias, self.bias_sigma)
        self._due = self._period

    def advance(self, dt: float, rate: Floats3, last_rate: Floats3, acceleration: Floats3 | None) -> Quaternion:
        """Return the orientation `dt` s after the last sample, world from IMU.

        rate, last_rate: of this sample and the last one. acceleration: None if it is not known.
        """
        vqf, period = self._vqf, self._period
        vqf.updateGyr(self._scaled(dt, rate, last_rate))
        self._due += dt
        count = round(self._due / period)
        self._due -= count * period
        if acceleration is not None:
            measured = np.array(acceleration)
            for _ in range(count):
                vqf.updateAcc(measured)
        self.bias, self.bias_sigma = vqf.getBiasEstimate()
        w, x, y, z = vqf.getQuat6D().tolist()
        return x, y, z, w

    def _scaled(self, dt: float, rate: Floats3, last_rate: Floats3) -> np.ndarray:
        """Return the rate at which VQF turns in its period as far as the IMU has turned in `dt`.

        A rate counts for the period that it ends. Over n periods the rates between the two known ones are interpolated.
        """
        periods = dt / self._period
        mean = np.array(rate)
        if periods > 1.0:
            mean += (last_rate - mean) * (0.5 - 0.5 / periods)
        return self.bias + (mean - self.bias) * periods
