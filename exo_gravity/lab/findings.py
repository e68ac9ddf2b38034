# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What `doctor` found: one row each, with how bad it is and the command that fixes it."""

from enum import IntEnum
from typing import NamedTuple


class Level(IntEnum):
    """How bad a finding is."""

    FINE = 0
    UNKNOWN = 1  #: the computer does not state it, or it could not be tried
    NOTE = 2  #: could be better, without an effect that was seen
    WARNING = 3
    FAULT = 4  #: no one may wear an arm that this computer controls


class Finding(NamedTuple):
    """One row. remedy: the command that fixes it, '' for none."""

    what: str
    found: str
    wanted: str
    level: Level = Level.FINE
    remedy: str = ""


def judged(what: str, found: str, wanted: str, is_fine: bool, otherwise: Level, remedy: str) -> Finding:
    """Return a finding: FINE or `otherwise`; UNKNOWN where nothing was found."""
    if not found:
        return Finding(what, "not stated", wanted, Level.UNKNOWN)
    return Finding(what, found, wanted) if is_fine else Finding(what, found, wanted, otherwise, remedy)
