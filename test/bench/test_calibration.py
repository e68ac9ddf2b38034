# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The study `calibrate` begins where an arm may start; `make study NAME=calibrate` shows what a calibration gives."""

from __future__ import annotations

import math

from bench.calibration import effects


def test_the_arms_of_the_study_hang_where_a_start_may_begin() -> None:
    """With the stand 0.13 rad forward and 0.12 to the side, joint 1 under the weight hung 0.86 rad from home."""
    ahead, side = effects.BACK_AND_FORTH[1], effects.SIDEWAYS
    rotation, abduction, *_ = effects.ARM.limits.home_tolerance
    assert math.atan2(ahead, side[0]) + effects.OFF < rotation and side[1] + effects.OFF < abduction
