# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a wearer's arm can add to a robot arm: m moments, what a table says of them, and the parameters that hold them.

Each link on which the table places mass (of the paper's arm 3 and 4, else `wearer.links`) adds a mass, which pulls at
the links before, and a first moment (3,) in its frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.compensation.settings import wearer_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.lab.calibration.result import Change
from exo_gravity.lab.calibration.tours import exact_law, model_of, row
from exo_gravity.lab.calibration.wearer_fit import PRIOR, WearerFit
from exo_gravity.lab.inputs.arms import ConfiguredArm


@dataclass(frozen=True)
class WornArmLimits:
    """Which arms a wearer can have, and through which poses they are moved."""

    share: float = 0.6  #: of the way from `home` to a limit of a joint of which no comfortable range is known
    reach: tuple[float, float] = (0.2, 1.2)  #: rad, least and most of that way
    largest_error: float = 0.25  #: of M3 and M4, and of the torque of the joint that carries most, as a standard error
    most: float = 15.0  #: kg of a person's arm
    body_mass: float = 70.0  #: kg, where the file has none
    table_ratio: tuple[float, float] = (0.6, 1.6)  #: measured to tabled moments and torque that are plausible


WORN = WornArmLimits()


class Found(NamedTuple):
    """What a fit says of the wearer's arm."""

    moments: np.ndarray  #: (k,) kg m, what it adds to the moments of the robot
    changes: tuple[Change, ...]  #: of the parameter file
    compared: str  #: with the table, in a sentence
    refusals: tuple[str, ...]  #: why it is no person's arm


class WornArm:
    """A wearer on those links of an arm on which the file or the table places mass.

    Of each of these links the wearer's moments are a mass in kg, and a first moment (3,) in kg m in its frame. Raises
    ParameterError if the file of an arm from a URDF says nothing of the wearer: the mass also gives the inertia.

    model: of the robot, of n joints and k moments.
    to_moments: what each of the wearer's m moments adds to them, (k, m).
    known: (r, m) and (r,), what is known of these before, as `fit_wearer` takes it.
    comfortable: (2, n) rad, lowest and highest angles.
    changes: parameters of `calibrator`, so that its tour expects this wearer.
    """

    def __init__(self, arm: ConfiguredArm) -> None:
        values, self._arm, self.model = arm.compensator, arm, model_of(arm)
        robot = self.model.arm
        given = (*values["wearer.mass"], values["wearer.body_mass"], *values.get("wearer.first_moment", ()))
        self._is_known = any(given)
        if not self._is_known and self.model.is_described:
            expected = "the wearer's, in kg, or wearer.mass and wearer.cog: they also give the inertia"
            raise ParameterError(f"{arm.namespace}/compensator wearer.body_mass", values["wearer.body_mass"], expected)
        assumed = {} if self._is_known else {"wearer.body_mass": WORN.body_mass}
        mass, cog = (np.array(part) for part in wearer_of({**values, **assumed}, robot.length))
        self.changes: Mapping[str, Any] = {"tour.wearer_mass": mass.tolist(), "tour.wearer_cog": cog.tolist()}
        self._links = np.flatnonzero(mass)
        self.to_moments = np.vstack([self.model.added(int(link)) for link in self._links]).T
        self._expected = self.model.moments_of(robot.with_wearer(mass, cog)) - self.model.moments
        self.known = self._prior(mass, cog)
        home, low, high = np.array(arm.limits.home), arm.low, arm.high
        down, up = (np.clip(WORN.share * way, *WORN.reach) for way in (home - low, high - home))
        usual = np.maximum(low, home - down), np.minimum(high, home + up)
        self.comfortable = np.array(self.model.comfortable or usual)

    def _prior(self, mass: np.ndarray, cog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is known before: the table's masses within a half, and their places within some centimetres."""
        rows, values = list[np.ndarray](), list[float]()
        for number, link in enumerate(self._links):
            own, way = mass[link], self.model.directions[link]
            across = np.linalg.svd(way[None])[2][1:]
            block = np.zeros((4, self.to_moments.shape[1]))
            at = slice(4 * number, 4 * number + 4)
            block[0, at] = np.array((1.0, 0.0, 0.0, 0.0)) / (PRIOR.moments * own)
            block[1, at] = np.array((-cog[link], *way)) / (PRIOR.along * own)
            block[2:, at] = np.column_stack((np.zeros(2), across)) / (PRIOR.beside * own)
            rows.append(block)
            values += [1.0 / PRIOR.moments, 0.0, 0.0, 0.0]
        return np.vstack(rows), np.array(values)

    def found(self, fit: WearerFit, theta: np.ndarray, direction: np.ndarray) -> Found:
        """Return what a fit says. Raises DataError if it is not an arm."""
        mass, why = float(fit.moments[::4].sum()), "is the arm relaxed, the robot calibrated?"
        if mass > WORN.most:
            raise DataError(f"the wearer's arm = {mass:.1f} kg: must be at most {WORN.most:g}: is the arm relaxed?")
        own = fit.covariance[: len(fit.moments), : len(fit.moments)]
        moments, errors = self.to_moments @ fit.moments, np.sqrt(np.diag(self.to_moments @ own @ self.to_moments.T))
        for k in self.model.worn_along:
            shown = f"{self.model.names[k]} of the wearer = {moments[k]:.3f} +- {errors[k]:.3f} kg m"
            if not moments[k] > errors[k] / WORN.largest_error:
                raise DataError(f"{shown}: {why}")
        rows = self.model.rows(theta, direction)
        torque, table = rows @ moments, rows @ self._expected
        n = int(np.argmax((table**2).sum(axis=0)))  # the joint that carries most of the wearer
        name, size = self._arm.joint_names[n], float(np.sqrt(np.mean(table[:, n] ** 2)))
        share = float((torque[:, n] * table[:, n]).sum() / (table[:, n] ** 2).sum())
        error = float(fit.torque_error(rows @ self.to_moments, theta)[n])
        if not share * size > error / WORN.largest_error:
            shown = f"the wearer's arm needs {share * size:.2f} +- {error:.2f} Nm at {name}"
            raise DataError(f"{shown}: {why}")
        low, high = WORN.table_ratio
        whose = "the file's wearer" if self._is_known else f"a wearer of {WORN.body_mass:g} kg"
        compared = f"{share:.0%} of the torque at {name} that {whose} needs"
        ratios = {compared: share} | {
            f"{moments[k] / self._expected[k]:.0%} of {self.model.names[k]} of {whose}": moments[k] / self._expected[k]
            for k in self.model.worn_along
        }
        refusals = tuple(
            f"implausible: {what}: must be from {low:.0%} to {high:.0%}"
            for what, ratio in ratios.items()
            if self._is_known and not low <= ratio <= high
        )
        node = f"{self._arm.namespace}/compensator"
        noted = f"kg m, +-{errors.max():.2g} at most" if self.model.is_described else f"kg m, +-{row(errors)}"
        parts = self.model.worn_in_file(moments).items()
        changes = [Change(node, parameter, (part.round(5) + 0.0).tolist(), noted) for parameter, part in parts]
        return Found(moments, (*changes, *exact_law(self._arm)), compared, refusals)

    def allowed(self, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `largest_moment`, (n,) kg m, and the torque of what lies beside the links, (n,) Nm."""
        skeleton = self.model.holding(self.model.moments + moments).skeleton()
        if skeleton is None:
            return np.zeros(self.model.count), np.zeros(self.model.count)
        return skeleton.moments, self.model.gravity * skeleton.beside
