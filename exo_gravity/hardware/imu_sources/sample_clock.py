"""Stamps for samples that arrive in batches: spaced by the sensor's own clock, disciplined to ours.

A sensor's oscillator is off by up to 5 %, and a batch is read up to one period, or a scheduling delay, after its
newest sample. A phase-locked loop follows the sensor's period, so that this jitter does not reach the stamps.
"""

from __future__ import annotations

from collections.abc import Sequence

PHASE_GAIN = 0.05  # share of the error that one sample corrects: settles in about 40 samples
PERIOD_GAIN = PHASE_GAIN**2 / 4  # critically damped
MAX_DRIFT = 0.1  # share by which the sensor's period may differ from the nominal one
MAX_SLIP = 10  # periods between prediction and arrival, beyond which samples were lost or the clock was set


class SampleClock:
    """Stamps the samples of one sensor. lost: samples that never came, counted from the gaps that they left."""

    def __init__(self, rate: float) -> None:
        self.lost = 0
        self._nominal = self._period = 1.0 / rate
        self._last: float | None = None  # stamp of the newest sample
        self._is_interrupted = False

    def interrupt(self) -> None:
        """Note that an unknown number of samples is lost before the next one."""
        self._is_interrupted = True

    def stamps(self, arrival: float, skipped: Sequence[int]) -> list[float]:
        """Return a stamp in s for each sample of a batch, rising and at most `arrival`.

        arrival: s, when the newest sample was there. skipped: for each sample, how many before it are known lost.
        """
        if not skipped:
            return []
        steps = len(skipped) + sum(skipped)
        self.lost += sum(skipped)
        start, newest = self._span(arrival, steps)
        self._last = newest
        step, stamps, position = (newest - start) / steps, [], 0
        for missing in skipped:
            position += missing + 1
            stamps.append(start + position * step)
        return stamps

    def _span(self, arrival: float, steps: int) -> tuple[float, float]:
        """Return the stamp before the first and that of the last of `steps` periods."""
        if self._last is not None:
            predicted = self._last + steps * self._period
            # On average the newest sample is half a period old.
            error = arrival - self._period / 2 - predicted
            if abs(error) <= MAX_SLIP * self._period and not self._is_interrupted:
                period = self._period + PERIOD_GAIN * error * min(steps, MAX_SLIP)
                self._period = min(max(period, self._nominal * (1 - MAX_DRIFT)), self._nominal * (1 + MAX_DRIFT))
                return self._last, min(predicted + min(0.5, PHASE_GAIN * steps) * error, arrival)
            self.lost += max(0, round(error / self._period))
        self._is_interrupted = False
        newest = arrival - self._period / 2
        start = newest - steps * self._period
        if self._last is None or self._last >= arrival:  # the clock was set back
            return start, newest
        return max(start, self._last), max(newest, (self._last + arrival) / 2)
