"""SPARC, against the value that its authors' code prints for its example, and against what must not change it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exo_gravity.lab.report.smoothness import spectral_arc_length

RATE = 100.0
BELL = np.exp(-5.0 * np.arange(-1.0, 1.0, 1.0 / RATE) ** 2)


def test_a_bell_has_the_value_that_the_authors_give():
    """github.com/siva82kb/SPARC, smoothness.py, the example of `sparc`: -1.41403."""
    assert spectral_arc_length(BELL, RATE) == pytest.approx(-1.41403, abs=1e-4)


def test_speed_and_duration_do_not_change_it_and_two_movements_are_less_smooth_than_one():
    assert spectral_arc_length(3.0 * BELL, RATE) == pytest.approx(spectral_arc_length(BELL, RATE))
    assert spectral_arc_length(np.concatenate((BELL, BELL)), RATE) < spectral_arc_length(BELL, RATE) - 0.1
    assert math.isnan(spectral_arc_length(np.zeros(100), RATE))
