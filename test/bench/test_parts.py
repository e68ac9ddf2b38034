# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The parts of a study: played once each, in the order that was asked for, and kept where the study is stopped."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bench import parts

FAILS = 2


def work(item: tuple[str, int]) -> int:
    """Note that a part is played; one of them fails until it may be."""
    folder, number = Path(item[0]), item[1]
    with (folder / f"{number}.played").open("a") as file:
        file.write("x")
    if number == FAILS and not (folder / "repaired").exists():
        raise RuntimeError("a defect")
    return number * number


def test_a_study_that_was_stopped_plays_only_what_was_left(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(parts, "KEPT", tmp_path / "kept")
    items = [(str(tmp_path), number) for number in range(4)]

    def run():
        return parts.play("squares", work, items, str, workers=2)

    def counts():
        return [len((tmp_path / f"{number}.played").read_text()) for number in range(4)]

    with pytest.raises(parts.StudyError, match="RuntimeError: a defect"):
        run()
    assert "1 of 4" in capsys.readouterr().out
    (tmp_path / "repaired").touch()
    assert run() == [0, 1, 4, 9] and counts() == [1, 1, 2, 1]
    assert "3 of 4 parts were played before" in capsys.readouterr().out
    assert run() == [0, 1, 4, 9] and counts() == [2, 2, 3, 2]  # one that has ended begins anew


def test_what_other_code_has_played_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "KEPT", tmp_path / "kept")
    items = [(str(tmp_path), number) for number in range(1, 3)]
    with pytest.raises(parts.StudyError):
        parts.play("squares", work, items, str, workers=1)
    (tmp_path / "repaired").touch()
    monkeypatch.setattr(parts, "_state", lambda files: "changed")
    assert parts.play("squares", work, items, str, workers=1) == [1, 4]
    assert (tmp_path / "1.played").read_text() == "xx"


def test_a_study_is_played_in_other_processes_as_its_command_starts_it():
    """What a package's `__main__` defines cannot be sent to them."""
    words = ("-m", "bench.barrier", "--rule", "the barrier", "--case", "a wrong speed")
    done = subprocess.run([sys.executable, *words], cwd=parts.ROOT, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0 and "| a wrong speed of 3 rad/s, once | the barrier |" in done.stdout, done.stderr
