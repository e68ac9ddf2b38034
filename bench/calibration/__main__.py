"""python -m bench.calibration [--devices 20] [--first 0] [--output build/calibration]: the study of `calibrate`.

Random simulated devices go through the whole procedure, offline and on one core, about a minute each. It prints a line
per device and a table, writes both as JSON and Markdown, and exits with 1 if a limit is missed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from ..device_study import as_markdown, options_of
from .device import draw
from .verdict import progress, verdict
from .way import Result, WayError, go


def main() -> int:
    """Run the study; return the exit code."""
    options = options_of("bench.calibration", "Calibrate random simulated devices.", Path("build/calibration"))
    results: list[Result] = []
    failed: list[str] = []
    begin = time.monotonic()
    for seed in range(options.first, options.first + options.devices):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            try:
                results.append(go(draw(seed, folder), folder))
                print(f"{progress(results[-1])} ({time.monotonic() - begin:.0f} s)", flush=True)
            except WayError as error:
                failed.append(f"device {seed}: {error}")
                print(failed[-1], flush=True)
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
