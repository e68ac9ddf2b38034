"""The demo of `calibrate`, with the tour played offline instead of on nodes."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from exo_gravity.sim.params import SIMULATOR, device_of
from exo_gravity.tools.calibration import demo, gravity
from exo_gravity.tools.calibration.live import LiveTour
from exo_gravity.tools.inputs.arms import configured_arm, node_values
from exo_gravity.tools.inputs.parameter_file import load

from ..support.tour_run import MOTORS_AS_MOUNTED, TourRun


def offline_tour(options: argparse.Namespace, nodes: Mapping[str, Any], say: object) -> LiveTour:
    """Play the tour on the device of the demo's file."""
    device = device_of(node_values(load(options.params), demo.SIMULATOR, SIMULATOR))
    scales = [motor.joint.torque_scale for motor in device.motors]
    motors = [replace(motor, torque_scale=scale) for motor, scale in zip(MOTORS_AS_MOUNTED, scales, strict=True)]
    arm = configured_arm(options.params)
    run = TourRun(device.arm.config, arm.robot, motors, arm.limits, (device.pitch, device.roll), arm.can_bridge["rate"])
    tour = run.run()
    return LiveTour(list(tour.measured), tour.trouble or "", not tour.trouble)


@pytest.mark.timeout(300)
def test_the_arm_of_the_demo_falls_before_and_stays_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gravity, "run_tour", offline_tour)
    assert demo.main(tmp_path / "demo") == 0
    said = capsys.readouterr().out
    assert "degrees per minute before, 0.0" in said
    before = float(said.partition("by itself: ")[2].partition(" ")[0].replace(",", ""))
    assert before > 5.0
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert {"old.yaml", "new.yaml", "new.html", "before_and_after.png"} <= names
    assert "calibrate gravity" in (tmp_path / "demo" / "new.yaml").read_text(encoding="utf-8")
