# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Stamps for samples that arrive in batches over a serial port."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class SampleClockTuning:
    """How the stamps follow the arrival of the samples."""

    phase_gain: float = 0.05  #: share of the error that one sample corrects: it has gone after about 40 samples
    period_gain: float = 0.05**2 / 4  #: critically damped
    largest_share: float = 0.5  #: of the error that one batch corrects
    period_tolerance: float = 0.1  #: share by which the sensor's period may differ from the nominal one
    longest_slip: float = (
        10.0  #: periods between prediction and arrival; beyond, samples were lost or the clock was set
    )


class SampleClock:
    """Stamps samples that arrive in batches: spaced by the sensor's own clock, disciplined to ours.

    A sensor's oscillator is off by up to 5 %, and a batch is read up to one period, or a scheduling delay, after its
    newest sample. A phase-locked loop follows the sensor's period, so that this jitter does not reach the stamps.
    """

    tuning = SampleClockTuning()

    def __init__(self, rate: float) -> None:
        self.lost = 0  #: samples that never came, by the gaps that they left
        self._nominal = self._period = 1.0 / rate
        self._last: float | None = None  # stamp of the newest sample

    def stamps(self, arrival: float, skipped: Sequence[int]) -> list[float]:
        """Return a stamp in s for each sample of a batch, rising and at most `arrival`.

        arrival: s, when the newest sample was there. skipped: for each sample, how many before it are known lost.
        """
        if not skipped:
            return []
        self.lost += sum(skipped)
        positions = list(itertools.accumulate(missing + 1 for missing in skipped))
        start, self._last = self._span(arrival, positions[-1])
        step = (self._last - start) / positions[-1]
        return [start + position * step for position in positions]

    def _span(self, arrival: float, steps: int) -> tuple[float, float]:
        """Return the stamp before the first and that of the last of `steps` periods."""
        if self._last is not None:
            predicted = self._last + steps * self._period
            # On average the newest sample is half a period old.
            error = arrival - self._period / 2 - predicted
            tuning, nominal = self.tuning, self._nominal
            if abs(error) <= tuning.longest_slip * self._period:
                period = self._period + tuning.period_gain * error * min(steps, tuning.longest_slip)
                tolerance = tuning.period_tolerance * nominal
                self._period = min(max(period, nominal - tolerance), nominal + tolerance)
                share = min(tuning.largest_share, tuning.phase_gain * steps)
                return self._last, min(predicted + share * error, arrival)
            self.lost += max(0, round(error / self._period))
        newest = arrival - self._period / 2
        start = newest - steps * self._period
        if self._last is None or self._last >= arrival:  # the clock was set back
            return start, newest
        return max(start, self._last), max(newest, (self._last + arrival) / 2)
