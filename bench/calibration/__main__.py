# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.calibration [--devices 20] [--first 0] [--output build/calibration]: the study of `calibrate`.

Random simulated devices go through the whole procedure, offline, about a minute each, one on each core. It prints a
line per device and a table, writes both as JSON and Markdown, and exits with 1 if a limit is missed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from ..device_study import as_markdown, options_of
from ..parts import play
from .device import draw
from .verdict import progress, verdict
from .way import Result, WayError, go


def calibrated(seed: int) -> Result | str:
    """Return the result of a device, or the sentence that says why it has none."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            return go(draw(seed, folder), folder)
        except WayError as error:
            return f"device {seed}: {error}"


def main() -> int:
    """Run the study; return the exit code."""
    options = options_of("bench.calibration", "Calibrate random simulated devices.", Path("build/calibration"))
    found = play("calibration", calibrated, options.seeds, lambda one: one if isinstance(one, str) else progress(one))
    results = [one for one in found if not isinstance(one, str)]
    failed = [one for one in found if isinstance(one, str)]
    rows = verdict(results, failed)
    text = f"{as_markdown(rows)}\n"
    print(text)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".md").write_text("\n".join([text, *failed]), encoding="utf-8")
    devices = [dataclasses.asdict(result) for result in results]
    content = {"rows": [row._asdict() for row in rows], "failed": failed, "devices": devices}
    table = json.dumps(content, indent=1, default=_plain)
    options.output.with_suffix(".json").write_text(f"{table}\n", encoding="utf-8")
    return 0 if all(row.held for row in rows) else 1


def _plain(value: np.ndarray | np.generic) -> Any:
    """Return a value of NumPy as JSON knows it."""
    return value.tolist()


if __name__ == "__main__":
    sys.exit(main())
