"""validate: the paper's comparison, reproduced: every law against the Robotics Toolbox's gravload and Pinocchio.

Over 1,053 positions of the workspace, then over 100,000 random ones at each of five limits of the trunk's tilt; with
centres of gravity at the links' far ends, as the paper's equations have it, and as configured. Tables on the terminal,
CSV and figures in a folder. Exit code 0 if all checks held, 1 if one failed, 2 for wrong use or a wrong file.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from exo_gravity.core.anfis_law import AnfisLaw
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.gravity import gravity_torque, paper_static_torque
from exo_gravity.core.tilt import SIDES
from exo_gravity.tools.anfis.data import GRID, from_gravload
from exo_gravity.tools.anfis.training import Trained, train_law
from exo_gravity.tools.comparison import growth
from exo_gravity.tools.comparison.figures import tilt_figure, workspace_figure
from exo_gravity.tools.comparison.laws import TILTS, Row, cases, compare, laws
from exo_gravity.tools.comparison.tables import PAPER_ANFIS, growth_line, law_table, paper_table, write_csv
from exo_gravity.tools.inputs.arms import ConfiguredArm, configured_arm, with_cog_at_link_ends
from exo_gravity.tools.inputs.references import REFERENCES

COUNT, QUICK_COUNT = 100_000, 2_000  # random poses per limit of the tilt
CHUNK = 2_000  # poses between two strokes of the progress bar
ROUNDING = 1e-12  # Nm: what the exact law may differ from a reference
LINK_ENDS, CONFIGURED = "at the link ends", "as configured"


@dataclass(frozen=True)
class Part:
    """One arm's results: its rows, its ANFIS and how that was trained."""

    configured: ConfiguredArm
    rows: list[Row]
    law: AnfisLaw
    trained: list[Trained]


def evaluate(cog: str, configured: ConfiguredArm, count: int) -> Part:
    """Return all laws against all references over the workspace and `count` random poses per tilt."""
    law, trained = train_law(from_gravload(configured), configured.robot)
    references = {name: build(configured.robot) for name, build in REFERENCES.items()}
    rows: list[Row] = []
    total = (math.prod(GRID) + len(TILTS) * count) * len(references)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"comparing, CoGs {cog}", total=total)
        for case in cases(cog, configured, count):
            torque = {name: given(case) for name, given in laws(law).items()}
            for name, reference in references.items():
                expected = []
                for start in range(0, len(case.theta), CHUNK):
                    chunk = slice(start, start + CHUNK)
                    expected.append(reference(case.theta[chunk], case.direction[chunk]))
                    progress.update(task, advance=len(expected[-1]))
                rows += compare(case, torque, name, np.concatenate(expected))
    return Part(configured, rows, law, trained)


def checks(paper: Part, configured: Part) -> Iterator[tuple[bool, str]]:
    """Yield (held, sentence) for each promise."""
    exact = [row for row in paper.rows + configured.rows if row.law == "exact"]
    worst = max(row.largest for row in exact)
    compared = sum(row.count for row in exact if row.joint == 1)
    names = " and ".join(dict.fromkeys(row.reference for row in exact))
    yield (
        worst <= ROUNDING,
        f"exact law within {ROUNDING:g} Nm of {names} in {compared:,} comparisons: largest {worst:.1e} Nm",
    )
    worst = max(row.largest for row in paper.rows if row.law.startswith("EQ") and not row.limit)
    yield worst <= ROUNDING, f"EQ2-EQ5 and EQ1m-EQ4m likewise where d_n = l_n, trunk upright: largest {worst:.1e} Nm"
    for kind, name in (("training", "on its positions"), ("held_out", "between them")):
        ratios = [theirs / ours for ours, theirs in zip(paper.law.error[kind], PAPER_ANFIS, strict=True)]
        yield (
            min(ratios) >= 1.0,
            f"ANFIS {name} at most the paper's RMSE: {', '.join(f'1/{r:.0f}' for r in ratios)} of it, joints 2, 3, 4",
        )


def _growth(configured: ConfiguredArm) -> list[growth.Growth]:
    print(f"\nGrowth of an ANFIS for joint 3, inputs {', '.join(growth.INPUTS)}; Nm; the last rows take a minute")
    print(growth_line())
    rows = []
    for functions, inputs in growth.sizes():
        rows.append(growth.growth(configured, functions, inputs))
        print(growth_line(rows[-1]), flush=True)
    return rows


def _draw(output: Path, part: Part, rows: Sequence[Row]) -> None:
    arm = part.configured.robot
    reference = REFERENCES["gravload"](arm)

    def expected(theta: np.ndarray) -> np.ndarray:
        return reference(theta, np.tile((0.0, 0.0, 1.0), (len(theta), 1)))

    given = {
        "exact": lambda theta: gravity_torque(arm, theta),
        "EQ2-EQ5": lambda theta: paper_static_torque(arm, theta),
        "ANFIS": lambda theta: arm.gain * np.pad(part.law.torques(theta[:, 1:]), ((0, 0), (1, 0))),
    }
    errors = {name: lambda theta, law=law: law(theta) - expected(theta) for name, law in given.items()}
    workspace_figure(output / "workspace.png", part.configured, errors)
    tilt_figure(output / "tilt.png", rows)


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="validate", description="Compare every law with gravload and Pinocchio.")
    parser.add_argument("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged exo.yaml)")
    parser.add_argument("--side", choices=SIDES, default="right", help="which of its arms (default: right)")
    parser.add_argument(
        "--output", metavar="DIR", default="validation", help="for CSV and figures (default: validation)"
    )
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_COUNT:,} random positions instead of {COUNT:,}")
    parser.add_argument("--growth", action="store_true", help="also measure the ANFIS from 2 to 6 inputs (3 minutes)")
    return parser.parse_args(argv)


def _run(options: argparse.Namespace) -> bool:
    configured = configured_arm(options.params, options.side)
    output = Path(options.output)
    output.mkdir(parents=True, exist_ok=True)
    count = QUICK_COUNT if options.quick else COUNT
    paper = evaluate(LINK_ENDS, replace(configured, robot=with_cog_at_link_ends(configured.robot)), count)
    as_configured = evaluate(CONFIGURED, configured, count)
    rows = paper.rows + as_configured.rows
    print("\n".join(law_table(rows)))
    print("\nThe paper's comparison (d_n = l_n, g = 9.8 m/s^2, torques in Nm, not scaled)")
    print("\n".join(paper_table(paper.rows, paper.law, paper.trained)))
    write_csv(output / "laws.csv", rows)
    _draw(output, as_configured, rows)
    written = ["laws.csv", "workspace.png", "tilt.png"]
    if options.growth:
        write_csv(output / "growth.csv", _growth(configured))
        written.append("growth.csv")
    print()
    verdicts = list(checks(paper, as_configured))
    for held, sentence in verdicts:
        print(f"{'held' if held else 'FAILED':<7}{sentence}")
    print(f"{', '.join(written)} in {output}")
    return all(held for held, _ in verdicts)


def main(argv: list[str] | None = None) -> None:
    """Entry point of the executable `validate`."""
    options = _arguments(argv)
    try:
        held = _run(options)
    except (ExoGravityError, OSError) as error:
        print(f"validate: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    raise SystemExit(0 if held else 1)
