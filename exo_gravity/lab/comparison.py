# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The paper's comparison: every law against every reference, the checks of the result, its tables, CSV and figures.

The paper's laws take the angle between joint 1's axis and gravity as theta_1, as in the compensator.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track

from exo_gravity.core.arm.paper import ArmModel, gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.lab.anfis import AnfisLaw
from exo_gravity.lab.anfis_training import GRID, Trained, axes_of, from_gravload, rms, train_law
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.inputs.references import PAPER_ANALYTICAL, PAPER_ANFIS, PAPER_SECONDS, REFERENCES, gravload
from exo_gravity.lab.report.html import JOINT_COLOURS, make_plain
from exo_gravity.lab.report.table import write_rows

TILTS = (0, 5, 10, 20, 30)  # degrees
ROUNDING = 1e-12  # Nm; the exact law may differ this much from a reference
LINK_ENDS, CONFIGURED = "at the link ends", "as configured"
FLOOR, CEILING = 1e-7, 1.0  # Nm, ends of the colour scale
FIGURE_GRID = (56, 56, 7)  # positions of joints 2, 3, 4 in the workspace figure
# Overlapping lines stay visible, because the first are wider.
STYLES = {"EQ2-EQ5": ("s-", 4.0), "EQ1m-EQ4m": ("D-", 2.0), "ANFIS": ("^--", 1.5), "exact": ("o-", 1.5)}


@dataclass(frozen=True, eq=False)
class Case:
    """Poses of an arm, each with a trunk tilt."""

    cog: str  #: which centres of gravity
    positions: str  #: 'workspace' or 'random'
    limit: int  #: of the tilt, degrees
    arm: ArmModel
    theta: np.ndarray  #: (n, 4) rad
    tilts: Sequence[Tilt]  #: (n,)

    @property
    def direction(self) -> np.ndarray:
        """Gravity's unit vectors in the arm's base frame, (n, 3)."""
        return np.array([tilt.direction for tilt in self.tilts])

    def torques(self, anfis: AnfisLaw) -> dict[str, np.ndarray]:
        """Return the torques (n, 4) in Nm by each law; the ANFIS also outside its training box."""
        axis, beta, phi = np.array([(tilt.axis_angle, tilt.beta, tilt.phi) for tilt in self.tilts]).T
        axis_first = np.column_stack((axis, self.theta[:, 1:]))  # with the paper's theta_1
        return {
            "exact": gravity_torque(self.arm, self.theta, self.direction),
            "EQ2-EQ5": paper_static_torque(self.arm, axis_first),
            "EQ1m-EQ4m": paper_mobile_torque(self.arm, axis_first, beta, phi),
            "ANFIS": self.arm.gain * np.pad(anfis.torques(self.theta[:, 1:]), ((0, 0), (1, 0))),
        }


class Row(NamedTuple):
    """The error in Nm of `law` against `reference` over the poses of a case."""

    cog: str
    positions: str
    limit: int
    poses: int  #: how many
    law: str
    reference: str
    rmse: np.ndarray  #: (4,) Nm, of each joint
    largest: np.ndarray  #: (4,) Nm
    rms_torque: np.ndarray  #: (4,) Nm, of the reference


def cases(cog: str, configured: ConfiguredArm, count: int) -> Iterator[Case]:
    """Yield the 1,053 positions, then `count` random poses for each of `TILTS`."""
    yield _upright(cog, configured, axes_of(configured, GRID))
    for limit in TILTS:
        rng, bound = np.random.default_rng(limit), math.radians(limit)
        theta = rng.uniform(configured.low, configured.high, (count, 4))
        tilts = [Tilt.of(configured.side, *tilt) for tilt in rng.uniform(-bound, bound, (count, 2)).tolist()]
        yield Case(cog, "random", limit, configured.paper_arm, theta, tilts)


def _upright(cog: str, configured: ConfiguredArm, axes: Sequence[np.ndarray]) -> Case:
    """Return every combination of the angles `axes` of joints 2 to 4, with the trunk upright."""
    theta = np.array(list(product((0.0,), *axes)))
    return Case(cog, "workspace", 0, configured.paper_arm, theta, [Tilt.of(configured.side)] * len(theta))


