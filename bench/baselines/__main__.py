# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""python -m bench.baselines [--only growth,learned]: laws without a model, compared with the exact law.

Tables go to the terminal, CSV files and a figure to a folder. It takes six minutes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from exo_gravity.lab.inputs.arms import ConfiguredArm, configured_arm

from . import growth, learned
from .report import baseline_line, figure, growth_line, write_csv


def measure_growth(configured: ConfiguredArm, output: Path) -> None:
    """Print and write how an ANFIS grows with its inputs."""
    print(f"Growth of an ANFIS for joint 3, inputs {', '.join(growth.INPUTS)}; Nm; the last rows take a minute")
    print(growth_line())
    rows = []
    for functions, inputs in growth.sizes():
        rows.append(growth.growth(configured, functions, inputs))
        print(growth_line(rows[-1]), flush=True)
    write_csv(output / "growth.csv", rows)


def measure_learned(configured: ConfiguredArm, output: Path) -> None:
    """Print, write and draw what laws without a model are worth."""
    print(f"Laws without a model of the arm, from {learned.SAMPLES:,} torques without noise; against gravload")
    print(baseline_line())
    rows = []
    for row in learned.baselines(configured):
        rows.append(row)
        print(baseline_line(row), flush=True)
    write_csv(output / "baselines.csv", rows)
    figure(rows).savefig(output / "baselines.png", dpi=130)


def main() -> None:
    """Run the chosen parts."""
    parser = argparse.ArgumentParser(prog="bench.baselines", description="Measure laws without a model of the arm.")
    parser.add_argument("--only", default="growth,learned", metavar="PARTS", help="parts to run (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("build/baselines"), metavar="DIR", help="(%(default)s)")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    parts = {"growth": measure_growth, "learned": measure_learned}
    for part in options.only.split(","):
        parts[part](configured_arm(), options.output)
    print(f"Written: {options.output}")


if __name__ == "__main__":
    main()
