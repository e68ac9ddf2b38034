"""The paper's comparison: every law against every reference, and the checks of the result.

Each arm is compared over the 1,053 positions with an upright trunk, and over random poses whose pitch and sideways tilt
are uniform within a limit. The paper's laws take the angle between joint 1's axis and gravity as theta_1, as in the
compensator.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.tools.anfis.samples import GRID, from_gravload
from exo_gravity.tools.anfis.training import Trained, train_law
from exo_gravity.tools.inputs.arms import ConfiguredArm, with_cog_at_link_ends
from exo_gravity.tools.inputs.references import PAPER_ANFIS, REFERENCES

TILTS = (0, 5, 10, 20, 30)  # degrees
CHUNK = 2_000  # poses between two updates of the progress bar
ROUNDING = 1e-12  # Nm; the exact law may differ this much from a reference
LINK_ENDS, CONFIGURED = "at the link ends", "as configured"


class Case(NamedTuple):
    """Poses of an arm, each with a trunk tilt."""

    #: Which centres of gravity.
    cog: str
    #: 'workspace' or 'random'.
    positions: str
    #: Of the tilt, degrees.
    limit: int
    arm: ArmModel
    #: (n, 4) rad.
    theta: np.ndarray
    #: (n, 3), and (n,) rad: as in `core.model.tilt.Tilt`.
    direction: np.ndarray
    axis_angle: np.ndarray
    beta: np.ndarray
    phi: np.ndarray

    def torques(self, anfis: AnfisLaw) -> dict[str, np.ndarray]:
        """Return the torques (n, 4) in Nm by each law; the ANFIS also outside its training box."""
        axis_first = np.column_stack((self.axis_angle, self.theta[:, 1:]))  # with the paper's theta_1
        return {
            "exact": gravity_torque(self.arm, self.theta, self.direction),
            "EQ2-EQ5": paper_static_torque(self.arm, axis_first),
            "EQ1m-EQ4m": paper_mobile_torque(self.arm, axis_first, self.beta, self.phi),
            "ANFIS": self.arm.gain * np.pad(anfis.torques(self.theta[:, 1:]), ((0, 0), (1, 0))),
        }


@dataclass(frozen=True)
class Row:
    """The error in Nm of `law` against `reference` on one joint (1..4) over the `count` poses of a case."""

    cog: str
    positions: str
    limit: int
    count: int
    law: str
    reference: str
    joint: int
    rmse: float
    largest: float
    rms_torque: float

    @property
    def share(self) -> float:
        """RMSE / RMS torque; NaN for a joint without gravity torque."""
        return self.rmse / self.rms_torque if self.rms_torque > 1e-12 else math.nan


def cases(cog: str, configured: ConfiguredArm, count: int) -> Iterator[Case]:
    """Yield the 1,053 positions, then `count` random poses for each of `TILTS`."""
    box = zip(configured.low[1:], configured.high[1:], GRID, strict=True)
    theta = np.array(list(product((0.0,), *(np.linspace(low, high, n) for low, high, n in box))))
    yield _case(cog, "workspace", 0, configured, theta, np.zeros((len(theta), 2)))
    for limit in TILTS:
        rng, bound = np.random.default_rng(limit), math.radians(limit)
        theta = rng.uniform(configured.low, configured.high, (count, 4))
        yield _case(cog, "random", limit, configured, theta, rng.uniform(-bound, bound, (count, 2)))


def _case(cog: str, positions: str, limit: int, configured: ConfiguredArm, theta: np.ndarray, tilt: np.ndarray) -> Case:
    tilts = [Tilt.of(configured.side, pitch, roll) for pitch, roll in tilt.tolist()]
    felt = (np.array([getattr(t, name) for t in tilts]) for name in ("direction", "axis_angle", "beta", "phi"))
    return Case(cog, positions, limit, configured.robot, theta, *felt)


def compare(case: Case, torque: dict[str, np.ndarray], reference: str, expected: np.ndarray) -> list[Row]:
    """Return a row per law and joint; torque: of each law (n, 4) Nm; expected: of the reference (n, 4) Nm."""
    rows = []
    for law, given in torque.items():
        error = given - expected
        figures = zip(rms(error), np.abs(error).max(axis=0), rms(expected), strict=True)
        for joint, numbers in enumerate(figures, start=1):
            head = case.cog, case.positions, case.limit, len(case.theta), law, reference, joint
            rows.append(Row(*head, *map(float, numbers)))
    return rows


def rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column."""
    result: np.ndarray = np.sqrt(np.mean(np.square(values), axis=0))
    return result


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
            torque = case.torques(law)
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
    """The comparison as a whole."""

    #: With the paper's assumptions, d_n = l_n.
    link_ends: Part
    #: With the configured centres of gravity.
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
