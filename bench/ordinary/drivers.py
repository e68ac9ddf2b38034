# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Ordinary drivers of an IMU on ordinary computers: when they take samples, how they stamp them, when these arrive."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DURATION = 20.0  # s
BURST = 5e-5  # s between two messages of a batch


@dataclass(frozen=True)
class Timing:
    """taken: s, when each sample was taken; stamps and arrivals: s, by the clock of this computer; (n,) each."""

    taken: np.ndarray
    stamps: np.ndarray
    arrivals: np.ndarray


def in_order(arrivals: np.ndarray) -> np.ndarray:
    """Return arrivals that keep the order of the samples: one that is late holds up those behind it."""
    steps = BURST * np.arange(len(arrivals))
    return np.maximum.accumulate(arrivals - steps) + steps


def even(rate: float = 100.0, duration: float = DURATION) -> np.ndarray:
    """Return the times of a sensor with its own clock."""
    return np.arange(0.0, duration, 1.0 / rate)


def timer(taken: np.ndarray, period: float) -> np.ndarray:
    """Return the arrivals behind an adapter that passes on what it has every `period` s."""
    return in_order(np.ceil(taken / period + 0.37) * period)


def paused(taken: np.ndarray, pause: float, every: float) -> np.ndarray:
    """Return the arrivals at a driver that pauses for `pause` s `every` so many s."""
    phase = (taken + 0.5 * every) % every
    return in_order(taken + np.where(phase < pause, pause - phase, 0.0))


def loop(sleep: Callable[[int], float], work: Callable[[int], float], duration: float) -> np.ndarray:
    """Return when a loop of `sleep(k)` and `work(k)` s takes its samples."""
    steps = [sleep(k) + work(k) for k in range(round(duration / 0.005))]
    taken = np.cumsum(steps)
    return taken[taken < duration]


def by_arrival(taken: np.ndarray, arrivals: np.ndarray) -> Timing:
    """Return the timing of a driver that stamps samples when they arrive."""
    return Timing(taken, arrivals, arrivals)


def true_stamps(taken: np.ndarray, arrivals: np.ndarray | None = None) -> Timing:
    """Return the timing of a driver that knows when its samples were taken."""
    return Timing(taken, taken, in_order(taken + 0.001) if arrivals is None else arrivals)


def ordinary_drivers(duration: float = DURATION) -> dict[str, Timing]:
    """Return the timing of each driver by its name, for `duration` s. Nominal rate: 100 Hz, unless the name says so."""
    random = np.random.default_rng(5)
    taken = even(duration=duration)
    late = np.where(random.random(len(taken)) < 0.1, 0.02, 0.001)
    quick = random.exponential(0.002, len(taken))
    odd = loop(lambda k: 0.01 + 0.005 * (random.random() < 0.05), lambda k: 0.0006, duration)
    heavy = loop(lambda k: 0.01, lambda k: random.uniform(0.0, 0.008), duration)
    kept = random.random(len(taken)) > 0.03
    drivers = {
        "even stamps": true_stamps(taken),
        "even stamps, whole milliseconds": true_stamps(np.round(even(112.0, duration), 3)),
        "arrival, exponential 2 ms": by_arrival(taken, in_order(taken + quick)),
        "arrival, 4 ms USB timer": by_arrival(taken, timer(taken, 0.004)),
        "true stamps, 30 ms pause each 10 s": true_stamps(taken, paused(taken, 0.03, 10.0)),
        "arrival, 30 ms pause each 10 s": by_arrival(taken, paused(taken, 0.03, 10.0)),
        "arrival, 16 ms timer of an FTDI adapter": by_arrival(taken, timer(taken, 0.016)),
        "true stamps, 16 ms timer": true_stamps(taken, timer(taken, 0.016)),
        "loop, work of 0.5 and 1 ms": true_stamps(loop(lambda k: 0.01, lambda k: (0.0005, 0.001)[k % 2], duration)),
        "loop, work of 0.5 and 2 ms": true_stamps(loop(lambda k: 0.01, lambda k: (0.0005, 0.002)[k % 2], duration)),
        "loop, 5 % of the sleeps 5 ms longer": true_stamps(odd),
        "loop, work of 0 to 8 ms": true_stamps(heavy),
        "loop, 5 % longer, delayed": true_stamps(odd, in_order(odd + random.exponential(0.003, len(odd)))),
        "arrival, 10 % late by 20 ms": by_arrival(taken, in_order(taken + late)),
        "true stamps, 10 % late by 20 ms": true_stamps(taken, in_order(taken + late)),
        "3 % of the samples lost": true_stamps(taken[kept]),
        "a clock off by 500 ppm": Timing(taken, taken * 1.0005, in_order(taken + 0.001)),
        "a clock that is set by 20 ms": Timing(taken, taken + 0.02 * (taken > 30.0), in_order(taken + 0.001)),
        "150 ms pauses that delay only the arrival": true_stamps(taken, paused(taken, 0.15, 20.0)),
    }
    for rate in (50.0, 84.0, 95.0, 120.0, 200.0, 500.0):
        other = even(rate, duration)
        drivers[f"{rate:g} Hz"] = true_stamps(other)
        if rate <= 200.0:
            drivers[f"{rate:g} Hz, arrival, 16 ms timer"] = by_arrival(other, timer(other, 0.016))
    # The tilt is late for some 70 ms beyond its time-out of 80 ms: the motors damp, and nothing is let down.
    drivers["tilt late for 70 ms each 4 s"] = true_stamps(taken, paused(taken, 0.15, 4.0))
    return drivers
