# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the tests share."""

import csv
from pathlib import Path

from exo_gravity.core import ArmModel

ROOT = Path(__file__).parents[2]  # of the checkout; processes that run `-m test.support.X` start here
CONFIG = ROOT / "config"
DATA = ROOT / "test" / "data"
PARTS = ("shoulder_rotation", "shoulder_abduction", "shoulder_flexion", "elbow_flexion")  # of an arm, for each joint
ROBOT = ArmModel((0.05, 0.13, 0.30, 0.30), (0.046, 0.113, 0.237, 0.128), (0.585, 0.468, 0.598, 0.203))


def csv_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file by the names of its columns."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))
