"""The recording of an IMU moved by hand; see test/data/README.md."""

from __future__ import annotations

import numpy as np

from . import DATA


def read_recording() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time (n,) in s, gyroscope (n, 3) in deg/s and accelerometer (n, 3) in g."""
    columns = np.loadtxt(DATA / "imu_handheld.csv", delimiter=",", skiprows=1)
    return columns[:, 0], columns[:, 1:4], columns[:, 4:7]
