# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the tests share."""

import csv
from pathlib import Path

ROOT = Path(__file__).parents[2]  # of the checkout; processes that run `-m test.support.X` start here
CONFIG = ROOT / "config"
DATA = ROOT / "test" / "data"


def csv_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file by the names of its columns."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))
