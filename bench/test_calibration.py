"""The study of `calibrate` on one device, and what the command line says when something is wrong: all offline."""

from __future__ import annotations

import math
import os
from pathlib import Path
from unittest.mock import patch

import pytest

from exo_gravity.tools import calibrate
from exo_gravity.tools.calibration import live
from exo_gravity.tools.inputs.parameter_file import packaged_config

from .calibration import demo
from .calibration.device import draw
from .calibration.tour import run_tour
from .calibration.verdict import verdict
from .calibration.way import go


def test_too_few_poses_are_reported_with_the_one_that_is_missing_and_nothing_is_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other trouble: test/core/calibration/test_tour.py."""
    params, output = str(packaged_config("sim.yaml")), str(tmp_path / "new.yaml")
    with patch.object(live, "run_tour", run_tour([])):
        assert calibrate.main(["gravity", "--params", params, "--output", output, "--poses", "3"]) == 1
    said = capsys.readouterr().err
    assert "calibrate: not calibrated: 3 poses do not show" in said and "add the pose" in said
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.timeout(400)
def test_a_random_device_is_calibrated_from_motors_to_an_arm_that_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "OMP_NUM_THREADS", "1")
    result = go(draw(0, tmp_path), tmp_path, fewer_poses=4)
    missed = [row for row in verdict([result], []) if not row.held and "within 2 standard errors" not in row.what]
    assert not missed  # of one device, 8 moments are too few to judge their standard errors
    assert math.isfinite(result.creep[0])


@pytest.mark.timeout(300)
def test_the_arm_of_the_demo_falls_before_and_stays_after(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with patch.object(live, "run_tour", run_tour([])):
        assert demo.main(tmp_path / "demo") == 0
    said = capsys.readouterr().out
    assert "degrees per minute before, 0.0" in said
    assert float(said.partition("by itself: ")[2].partition(" ")[0].replace(",", "")) > 5.0
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert {"old.yaml", "new.yaml", "new.html", "before_and_after.png"} <= names
