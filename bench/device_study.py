# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the studies of random devices share: their options, and the table of what was shown against its limits."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class Row(NamedTuple):
    """A row of the table. limit: '' for none; held: whether the figure is within it."""

    what: str
    shown: str
    limit: str
    held: bool


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the table in Markdown."""
    lines = ["| what | shown | limit | |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {r.what} | {r.shown} | {r.limit} | {'' if r.held else 'missed'} |" for r in rows)])


def options_of(program: str, description: str, output: Path) -> argparse.Namespace:
    """Return `seeds` and `output` of the command line; output: without its suffix."""
    parser = argparse.ArgumentParser(prog=program, description=description)
    option = parser.add_argument
    option("--devices", type=int, default=20, metavar="N", help="how many (default: %(default)s)")
    option("--first", type=int, default=0, metavar="SEED", help="of the first one (default: %(default)s)")
    option("--output", type=Path, default=output, metavar="FILE", help="(default: %(default)s)")
    options = parser.parse_args()
    options.seeds = range(options.first, options.first + options.devices)
    return options
