"""CONTRIBUTING's "Add a motor" and "Add a wire format": one entry each, and an arm with it is carried."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from ..support import ROOT


def after_adding(what: str) -> Any:
    """Return what `test/support/added_motor.py` finds with the entry."""
    command = [sys.executable, "-m", "test.support.added_motor", what]
    return json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)


def test_an_entry_in_motors_is_all_that_a_motor_needs() -> None:
    carried = after_adding("motor")
    assert carried["refusal"].startswith("wire_format = 'mit_v3': must be another format for an AK70-10")
    assert (carried["state"], carried["fault"], carried["on"], carried["off"]) == ("active", None, [True] * 4, True)
    # Less than half a turn of the rotor at the output: 18 degrees.
    assert carried["home_tolerance"] == pytest.approx([0.30, 0.34, 0.30, 0.50])
    assert carried["peak"] == [24.8, 18.0, 24.8, 9.0]
    assert carried["most"] == [0.0, 24.8]
    assert carried["rotors"] == [4.1e-3, 4.9e-3, 4.1e-3, 8.8e-4]


def test_an_entry_in_formats_is_all_that_a_wire_format_needs() -> None:
    carried = after_adding("format")
    assert (carried["state"], carried["fault"], carried["on"], carried["off"]) == ("active", None, [True] * 4, True)
    assert not carried["ignored"]
