# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Ordinary motion is no fault of the IMU: a bow right after a walk, and random motions, are followed throughout."""

from __future__ import annotations

import numpy as np
import pytest

from ..support.imu_faults import follow
from ..support.ordinary_motion import bows, day, worn

SETTLED = 1.2  # s
LONGEST = 0.3  # s without a tilt, which is ridden through for 0.2 s at least unless the trunk turns fast
LARGEST = 2.5  # degrees


def check(motion):
    outcome = follow(motion)
    assert not any(outcome.refusals)
    published = motion.times[np.isfinite(outcome.errors) & (motion.times > SETTLED)]
    assert np.diff(np.concatenate(([SETTLED], published, motion.times[-1:]))).max() < LONGEST
    assert np.nanmax(outcome.errors) < LARGEST


@pytest.mark.parametrize(
    ("angle", "over", "rate"),
    [(0.3, 0.6, 100.0), (0.5, 0.8, 200.0), (1.0, 1.5, 100.0)],
)
def test_a_bow_right_after_a_walk_is_followed(angle, over, rate):
    for number, walk in enumerate((5.0, 10.0, 10.3)):
        check(worn(bows(angle, over, walk), walk + 2.0 * over + 6.0, rate, number))


@pytest.mark.parametrize(("seed", "rate"), [(0, 100.0), (1, 200.0)])
def test_random_ordinary_motion_is_followed(seed, rate):
    check(worn(day(seed, 50.0), 60.0, rate, seed))
