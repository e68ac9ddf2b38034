# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the command line of `calibrate` says when a tour shows too little: offline.

`make study NAME=calibrate` and `make study NAME=calibrate-demo` show what a whole calibration gives.
"""

from __future__ import annotations

import math
from pathlib import Path
from unittest.mock import patch

import pytest

from bench.calibration import effects
from bench.calibration.tour import run_tour
from exo_gravity.lab.calibration import live
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.tools import calibrate


def test_too_few_poses_are_reported_with_the_one_that_is_missing_and_nothing_is_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other trouble: test/lab/calibration/test_tour.py."""
    params, output = str(packaged_config("sim.yaml")), str(tmp_path / "new.yaml")
    with patch.object(live, "run_tour", run_tour([])):
        assert calibrate.main(["gravity", "--params", params, "--output", output, "--poses", "3"]) == 1
    said = capsys.readouterr().err
    assert "calibrate: not calibrated: 3 poses do not show" in said and "add the pose" in said
    assert not (tmp_path / "new.yaml").exists()


def test_the_arms_of_the_study_hang_where_a_start_may_begin() -> None:
    """With the stand 0.13 rad forward and 0.12 to the side, joint 1 under the weight hung 0.86 rad from home."""
    ahead, side = effects.LEAN[1], effects.SIDEWAYS
    rotation, abduction, *_ = effects.ARM.limits.home_tolerance
    assert math.atan2(ahead, side[0]) + effects.OFF < rotation and side[1] + effects.OFF < abduction
