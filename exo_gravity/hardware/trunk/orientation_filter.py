"""Orientation from gyroscope and accelerometer by VQF, fed with samples that are not evenly spaced.

VQF (D. Laidig, T. Seel, Information Fusion 91, 2023) averages the accelerometer in the frame that the gyroscope carries
along, and learns the gyroscope's bias at rest and in motion. Its sampling period is fixed, but samples come with jitter
and with gaps. So the rates are scaled such that VQF turns in its period as far as the IMU did between two samples, and
the accelerometer is passed on once for each period that has passed. On evenly spaced samples this is VQF alone.
"""

from __future__ import annotations

import numpy as np

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.quaternion import Floats3, Quaternion

try:
    from vqf import VQF
except ImportError:  # needed only for an IMU that reports no orientation
    VQF = None

BIAS_INTERVAL = 10  # samples; the bias changes slowly


class OrientationFilter:
    """Follows one IMU; the heading is arbitrary. bias: (3,) rad/s, its standard deviation bias_sigma rad/s."""

    def __init__(self, rate: float) -> None:
        """Create a filter for samples at about `rate` Hz. Raises ParameterError if VQF is not installed."""
        if VQF is None:
            raise ParameterError("orientation", None, "reported by the IMU, or install vqf to fuse it")
        self._period = 1.0 / rate
        self._vqf = VQF(self._period)
        self._due = self._period  # s for which the accelerometer has not been passed on
        self._count = 0
        self._read_bias()

    def restart(self) -> None:
        """Forget the orientation, keep the bias."""
        self._vqf.resetState()
        self._vqf.setBiasEstimate(np.array(self.bias), self.bias_sigma)
        self._due = self._period

    def advance(self, dt: float, rate: Floats3, last_rate: Floats3, acceleration: Floats3 | None) -> Quaternion:
        """Return the orientation `dt` s after the last sample, world from IMU.

        rate, last_rate: of this sample and the last one. acceleration: None if it is not known.
        """
        vqf, period = self._vqf, self._period
        vqf.updateGyr(np.array(self._scaled(dt / period, rate, last_rate)))
        self._due += dt
        count = round(self._due / period)
        self._due -= count * period
        if acceleration is not None:
            measured = np.array(acceleration)
            for _ in range(count):
                vqf.updateAcc(measured)
        self._count += 1
        if self._count % BIAS_INTERVAL == 0:
            self._read_bias()
        w, x, y, z = vqf.getQuat6D().tolist()
        return x, y, z, w

    def _read_bias(self) -> None:
        bias, self.bias_sigma = self._vqf.getBiasEstimate()
        self.bias: Floats3 = tuple(bias.tolist())

    def _scaled(self, periods: float, rate: Floats3, last_rate: Floats3) -> list[float]:
        """Return the rate at which VQF turns in its period as far as the IMU has turned in `periods` periods.

        A rate counts for the period that it ends. Over several periods the rates between the two known ones are
        interpolated.
        """
        share = 0.5 - 0.5 / periods if periods > 1.0 else 0.0  # of the last rate
        (x, y, z), (last_x, last_y, last_z), (bias_x, bias_y, bias_z) = rate, last_rate, self.bias
        return [
            bias_x + (x + share * (last_x - x) - bias_x) * periods,
            bias_y + (y + share * (last_y - y) - bias_y) * periods,
            bias_z + (z + share * (last_z - z) - bias_z) * periods,
        ]
