"""What a recording holds, as plain data that needs no bag library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from exo_gravity.core.params import Param
from exo_gravity.core.trial.recording import Recording


class Event(NamedTuple):
    """A fault, a warning or a changed parameter: s since the start of the recording, and a text."""

    time: float
    text: str


@dataclass(frozen=True)
class Bag:
    """What a recording holds.

    start: ns since 1970 of time 0. recordings: one per arm. events: faults, warnings and changed parameters.
    parameters: YAML text by node. notes: missing parts that do no harm. problems: unreadable parts, one sentence each.
    is_partial: whether the recording was cut short, or ends before its arms were down.
    """

    path: Path
    start: int
    recordings: tuple[Recording, ...]
    events: tuple[Event, ...]
    parameters: dict[str, str]
    notes: tuple[str, ...]
    problems: tuple[str, ...]
    is_partial: bool = False


# The parameters of `recorder`.
# fmt: off
RECORDER = (
    Param("output", "", "new folder for the recording", fixed=True, required=True),
    Param("live", False, "print the latest state as one line of JSON, ten times a second", fixed=True),
)
# fmt: on
