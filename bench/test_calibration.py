"""The study of `calibrate` on one device, and what the command line says when something is wrong: all offline."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import patch

import pytest

from exo_gravity.tools import calibrate
from exo_gravity.tools.calibration import live
from exo_gravity.tools.inputs.parameter_file import packaged_config
from test.support.tour_run import Hand

from .calibration import demo
from .calibration.device import draw
from .calibration.tour import Player, run_tour
from .calibration.verdict import verdict
from .calibration.way import go

Torque = Callable[[float, Player], Sequence[float] | None]


def slip(time: float, player: Player) -> Sequence[float]:
    """The flexion's torque changes by and by, as if the joint slipped on its shaft."""
    return 0.0, 0.0, min(1.5, 0.1 * max(0.0, time - 20.0)), 0.0


def grip(time: float, player: Player) -> Sequence[float] | None:
    """A hand holds the elbow where it is after 20 s."""
    if time < 20.0:
        return None
    arm = player.device.arm
    held = player.__dict__.setdefault("held", arm.positions[3])
    return 0.0, 0.0, 0.0, 60.0 * (held - arm.positions[3]) - 2.0 * arm.velocities[3]


def unplug(time: float, player: Player) -> None:
    """The motor of the abduction loses its power."""
    player.device.motors[1].unplugged = time > 25.0


def gravity_with(folder: Path, trouble: Torque | None, *more: str) -> int:
    """Run `calibrate gravity` on the device of sim.yaml with `trouble`; return the exit code."""

    def prepare(player: Player) -> None:
        if trouble:
            player.device.start(Hand(lambda time, _: trouble(time, player), player.device))

    params, output = str(packaged_config("sim.yaml")), str(folder / "new.yaml")
    with patch.object(live, "run_tour", run_tour([], prepare)):
        return calibrate.main(["gravity", "--params", params, "--output", output, *more])


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("trouble", "more", "joint", "words"),
    [
        (slip, (), "right_shoulder_flexion", ("between two passes", "beyond its weight and friction")),
        (grip, (), "right_elbow_flexion", ("is a hand on the arm?", "a hand is on the arm")),
        (unplug, (), "right_shoulder_abduction", ("no reply for more than 100 ms",)),
        (None, ("--poses", "3"), "3 poses do not show", ("add the pose",)),
    ],
    ids=["a slipping joint", "a touched arm", "a silent motor", "too few poses"],
)
def test_trouble_is_reported_by_name_and_nothing_is_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], trouble: Torque | None, more: tuple[str, ...], joint: str,
    words: tuple[str, ...],
) -> None:  # fmt: skip
    assert gravity_with(tmp_path, trouble, *more) == 1
    said = capsys.readouterr().err
    assert f"calibrate: not calibrated: {joint}" in said and any(part in said for part in words), said
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
