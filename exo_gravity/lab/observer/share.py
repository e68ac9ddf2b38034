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
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import Floats3
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.compensation.settings import Settings
from exo_gravity.lab.observer.momentum import MomentumObserver, WearerEstimate, low_passed

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


Known = tuple[float, float]  # a share, 0..1, and its standard deviation


class Shares(NamedTuple):
    """The wearer's share of what carries their arm; None where there is nothing to carry."""

    whole: Known | None
    joints: tuple[Known | None, ...]  #: (n,)


class RunningShare:
    """The share of the last `window` s, from one estimate to the next: an older one weighs exponentially less."""

    def __init__(self) -> None:
        # Nm^2, (n,): the means of the joints' parts of both sums, and of the deviation's own and common part
        self._given: tuple[float, ...] = ()
        self._carried: tuple[float, ...] = ()
        self._own: tuple[float, ...] = ()
        self._common: tuple[float, ...] = ()

    def update(self, dt: float, estimate: WearerEstimate) -> Shares:
        """Take an estimate, `dt` s after the last; return the shares."""
        part, weight = dt / (SHARE.window + dt), estimate.weight
        nothing = (0.0,) * len(weight)
        size = list(map(abs, weight))
        common = map(common_part, estimate.deviation, estimate.independent)
        self._given = low_passed(self._given or nothing, list(map(operator.mul, weight, estimate.torque)), part)
        self._carried = low_passed(self._carried or nothing, [w * w for w in weight], part)
        self._own = low_passed(self._own or nothing, list(map(operator.mul, size, estimate.independent)), part)
        self._common = low_passed(self._common or nothing, list(map(operator.mul, size, common)), part)
        joints = zip(self._given, self._carried, self._own, self._common, strict=True)
        of_joints = tuple([
            (given / carried, math.hypot(own, common) / carried) if carried > SHARE.least_of_joint**2 else None
            for given, carried, own, common in joints
        ])  # fmt: skip
        carried = sum(self._carried)
        if carried < SHARE.least_weight**2:
            return Shares(None, of_joints)
        return Shares((sum(self._given) / carried, math.hypot(*self._own, sum(self._common)) / carried), of_joints)


def common_part(deviation: float, independent: float) -> float:
    """Return what is left of a standard deviation without its `independent` part."""
    return math.sqrt(max(0.0, deviation**2 - independent**2))


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
    count, given, carried, own, common = _sums(curve, window)
    total = carried.sum(axis=-1)
    enough = np.where(total > SHARE.least_weight**2 * count, total, np.nan)
    error = np.hypot(np.linalg.norm(own, axis=-1), common.sum(axis=-1))
    return Share(given.sum(axis=-1) / enough, error / enough)


def joint_shares(curve: WearerCurve) -> Share:
    """Return the share of each joint (m,) over the whole curve."""
    count, given, carried, own, common = _sums(curve, math.inf)
    enough = np.where(carried > SHARE.least_of_joint**2 * count, carried, np.nan)
    return Share(given / enough, np.hypot(own, common) / enough)


def _sums(curve: WearerCurve, window: float) -> tuple[np.ndarray, ...]:
    """Return, over the last `window` s at each time or over the whole curve, how many samples there are, and four sums.

    These are the two of the share, and of its deviation the joints' own and the common part, each (..., m) in Nm^2.
    """
    size, common = np.abs(curve.weight), np.sqrt(np.maximum(0.0, curve.deviation**2 - curve.independent**2))
    parts = (curve.torque * curve.weight, curve.weight**2, curve.independent * size, common * size)
    products = np.column_stack((np.ones(len(curve.time)), *parts))
    if math.isinf(window):
        sums = products.sum(axis=0)
    else:
        total = np.vstack((np.zeros(products.shape[1]), products.cumsum(axis=0)))
        sums = total[1:] - total[np.searchsorted(curve.time, curve.time - window)]
    return sums[..., 0], *np.split(sums[..., 1:], len(parts), axis=-1)