def compare(case: Case, torque: dict[str, np.ndarray], reference: str, expected: np.ndarray) -> Iterator[Row]:
    """Yield a row for each law; torque: of each law (n, 4) Nm; expected: of the reference (n, 4) Nm."""
    for law, given in torque.items():
        error, head = given - expected, (case.cog, case.positions, case.limit, len(case.theta))
        yield Row(*head, law, reference, rms(error), np.abs(error).max(axis=0), rms(expected))


@dataclass(frozen=True)
class Part:
    """The results of one arm: its rows, its ANFIS and how that was trained."""

    configured: ConfiguredArm
    rows: list[Row]
    law: AnfisLaw
    trained: list[Trained]


def evaluate(cog: str, configured: ConfiguredArm, count: int) -> Part:
    """Compare all laws with all references over the workspace and `count` random poses per tilt limit."""
    references = {name: build(configured.paper_arm) for name, build in REFERENCES.items()}
    law, trained = train_law(from_gravload(configured), configured.paper_arm)
    rows: list[Row] = []
    runs = list(cases(cog, configured, count))
    for case in track(runs, f"comparing, CoGs {cog}", console=Console(stderr=True), transient=True):
        torque = case.torques(law)
        for name, reference in references.items():
            rows += compare(case, torque, name, reference(case.theta, case.direction))
    return Part(configured, rows, law, trained)


def checks(link_ends: Part, as_configured: Part) -> Iterator[tuple[bool, str]]:
    """Yield (held, sentence) for each check; link_ends: the results under the paper's assumption d_n = l_n."""
    exact = [row for row in link_ends.rows + as_configured.rows if row.law == "exact"]
    largest = max(row.largest.max() for row in exact)
    compared = sum(row.poses for row in exact)
    names = " and ".join(REFERENCES)
    within = f"exact law within {ROUNDING:g} Nm of {names} in {compared:,} comparisons"
    yield largest <= ROUNDING, f"{within}: largest {largest:.1e} Nm"
    largest = max(row.largest.max() for row in link_ends.rows if row.law.startswith("EQ") and not row.limit)
    yield largest <= ROUNDING, f"EQ2-EQ5 and EQ1m-EQ4m too, with d_n = l_n, trunk upright: largest {largest:.1e} Nm"
    for kind, where in (("training", "at the training positions"), ("held_out", "between them")):
        ratios = [paper / ours for ours, paper in zip(link_ends.law.error[kind], PAPER_ANFIS, strict=True)]
        shares = ", ".join(f"1/{ratio:.0f}" for ratio in ratios)
        yield min(ratios) >= 1.0, f"ANFIS {where}: RMSE {shares} of the paper's, joints 2, 3, 4"


def tables(link_ends: Part, as_configured: Part) -> Iterator[str]:
    """Yield the lines of all tables."""
    yield f"{'RMSE of law - reference, Nm':<28}" + "".join(f"{f'joint {joint}':>10}" for joint in range(1, 5))
    rows = link_ends.rows + as_configured.rows
    for (cog, positions, limit, count), case in groupby(rows, lambda row: row[:4]):
        tilt = f"trunk tilted by up to {limit} degrees" if limit else "trunk upright"
        yield f"CoGs {cog}; {count:,} {positions} positions; {tilt}"
        for row in case:
            if row.reference == "gravload" or row.law == "exact":
                yield f"{f'  {row.law} - {row.reference}':<28}" + "".join(f"{value:>10.1e}" for value in row.rmse)
    yield "\nThe paper's comparison (d_n = l_n, g = 9.8 m/s^2, torques in Nm, not scaled)"
    yield from _paper_table(link_ends)


