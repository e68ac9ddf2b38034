# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's torque over a recording, and their share of what carries their arm against gravity.

With their torque tau and the torque w that carries their arm, both (4,), over any span of time

    share = sum tau . w / sum w . w

What accelerates the arm and overcomes friction cancels out of the sum over a movement there and back. The errors of one
joint are taken to be the same over the whole span, as those of a model are: a longer span has no narrower band.
"""

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.lab.observer.momentum import MomentumObserver, WearerEstimate

PERIOD = 0.01  # s between two samples


@dataclass(frozen=True)
class ShareTuning:
    """Over which time the share is taken, and of what."""

    window: float = 1.0  #: s of the sliding share
    least_weight: float = 0.5  #: Nm, root mean square over time of w's length: below, there is nothing to carry


SHARE = ShareTuning()


class WearerCurve(NamedTuple):
    """The wearer's torque over time: what `MomentumObserver` estimates, n times."""

    time: np.ndarray  #: (n,) s
    torque: np.ndarray  #: (n, m) Nm
    deviation: np.ndarray  #: (n, m) Nm, one standard deviation
    weight: np.ndarray  #: (n, m) Nm that carry the wearer's arm


class Share(NamedTuple):
    """The wearer's share, and its standard deviation; NaN where there is nothing to carry. Numbers, or arrays (n,)."""

    value: np.ndarray
    deviation: np.ndarray


class RunningShare:
    """The share of the last `window` s, from one estimate to the next: an older one weighs exponentially less."""

    def __init__(self) -> None:
        self._given = self._carried = 0.0  # Nm^2, the means of the two sums,
        self._errors: Sequence[float] = ()  # and of its deviation's

    def update(self, dt: float, estimate: WearerEstimate) -> tuple[float, float] | None:
        """Take an estimate, `dt` s after the last; return the share and its standard deviation, None for no weight."""
        part, weight = dt / (SHARE.window + dt), estimate.weight
        self._given += part * (sum(map(operator.mul, weight, estimate.torque)) - self._given)
        self._carried += part * (sum(w * w for w in weight) - self._carried)
        columns = zip(self._errors or (0.0,) * len(weight), weight, estimate.deviation, strict=True)
        self._errors = tuple([old + part * (abs(w) * error - old) for old, w, error in columns])
        if self._carried < SHARE.least_weight**2:
            return None
        return self._given / self._carried, math.hypot(*self._errors) / self._carried


def observed(
    settings: Settings,
    time: np.ndarray,
    joints: tuple[np.ndarray, np.ndarray, np.ndarray],
    trunk_at: Callable[[float], tuple[Tilt, Floats3]],
) -> WearerCurve:
    """Return what the observer makes of a recording.

    time: (n,) s, in ascending order. joints: position rad, velocity rad/s and measured effort Nm, (n, m) each; samples
    with NaN are left out. trunk_at: tilt and angular velocity of the trunk at a time in s, as
    `MomentumObserver.update` takes them.
    """
    observer, rows, last = MomentumObserver(settings), [], -math.inf
    for now, *row in zip(time.tolist(), *(values.tolist() for values in joints), strict=True):
        if now - last > 0.9 * PERIOD and all(map(math.isfinite, itertools.chain(*row))):
            last = now
            rows.append((now, *observer.update(now, row, *trunk_at(now))))
    times, *parts = zip(*rows, strict=True) if rows else ((), (), (), ())
    return WearerCurve(np.array(times), *(np.reshape(part, (-1, len(settings.robot.scale))) for part in parts))


def while_between(curve: WearerCurve, spans: Iterable[tuple[float, float]]) -> WearerCurve:
    """Return the parts of the curve within `spans`, each from and to a time in s."""
    within = [(curve.time >= start) & (curve.time <= end) for start, end in spans]
    keep = np.any(within, axis=0) if within else np.zeros(len(curve.time), bool)
    return WearerCurve(*(part[keep] for part in curve))


def share_of(curve: WearerCurve, window: float = math.inf) -> Share:
    """Return the wearer's share over the last `window` s at each time, or one number over the whole curve."""
    products = np.column_stack((
        np.ones(len(curve.time)),
        (curve.torque * curve.weight).sum(axis=1),
        (curve.weight**2).sum(axis=1),
        curve.deviation * np.abs(curve.weight),
    ))  # fmt: skip
    if math.isinf(window):
        sums = products.sum(axis=0)
    else:
        total = np.vstack((np.zeros(products.shape[1]), products.cumsum(axis=0)))
        sums = total[1:] - total[np.searchsorted(curve.time, curve.time - window)]
    count, given, carried = np.moveaxis(sums[..., :3], -1, 0)
    enough = np.where(carried > SHARE.least_weight**2 * count, carried, np.nan)
    return Share(given / enough, np.linalg.norm(sums[..., 3:], axis=-1) / enough)
