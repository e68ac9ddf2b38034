"""The compared laws, the poses and tilts of the comparison, and the errors.

Each arm is compared over the 1,053 positions with an upright trunk, and over random poses whose pitch and sideways tilt
are uniform within a limit. The paper's laws take the angle between joint 1's axis and gravity as theta_1, as in the
compensator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from exo_gravity.core.model.anfis import AnfisLaw
from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.gravity import gravity_torque, paper_mobile_torque, paper_static_torque
from exo_gravity.core.model.tilt import Tilt
from exo_gravity.tools.anfis.data import GRID
from exo_gravity.tools.inputs.arms import ConfiguredArm

TILTS = (0, 5, 10, 20, 30)  # degrees


@dataclass(frozen=True, eq=False)
class Case:
    """Poses theta (n, 4) rad of an arm, each with a trunk tilt.

    cog: which centres of gravity. positions: 'workspace' or 'random'. limit: of the tilt, degrees. direction (n, 3);
    axis_angle, beta, phi (n,) rad: as in `core.model.tilt.Tilt`.
    """

    cog: str
    positions: str
    limit: int
    arm: ArmModel
    theta: np.ndarray
    direction: np.ndarray
    axis_angle: np.ndarray
    beta: np.ndarray
    phi: np.ndarray

    @property
    def axis_first(self) -> np.ndarray:
        """The poses with the paper's theta_1, the angle of joint 1's axis to gravity."""
        return np.column_stack((self.axis_angle, self.theta[:, 1:]))


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


@dataclass(frozen=True)
class Baseline:
    """A law inside and outside the box where others were trained.

    RMSE and largest error over all joints in Nm. memory: bytes. pose_time, training_time: s. effort in Nm, sag and
    sag_bowed in rad: as in `sim.baselines.Burden`. NaN where there is no such figure.
    """

    law: str
    inside_rmse: float = math.nan
    inside_largest: float = math.nan
    outside_rmse: float = math.nan
    outside_largest: float = math.nan
    memory: float = math.nan
    pose_time: float = math.nan
    training_time: float = math.nan
    effort: float = math.nan
    sag: float = math.nan
    sag_bowed: float = math.nan


Torques = Callable[[Case], np.ndarray]


def laws(anfis: AnfisLaw) -> dict[str, Torques]:
    """Return the laws by name, as functions of a case -> (n, 4) Nm; the ANFIS also outside its training box."""
    return {
        "exact": lambda case: gravity_torque(case.arm, case.theta, case.direction),
        "EQ2-EQ5": lambda case: paper_static_torque(case.arm, case.axis_first),
        "EQ1m-EQ4m": lambda case: paper_mobile_torque(case.arm, case.axis_first, case.beta, case.phi),
        "ANFIS": lambda case: case.arm.gain * np.pad(anfis.torques(case.theta[:, 1:]), ((0, 0), (1, 0))),
    }


def cases(cog: str, configured: ConfiguredArm, count: int) -> Iterator[Case]:
    """Yield the 1,053 positions, then `count` random poses for each of `TILTS`."""
    box = zip(configured.low[1:], configured.high[1:], GRID, strict=True)
    axes = [np.linspace(low, high, n) for low, high, n in box]
    yield _case(cog, "workspace", 0, configured, np.array(list(product((0.0,), *axes))))
    for limit in TILTS:
        rng = np.random.default_rng(limit)
        yield _case(cog, "random", limit, configured, rng.uniform(configured.low, configured.high, (count, 4)), rng)


def _case(
    cog: str,
    positions: str,
    limit: int,
    configured: ConfiguredArm,
    theta: np.ndarray,
    rng: np.random.Generator | None = None,
) -> Case:
    bound = math.radians(limit)
    tilt = rng.uniform(-bound, bound, (len(theta), 2)) if rng else np.zeros((len(theta), 2))
    tilts = [Tilt.of(configured.side, pitch, roll) for pitch, roll in tilt.tolist()]
    felt = (np.array([getattr(t, name) for t in tilts]) for name in ("direction", "axis_angle", "beta", "phi"))
    return Case(cog, positions, limit, configured.robot, theta, *felt)


def compare(case: Case, torque: dict[str, np.ndarray], reference: str, expected: np.ndarray) -> list[Row]:
    """Return a row per law and joint; torque: of each law (n, 4) Nm; expected: of the reference (n, 4) Nm."""
    rms_torque = rms(expected)
    rows = []
    for law, given in torque.items():
        error = given - expected
        figures = zip(rms(error), np.abs(error).max(axis=0), rms_torque, strict=True)
        for joint, numbers in enumerate(figures, start=1):
            head = case.cog, case.positions, case.limit, len(case.theta), law, reference, joint
            rows.append(Row(*head, *(float(number) for number in numbers)))
    return rows


def rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column."""
    result: np.ndarray = np.sqrt(np.mean(np.square(values), axis=0))
    return result