def _paper_table(part: Part) -> Iterator[str]:
    """Yield the lines of the paper's comparison, its figures next to ours; part: with its assumption d_n = l_n."""
    ours = {row.law: row.rmse for row in part.rows if (row.positions, row.reference) == ("workspace", "gravload")}
    seconds = f"{sum(result.seconds for result in part.trained):.1f} s for all three"
    yield f"{'RMSE against gravload in Nm':<34}{'joint 2':>10}{'joint 3':>10}{'joint 4':>10}   training"
    for name, values, training in (
        ("EQ3-EQ5, the paper", PAPER_ANALYTICAL, ""),
        ("EQ3-EQ5, here", ours["EQ2-EQ5"][1:], ""),
        ("exact law, here", ours["exact"][1:], ""),
        ("ANFIS, the paper", PAPER_ANFIS, f"{PAPER_SECONDS:.0f} s per joint"),
        ("ANFIS, here", part.law.error["training"], seconds),
        ("ANFIS, here, between the positions", part.law.error["held_out"], ""),
    ):
        yield f"{name:<34}{''.join(f'{value:>10.2e}' for value in values)}   {training}".rstrip()


def write(link_ends: Part, as_configured: Part, output: Path) -> list[str]:
    """Write the rows as CSV, one column per field in Nm (`limit` in degrees), and the figures; return the names."""
    rows = link_ends.rows + as_configured.rows
    of_joints = [
        {
            **dict(zip(("cog", "positions", "limit", "count", "law", "reference"), row, strict=False)),
            "joint": joint + 1,
            **{name: getattr(row, name)[joint] for name in ("rmse", "largest", "rms_torque")},
        }
        for row in rows
        for joint in range(4)
    ]
    write_rows(output / "laws.csv", of_joints)
    _workspace_figure(as_configured).savefig(output / "workspace.png", dpi=130)
    _tilt_figure(rows).savefig(output / "tilt.png", dpi=130)
    return ["laws.csv", "workspace.png", "tilt.png"]


def _workspace_figure(part: Part) -> Figure:
    """Draw the RMSE over the elbow of joints 2 to 4 (rows) and each law (columns) over abduction and flexion."""
    axes = axes_of(part.configured, FIGURE_GRID)
    case, (abduction, flexion) = _upright(CONFIGURED, part.configured, axes), map(np.degrees, axes[:2])
    expected, torques = gravload(case.arm)(case.theta, case.direction), case.torques(part.law)
    figure = Figure(figsize=(3.2 * len(torques) + 1.6, 8.4), layout="constrained")
    grid = figure.subplots(3, len(torques), sharex=True, sharey=True)
    for column, (name, torque) in zip(grid.T, torques.items(), strict=True):
        error = rms(np.moveaxis((torque - expected).reshape(*FIGURE_GRID, 4), 2, 0))
        for joint, axis in enumerate(column, start=2):
            image = axis.pcolormesh(
                abduction, flexion, np.clip(error[..., joint - 1].T, FLOOR, CEILING),
                norm=LogNorm(FLOOR, CEILING), cmap="viridis", rasterized=True,
            )  # fmt: skip
            axis.set_title(f"{name}: joint {joint}", fontsize=10)
    figure.supxlabel("Joint 2, abduction (deg)")
    figure.supylabel("Joint 3, flexion (deg)")
    figure.colorbar(image, ax=grid, label="RMSE over the elbow's range (Nm)", extend="min")
    figure.suptitle("Error against gravload over the workspace, trunk upright, configured centres of gravity")
    return figure


def _tilt_figure(rows: Sequence[Row]) -> Figure:
    """Draw the RMSE of each law over the tilt limit: one column per joint, one row per set of centres of gravity."""
    figure = Figure(figsize=(13, 6.4), layout="constrained")
    grid = figure.subplots(2, 4, sharex=True, sharey="col")
    for cog, line in zip((LINK_ENDS, CONFIGURED), grid, strict=True):
        for (law, (style, width)), colour in zip(STYLES.items(), JOINT_COLOURS, strict=True):
            chosen = ("random", cog, law, "gravload")
            rmse = [row.rmse for row in rows if (row.positions, row.cog, row.law, row.reference) == chosen]
            for axis, values in zip(line, np.transpose(rmse), strict=True):
                axis.plot(TILTS, values, style, color=colour, label=law, linewidth=width)
        for joint, axis in enumerate(line, start=1):
            axis.set_title(f"joint {joint}, CoGs {cog}", fontsize=10)
            make_plain(axis)
    figure.supxlabel("Tilt up to (deg)")
    figure.supylabel("RMSE (Nm)")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(STYLES))
    figure.suptitle("Error against gravload over trunk tilt, random poses; the ANFIS was trained upright")
    return figure
