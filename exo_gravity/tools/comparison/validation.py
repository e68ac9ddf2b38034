"""The paper's comparison as a whole: both sets of centres of gravity, tables, files, and the checks of the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.core.model.gravity import gravity_torque, paper_static_torque
from exo_gravity.tools.anfis.data import GRID, from_gravload
from exo_gravity.tools.anfis.training import Trained, train_law
from exo_gravity.tools.comparison import growth
from exo_gravity.tools.comparison.figures import Error, baseline_figure, tilt_figure, workspace_figure
from exo_gravity.tools.comparison.laws import TILTS, Row, cases, compare, laws
from exo_gravity.tools.comparison.tables import baseline_line, growth_line, law_table, paper_table, write_csv
from exo_gravity.tools.inputs.arms import ConfiguredArm, with_cog_at_link_ends
from exo_gravity.tools.inputs.references import PAPER_ANFIS, REFERENCES

CHUNK = 2_000  # poses between two updates of the progress bar
ROUNDING = 1e-12  # Nm; the exact law may differ this much from a reference
LINK_ENDS, CONFIGURED = "at the link ends", "as configured"


@dataclass(frozen=True)
class Part:
    """The results of one arm: its rows, its ANFIS and how that was trained."""

    configured: ConfiguredArm
    rows: list[Row]
    law: AnfisLaw
    trained: list[Trained]


def evaluate(cog: str, configured: ConfiguredArm, count: int) -> Part:
    """Compare all laws with all references over the workspace and `count` random poses per tilt limit."""
    references = {name: build(configured.robot) for name, build in REFERENCES.items()}
    law, trained = train_law(from_gravload(configured), configured.robot)
    rows: list[Row] = []
    total = (math.prod(GRID) + len(TILTS) * count) * len(references)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"comparing, CoGs {cog}", total=total)
        for case in cases(cog, configured, count):
            torque = {name: compute(case) for name, compute in laws(law).items()}
            for name, reference in references.items():
                expected = []
                for start in range(0, len(case.theta), CHUNK):
                    chunk = slice(start, start + CHUNK)
                    expected.append(reference(case.theta[chunk], case.direction[chunk]))
                    progress.update(task, advance=len(expected[-1]))
                rows += compare(case, torque, name, np.concatenate(expected))
    return Part(configured, rows, law, trained)


@dataclass(frozen=True)
class Validation:
    """link_ends: with the paper's assumptions, d_n = l_n. as_configured: with the configured centres of gravity."""

    link_ends: Part
    as_configured: Part

    @classmethod
    def of(cls, configured: ConfiguredArm, count: int) -> Validation:
        """Return the comparison of an arm over `count` random poses per tilt limit."""
        ends = replace(configured, robot=with_cog_at_link_ends(configured.robot))
        return cls(evaluate(LINK_ENDS, ends, count), evaluate(CONFIGURED, configured, count))

    @property
    def rows(self) -> list[Row]:
        """The rows of both parts."""
        return self.link_ends.rows + self.as_configured.rows

    def tables(self) -> Iterator[str]:
        """Yield the lines of all tables."""
        part = self.link_ends
        yield from law_table(self.rows)
        yield "\nThe paper's comparison (d_n = l_n, g = 9.8 m/s^2, torques in Nm, not scaled)"
        yield from paper_table(part.rows, part.law, part.trained)

    def checks(self) -> Iterator[tuple[bool, str]]:
        """Yield (held, sentence) for each check."""
        exact = [row for row in self.rows if row.law == "exact"]
        largest = max(row.largest for row in exact)
        compared = sum(row.count for row in exact if row.joint == 1)
        names = " and ".join(dict.fromkeys(row.reference for row in exact))
        yield (
            largest <= ROUNDING,
            f"exact law within {ROUNDING:g} Nm of {names} in {compared:,} comparisons: largest {largest:.1e} Nm",
        )
        upright = [row for row in self.link_ends.rows if row.law.startswith("EQ") and not row.limit]
        largest = max(row.largest for row in upright)
        yield largest <= ROUNDING, f"EQ2-EQ5 and EQ1m-EQ4m too, with d_n = l_n, trunk upright: largest {largest:.1e} Nm"
        for kind, where in (("training", "at the training positions"), ("held_out", "between them")):
            ratios = [paper / ours for ours, paper in zip(self.link_ends.law.error[kind], PAPER_ANFIS, strict=True)]
            shares = ", ".join(f"1/{ratio:.0f}" for ratio in ratios)
            yield min(ratios) >= 1.0, f"ANFIS {where}: RMSE {shares} of the paper's, joints 2, 3, 4"

    def write(self, output: Path) -> list[str]:
        """Write the rows as CSV, and the figures; return the names of the files."""
        arm, law = self.as_configured.configured.robot, self.as_configured.law
        reference = REFERENCES["gravload"](arm)

        def error_of(torque: Callable[[np.ndarray], np.ndarray]) -> Error:
            return lambda theta: torque(theta) - reference(theta, np.tile((0.0, 0.0, 1.0), (len(theta), 1)))

        errors = {
            "exact": error_of(lambda theta: gravity_torque(arm, theta)),
            "EQ2-EQ5": error_of(lambda theta: paper_static_torque(arm, theta)),
            "ANFIS": error_of(lambda theta: arm.gain * np.pad(law.torques(theta[:, 1:]), ((0, 0), (1, 0)))),
        }
        write_csv(output / "laws.csv", self.rows)
        workspace_figure(output / "workspace.png", self.as_configured.configured, errors)
        tilt_figure(output / "tilt.png", self.rows)
        return ["laws.csv", "workspace.png", "tilt.png"]

    def measure_growth(self, output: Path) -> str:
        """Print and write how the ANFIS grows with its inputs; return the name of the file."""
        print(f"\nGrowth of an ANFIS for joint 3, inputs {', '.join(growth.INPUTS)}; Nm; the last rows take a minute")
        print(growth_line())
        rows = []
        for functions, inputs in growth.sizes():
            rows.append(growth.growth(self.as_configured.configured, functions, inputs))
            print(growth_line(rows[-1]), flush=True)
        write_csv(output / "growth.csv", rows)
        return "growth.csv"

    def measure_baselines(self, output: Path) -> list[str]:
        """Print and write what laws without a model are worth; return the names of the files."""
        from exo_gravity.tools.comparison.baselines import SAMPLES, baselines

        print(f"\nLaws without a model of the arm, from {SAMPLES:,} torques without noise; against gravload")
        print(baseline_line())
        rows = []
        for row in baselines(self.as_configured.configured):
            rows.append(row)
            print(baseline_line(row), flush=True)
        write_csv(output / "baselines.csv", rows)
        baseline_figure(output / "baselines.png", rows)
        return ["baselines.csv", "baselines.png"]
