"""The trunk's orientation with VQF as the fusion, fed with samples that are not evenly spaced.

VQF (D. Laidig, T. Seel, Information Fusion 91, 2023) averages the accelerometer in the frame that the gyroscope carries
along, and learns the gyroscope's bias at rest and in motion. Its sampling period is fixed, but samples come with jitter
and with gaps. So the rates are scaled such that VQF turns in its period as far as the IMU did between two samples, and
the accelerometer is passed on once for each period that has passed. On evenly spaced samples this is VQF alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from exo_gravity.core.model.rotation import Floats3, Quaternion
from exo_gravity.core.trunk.estimator import TiltEstimator, TrunkOrientation
from exo_gravity.core.trunk.imu_sample import ACCELEROMETER_RANGE, GYROSCOPE_RANGE, ImuSample

try:
    from vqf import VQF
except ImportError:  # needed only for an IMU that reports no orientation
    VQF = None

__all__ = ["ImuSample", "TrunkEstimator", "TrunkOrientation"]

BIAS_INTERVAL = 10  # samples; the bias changes slowly


class TrunkEstimator(TiltEstimator):
    """Follows one IMU; where VQF is installed, it need not report its orientation."""

    def __init__(
        self,
        rotation_trunk_from_imu: Sequence[float],
        rate: float = 100.0,
        gyroscope_range: float = GYROSCOPE_RANGE,
        accelerometer_range: float = ACCELEROMETER_RANGE,
    ) -> None:
        """Create an estimator; see `core.trunk.estimator.TiltEstimator`."""
        fusion = VqfFusion(rate) if VQF else None
        super().__init__(rotation_trunk_from_imu, fusion, rate, gyroscope_range, accelerometer_range)


class VqfFusion:
    """The `core.trunk.estimator.Fusion` by VQF."""

    def __init__(self, rate: float) -> None:
        """Create a fusion for samples at about `rate` Hz."""
        self._period = 1.0 / rate
        self._vqf = VQF(self._period)
        self._rate, self._acceleration = np.zeros(3), np.zeros(3)  # reused
        self._due = self._period  # s for which the accelerometer has not been passed on
        self._count = 0
        self._read_bias()

    def restart(self) -> None:
        """Forget the orientation, keep the bias."""
        self._vqf.resetState()
        self._vqf.setBiasEstimate(np.array(self.bias), self.bias_sigma)
        self._due = self._period

    def advance(self, dt: float, rate: Floats3, last_rate: Floats3, acceleration: Floats3 | None) -> Quaternion:
        """Return the orientation `dt` s after the last sample; see `Fusion`.

        A rate is that of the period that it ends. Over several periods the rates between the two known ones are
        interpolated.
        """
        vqf, period, scaled = self._vqf, self._period, self._rate
        periods = dt / period
        share = 0.5 - 0.5 / periods if periods > 1.0 else 0.0  # of the last rate
        (x, y, z), (u, v, w), (a, b, c) = rate, last_rate, self.bias
        scaled[0] = a + (x + share * (u - x) - a) * periods
        scaled[1] = b + (y + share * (v - y) - b) * periods
        scaled[2] = c + (z + share * (w - z) - c) * periods
        self._due += dt
        count = round(self._due / period)
        self._due -= count * period
        if acceleration is None:
            count = 0
        else:
            measured = self._acceleration
            measured[0], measured[1], measured[2] = acceleration
        if count:
            vqf.update(scaled, measured)
        else:
            vqf.updateGyr(scaled)
        for _ in range(1, count):
            vqf.updateAcc(measured)
        self._count += 1
        if self._count % BIAS_INTERVAL == 0:
            self._read_bias()
        w, x, y, z = vqf.getQuat6D().tolist()
        return x, y, z, w

    def _read_bias(self) -> None:
        bias, self.bias_sigma = self._vqf.getBiasEstimate()
        self.bias: Floats3 = tuple(bias.tolist())
