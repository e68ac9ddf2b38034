# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibrated parameter file: the old one with new values, and nothing else changed."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.calibration.result import Change, write_changes
from exo_gravity.lab.inputs.arms import configured_arms
from exo_gravity.lab.inputs.parameter_file import load, packaged_config

DAY = datetime.date(2026, 11, 22)
OLD = """\
# The whole arm.
/right/can_bridge:
  ros__parameters:
    can: {interface: socketcan, channel: can0}  # the black box
    zero: [0.0, 0.0,
           # the odd one
           0.0, 0.0]
    direction:
      - 1   # shoulder
      - 1
      - 1
      - 1   # elbow

    # Limits of the stops.
    position_min: [-1.6, -0.1, -0.7, -0.1]

/right/compensator:
  ros__parameters:
    side: right
    robot: {mass: [0.5, 0.4, 0.5, 0.2], cog: [0.04, 0.11, 0.23, 0.12]}
    wearer:
      # of the wearer
      mass: [0.0, 0.0, 0.0, 0.0]
    max_effort: [3.0, 9.0, 3.0, 3.0]"""


def written(tmp_path: Path, *changes: Change, old: str = OLD) -> str:
    params, output = tmp_path / "old.yaml", tmp_path / "new.yaml"
    params.write_text(old, encoding="utf-8")
    output.unlink(missing_ok=True)
    write_changes(params, output, changes, "calibrate motors", DAY)
    return output.read_text(encoding="utf-8")


def added_and_removed(new: str) -> tuple[list[str], list[str]]:
    before, after = OLD.splitlines(), new.splitlines()
    return [line for line in after if line not in before], [line for line in before if line not in after]


def test_a_value_changes_and_a_comment_says_when_and_how_exactly(tmp_path: Path) -> None:
    once = written(tmp_path, Change("/right/can_bridge", "position_min", [-1.5, -0.1, -0.7, 0.0], "rad, ±0.01"))
    assert added_and_removed(once) == (
        ["    # 2026-11-22 calibrate motors: rad, ±0.01", "    position_min: [-1.5, -0.1, -0.7, 0.0]"],
        ["    position_min: [-1.6, -0.1, -0.7, -0.1]"],
    )
    twice = written(tmp_path, Change("/right/can_bridge", "zero", [0.1, 0.2, 0.3, 0.4]), old=once)
    assert twice.count("2026-11-22 calibrate motors") == 2  # both dates stay


def test_the_comments_inside_a_list_stay(tmp_path: Path) -> None:
    new = written(
        tmp_path,
        Change("/right/can_bridge", "direction", [1, -1, 1, -1]),
        Change("/right/can_bridge", "zero", [0.1, 0.2, 0.3, 0.4]),
    )
    assert "      - 1   # shoulder\n      - -1\n      - 1\n      - -1   # elbow\n\n    # Limits" in new
    assert "    zero: [0.1, 0.2,\n           # the odd one\n           0.3, 0.4]\n" in new


def test_a_new_value_joins_the_mapping_that_it_belongs_to(tmp_path: Path) -> None:
    new = written(
        tmp_path,
        Change("/right/compensator", "robot.first_moment", [0.1, 0.2, 0.3, 0.05], "kg m"),
        Change("/right/compensator", "wearer.cog", [0.0, 0.0, 0.1, 0.1], "m"),
        Change("/right/compensator", "gain", [1.0, 1.0, 1.0, 1.0], "none"),
    )
    added, removed = added_and_removed(new)
    comments = [f"# 2026-11-22 calibrate motors: {unit}" for unit in ("kg m", "m", "none")]
    robot = "    robot: {mass: [0.5, 0.4, 0.5, 0.2], cog: [0.04, 0.11, 0.23, 0.12]}"
    assert added == [
        f"    {comments[0]}",
        f"{robot[:-1]}, first_moment: [0.1, 0.2, 0.3, 0.05]}}",
        f"      {comments[1]}",
        "      cog: [0.0, 0.0, 0.1, 0.1]",
        f"    {comments[2]}",
        "    gain: [1.0, 1.0, 1.0, 1.0]",
    ]
    assert removed == [robot]
    assert new.index("wearer:") < new.index("cog: [0.0, 0.0, 0.1") < new.index("max_effort") < new.index("gain")


def test_notes_alone_become_comments_in_their_order(tmp_path: Path) -> None:
    notes = ("first, Coulomb friction 0.1 0.2 0.1 0.1 Nm, " + "and more words " * 12, "second")
    new = written(tmp_path, *(Change("/right/can_bridge", "", 0, note) for note in notes))
    added, removed = added_and_removed(new)
    assert removed == [] and len(added) == 4
    assert all(line.startswith("  # ") and len(line) <= 120 for line in added)
    assert "first" in added[0] and "second" in added[-1]
    assert new.splitlines()[1:7] == ["/right/can_bridge:", *added, "  ros__parameters:"]


@pytest.mark.parametrize("name", ["exo.yaml", "sim.yaml", "sim_both.yaml"])
def test_a_packaged_file_keeps_every_line_and_still_describes_its_arms(tmp_path: Path, name: str) -> None:
    params, output = packaged_config(name), tmp_path / "new.yaml"
    changes = [
        Change("/right/can_bridge", "can_id", [4, 3, 2, 1]),
        Change("/right/can_bridge", "zero", [1e-5, -0.4, 0.1, 1 / 3]),
        Change("/right/compensator", "robot.mass", [0.5, 0.4, 0.3, 0.2]),
    ]
    write_changes(params, output, changes, "calibrate motors", DAY)
    old, new = params.read_text("utf-8").splitlines(), output.read_text("utf-8").splitlines()
    assert len(new) == len(old) + len(changes)
    kept = [line for line in new if line.lstrip().startswith("#") and "2026-11-22" not in line]
    assert kept == [line for line in old if line.lstrip().startswith("#")]
    arm = next(arm for arm in configured_arms(output) if arm.side == "right")
    assert [motor.can_id for motor in arm.motors] == [4, 3, 2, 1]
    assert [motor.zero for motor in arm.motors] == pytest.approx([1e-5, -0.4, 0.1, 1 / 3], rel=1e-6)
    assert list(load(output)) == list(load(params))


SHARED = "/a/x:\n  ros__parameters: &both\n    zero: [0.0]\n/b/x:\n  ros__parameters: *both\n"


@pytest.mark.parametrize(("old", "named"), [(SHARED, "&both"), (OLD, "/left/can_bridge")])
def test_a_value_that_other_entries_share_and_a_node_that_the_file_lacks_are_refused(tmp_path, old, named) -> None:
    with pytest.raises(ParameterError, match=named):
        written(tmp_path, Change("/b/x" if old == SHARED else "/left/can_bridge", "zero", [1.0]), old=old)
    assert not (tmp_path / "new.yaml").exists()


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    params = tmp_path / "old.yaml"
    params.write_text(OLD, encoding="utf-8")
    for output in (params, tmp_path / "none" / "new.yaml"):
        with pytest.raises(ParameterError, match="output"):
            write_changes(params, output, (), "calibrate motors", DAY)
    assert params.read_text(encoding="utf-8") == OLD
