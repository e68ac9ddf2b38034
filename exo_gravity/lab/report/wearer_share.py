# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The wearer's torque and share in a report, by the same observer that runs in the node `wearer`.

It needs the compensator's parameters and, if that used an IMU, `/imu/data`; without `/imu/pitch_yaw`, the weight of the
wearer's arm is taken along what the trunk feels. Parameters that were changed during the recording are those of its
start.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.rotation import ZERO, Floats3
from exo_gravity.core.arm.tilt import Tilt, turning_in_base
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import COVER
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.inputs.arms import recorded_of, settings_from
from exo_gravity.lab.observer.share import SHARE, Share, WearerCurve, joint_shares, observed, share_of, while_between
from exo_gravity.lab.trial.recording import Recording


class WearerPart(NamedTuple):
    """What the wearer of one arm did while it was carried."""

    curve: WearerCurve
    sliding: Share  #: over the last second, at each time of the curve
    whole: Share  #: over the recording
    joints: Share  #: of each joint (n,) over the recording


def of_arm(bag: Bag, recording: Recording) -> WearerPart | None:
    """Return what the wearer of an arm did, None if no wearer is set or the arm was never carried.

    Raises ParameterError or DataError that says why it is not known.
    """
    values = recorded_of(bag.parameters, recording.name, "compensator")
    why = ": the URDF came from a topic, which is not recorded"
    settings = settings_from({**values, "law": "exact"}, why) if values else None
    if settings is None or not any(settings.wearer_mass):
        return None  # without a wearer in the model, the weight of their arm would count as their torque
    times, rows = bag.trunk[:, 0].tolist(), bag.trunk[:, 1:].tolist()
    tilted_at, angles = bag.tilt[:, 0].tolist(), bag.tilt[:, 1:].tolist()
    if settings.use_imu and not times:
        raise DataError("the recording has no /imu/data")

    def trunk_at(now: float) -> tuple[Tilt, Floats3, Tilt]:
        upright = Tilt.of(settings.side)
        if not settings.use_imu:
            return upright, ZERO, upright
        row = rows[min(bisect_left(times, now), len(rows) - 1)]
        felt = gravity = Tilt.of_felt(settings.side, row[3:])
        if angles:
            gravity = Tilt.of(settings.side, *angles[min(bisect_left(tilted_at, now), len(angles) - 1)])
        return felt, turning_in_base(settings.side, row[:3]), gravity

    curve = observed(settings, recording.time, (recording.position, recording.velocity, recording.effort), trunk_at)
    curve = while_between(curve, recording.while_carried(-np.inf, np.inf))
    if not len(curve.time):
        return None
    return WearerPart(curve, share_of(curve, SHARE.window), share_of(curve), joint_shares(curve))


def sentences(part: WearerPart, source: Source, names: Sequence[str]) -> Iterator[str]:
    """Yield the share over the recording, and that of each joint, with their 95 % bands. names: of the joints (n,)."""
    share = part.whole
    where = "In the simulation, the" if source is Source.SIMULATED else "The"
    if np.isfinite(share.value):
        band = COVER * float(share.deviation)
        value = f"{100.0 * float(share.value):.0f} % of their arm's weight (95 % band ±{100.0 * band:.0f})"
        caveat = "" if abs(share.value) > band else ": not distinguishable from zero"
        yield f"{where} wearer carried {value}{caveat}."
    else:
        yield f"{where} wearer's arm hung all the time: there was nothing to carry."
    known = [
        f"{name} {100.0 * value:.0f} % (±{100.0 * COVER * deviation:.0f})"
        for name, value, deviation in zip(names, *part.joints, strict=True)
        if np.isfinite(value)
    ]
    yield f"Of each joint's own weight: {', '.join(known) or 'no joint had any'}."
