# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's torque over a recording, and their share of what carries their arm against gravity.

With their torque tau and the torque w that carries their arm against gravity alone, both (n,), over any span of time

    share = sum tau . w / sum w . w                of joint j: sum tau_j w_j / sum w_j^2

The whole share is the mean of the joints', weighted by sum w_j^2: a joint that carries little hardly changes it. What
accelerates the arm and overcomes friction cancels out of the sum over a movement there and back. The errors of one
joint are taken to be the same over the whole span, as those of a model are: a longer span has no narrower band. An
error of the weight itself is the same share of it in every joint.
"""

import itertools
import math
from collections.abc import Callable, Iterable
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
    least_of_joint: float = 0.3  #: Nm, the same of one joint


SHARE = ShareTuning()


class WearerCurve(NamedTuple):
    """The wearer's torque over time: what `MomentumObserver` estimates, n times."""

    time: np.ndarray  #: (n,) s
    torque: np.ndarray  #: (n, m) Nm
    deviation: np.ndarray  #: (n, m) Nm, one standard deviation
    weight: np.ndarray  #: (n, m) Nm that carry the wearer's arm
    independent: np.ndarray  #: (n, m) Nm, the part of the deviation that is each joint's own


class Share(NamedTuple):
    """The wearer's share, and its standard deviation; NaN where there is nothing to carry. Numbers, or arrays (n,)."""

    value: np.ndarray
    deviation: np.ndarray


class Shares(NamedTuple):
    """The wearer's share of what carries their arm."""

    whole: Share
    joints: Share  #: (m,)


class RunningShare:
    """The share of the last `window` s, from one estimate to the next: an older one weighs exponentially less."""

    def __init__(self) -> None:
        self._means: np.ndarray | float = 0.0  # (4, m) Nm^2, see `_products`

    def update(self, dt: float, estimate: WearerEstimate) -> Shares:
        """Take an estimate, `dt` s after the last; return the shares."""
        products = _products(*(np.array(column) for column in estimate))
        self._means = self._means + dt / (SHARE.window + dt) * (products - self._means)
        return _shares(self._means, 1.0)


def observed(
    settings: Settings,
    time: np.ndarray,
    joints: tuple[np.ndarray, np.ndarray, np.ndarray],
    trunk_at: Callable[[float], tuple[Tilt, Floats3, Tilt]],
) -> WearerCurve:
    """Return what the observer makes of a recording.

    time: (n,) s, in ascending order. joints: position rad, velocity rad/s and measured effort Nm, (n, m) each; samples
    with NaN are left out. trunk_at: tilt of what the trunk feels, its angular velocity, and tilt of gravity alone at a
    time in s, as `MomentumObserver.update` takes them.
    """
    observer, rows, last = MomentumObserver(settings), [], -math.inf
    for now, *row in zip(time.tolist(), *(values.tolist() for values in joints), strict=True):
        if now - last > 0.9 * PERIOD and all(map(math.isfinite, itertools.chain(*row))):
            last = now
            rows.append((now, *observer.update(now, row, *trunk_at(now))))
    times, *parts = zip(*rows, strict=True) if rows else ((),) * 5
    return WearerCurve(np.array(times), *(np.reshape(part, (-1, len(settings.robot.scale))) for part in parts))


def while_between(curve: WearerCurve, spans: Iterable[tuple[float, float]]) -> WearerCurve:
    """Return the parts of the curve within `spans`, each from and to a time in s."""
    within = [(curve.time >= start) & (curve.time <= end) for start, end in spans]
    keep = np.any(within, axis=0) if within else np.zeros(len(curve.time), bool)
    return WearerCurve(*(part[keep] for part in curve))


def share_of(curve: WearerCurve, window: float = math.inf) -> Share:
    """Return the wearer's share over the last `window` s at each time, or one number over the whole curve."""
    products = _products(*curve[1:])
    if math.isinf(window):
        return _shares(products.sum(axis=1), len(curve.time)).whole
    total = np.pad(products.cumsum(axis=1), ((0, 0), (1, 0), (0, 0)))
    first = np.searchsorted(curve.time, curve.time - window)
    return _shares(total[:, 1:] - total[:, first], np.arange(len(first)) + 1 - first).whole


def joint_shares(curve: WearerCurve) -> Share:
    """Return the share of each joint (m,) over the whole curve."""
    return _shares(_products(*curve[1:]).sum(axis=1), len(curve.time)).joints


def _products(torque: np.ndarray, deviation: np.ndarray, weight: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """Return what is summed, (4, ..., m) in Nm^2, of an estimate or a curve, (..., m) in Nm each.

    These are the two parts of the share, and of its deviation the joints' own and the common part.
    """
    size, common = np.abs(weight), np.sqrt(np.maximum(0.0, deviation**2 - independent**2))
    return np.array((torque * weight, weight**2, independent * size, common * size))


def _shares(sums: np.ndarray, count: np.ndarray | float) -> Shares:
    """Return the shares of the sums of `count` products, (4, ..., m) in Nm^2."""
    given, carried, own, common = sums
    total = carried.sum(axis=-1)
    total = np.where(total > SHARE.least_weight**2 * count, total, np.nan)
    of_joint = np.where(carried > SHARE.least_of_joint**2 * np.expand_dims(count, -1), carried, np.nan)
    error = np.hypot(np.linalg.norm(own, axis=-1), common.sum(axis=-1))
    whole = Share(given.sum(axis=-1) / total, error / total)
    return Shares(whole, Share(given / of_joint, np.hypot(own, common) / of_joint))
