# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""SPARC, against its integral for a bell whose spectrum is known, its authors' figure, and what must not change it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from exo_gravity.lab.report.smoothness import LEAST, spectral_arc_length

RATE = 100.0
BELL = np.exp(-5.0 * np.arange(-1.0, 1.0, 1.0 / RATE) ** 2)


def test_a_whole_bell_has_the_arc_length_of_its_spectrum():
    """The amplitude of exp(-5 t^2) is a Gaussian of the frequency: LEAST**(u^2), u = 1 where it has fallen to LEAST."""
    slope = 2.0 * math.log(LEAST)
    length, _ = quad(lambda u: math.hypot(1.0, slope * u * LEAST ** (u * u)), 0.0, 1.0)
    whole = np.exp(-5.0 * np.arange(-20.0, 20.0, 1.0 / RATE) ** 2)
    assert spectral_arc_length(whole, RATE) == pytest.approx(-length, abs=5e-4)


def test_a_bell_that_is_cut_off_has_the_value_that_the_authors_code_prints():
    """github.com/siva82kb/SPARC, smoothness.py at 3650934, the example of `sparc`."""
    assert spectral_arc_length(BELL, RATE) == pytest.approx(-1.41403, abs=1e-5)


def test_speed_and_duration_do_not_change_it_and_two_movements_are_less_smooth_than_one():
    assert spectral_arc_length(3.0 * BELL, RATE) == pytest.approx(spectral_arc_length(BELL, RATE))
    assert spectral_arc_length(np.concatenate((BELL, BELL)), RATE) < spectral_arc_length(BELL, RATE) - 0.1
    assert math.isnan(spectral_arc_length(np.zeros(100), RATE))
