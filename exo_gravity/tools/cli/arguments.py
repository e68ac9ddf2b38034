"""Argument types for argparse whose errors name the permitted values."""

from __future__ import annotations

import argparse
import math


def non_negative(text: str) -> float:
    """Return the number that `text` spells, 0 or more; raise ArgumentTypeError otherwise, also for NaN."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not number >= 0.0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number, 0 or more")
    return number
