# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The smoothness of a movement: its spectral arc length (SPARC).

Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet (2015), "On the analysis of movement smoothness", J. Neuroeng.
Rehabil. 12:112: the length of the curve of the speed's normalised spectrum, up to the highest frequency below 10 Hz at
which it reaches 5 %. A single bell-shaped movement has about -1.4; more negative is less smooth.
"""

import math

import numpy as np

HIGHEST = 10.0  # Hz
LEAST = 0.05  # of the largest amplitude
PADDING = 4  # powers of two


def spectral_arc_length(speed: np.ndarray, rate: float) -> float:
    """Return the spectral arc length of a speed profile (n,) sampled at `rate` Hz; NaN where nothing moves."""
    if len(speed) < 4 or not np.any(speed):
        return math.nan
    size = 2 ** (math.ceil(math.log2(len(speed))) + PADDING)
    frequency = np.arange(size // 2) * rate / size
    amplitude = np.abs(np.fft.fft(speed, size))[: size // 2]
    amplitude /= amplitude.max()
    low = frequency <= HIGHEST
    reached = np.flatnonzero(amplitude[low] >= LEAST)
    part = slice(reached[0], reached[-1] + 1)
    frequency, amplitude = frequency[low][part], amplitude[low][part]
    if len(frequency) < 2:
        return math.nan
    steps = np.diff(frequency) / (frequency[-1] - frequency[0])
    return -float(np.sum(np.hypot(steps, np.diff(amplitude))))
