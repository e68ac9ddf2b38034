# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a wearer's arm can add to a robot arm: m moments, what a table says of them, and the parameters that hold them.

On the paper's arm links 3 and 4 carry the wearer: their mass, which pulls at the links before, and five first moments.
On an arm from a URDF each link on which the table places mass (`wearer.links`) adds a mass and a first moment (3,).

Of a robot arm of n joints and k moments, and m moments that a wearer's arm can have, both have

    model, to_moments   of the robot, and what each of the wearer's moments adds to its moments, (k, m)
    known               (r, m) and (r,), as `fit_wearer` takes it
    comfortable         (2, n) rad, lowest and highest angles
    changes, expected   parameters of `calibrator`, and moments (k,) for `tour_parameters`, or None: so that its tour
                        expects this wearer
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.paper import MAX_OFFSET, moments_along
from exo_gravity.core.arm.wearer import Wearer
from exo_gravity.core.compensation.settings import WORN_MOMENTS, wearer_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.numbers import JOINT_COUNT
from exo_gravity.lab.calibration.result import Change
from exo_gravity.lab.calibration.tours import model_of, row, urdf_model_of
from exo_gravity.lab.calibration.wearer_fit import PRIOR, WearerFit
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.moments import MOMENTS


@dataclass(frozen=True)
class WornArmLimits:
    """Which arms a wearer can have, and through which poses they are moved."""

    #: rad: a comfortable part of the ranges of the paper's joints
    comfortable: tuple[tuple[float, ...], tuple[float, ...]] = ((-0.4, -0.17, -0.5, -0.17), (0.6, 1.2, 1.3, 1.7))
    share: float = 0.6  #: of the way from `home` to a limit of any other joint
    reach: tuple[float, float] = (0.2, 1.2)  #: rad, least and most of that way
    largest_error: float = 0.25  #: of M3 and M4, or of the torque of the joint that carries most, as a standard error
    most: float = 15.0  #: kg of a person's arm
    body_mass: float = 70.0  #: kg, where the file has none
    table_ratio: tuple[float, float] = (0.6, 1.6)  #: measured to tabled moments that are plausible


WORN = WornArmLimits()
HAS_WEIGHT = "is the arm relaxed, the robot calibrated?"


class Found(NamedTuple):
    """What a fit says of the wearer's arm."""

    moments: np.ndarray  #: (k,) kg m, what it adds to the moments of the robot
    changes: tuple[Change, ...]  #: of the parameter file
    compared: str  #: with the table, in a sentence
    refusals: tuple[str, ...]  #: why it is no person's arm


class PapersWorn:
    """A wearer on links 3 and 4 of the paper's arm."""

    changes: Mapping[str, Any] = {}
    comfortable = np.array(WORN.comfortable)

    def __init__(self, arm: ConfiguredArm) -> None:
        self._arm, self._robot, self.model = arm, arm.papers, model_of(arm)
        self.to_moments = worn_moments(self._robot.length)
        self._table = tuple(map(np.array, self._wearer(tabled=True)))
        self.known = _known(self._robot.length, *self._table)
        self.expected: np.ndarray | None = self._robot.with_wearer(*self._wearer()).moments

    def found(self, fit: WearerFit, theta: np.ndarray, direction: np.ndarray) -> Found:
        """Return what a fit says. Raises DataError if it is not an arm."""
        own = fit.covariance[: len(fit.moments), : len(fit.moments)]
        moments, error = self.to_moments @ fit.moments, np.sqrt(np.diag(self.to_moments @ own @ self.to_moments.T))
        for index in (2, 3):
            shown = f"{MOMENTS[index]} of the wearer = {moments[index]:.3f} +- {error[index]:.3f} kg m"
            if not moments[index] > error[index] / WORN.largest_error:
                raise DataError(f"{shown}: {HAS_WEIGHT}")
        mass, beside = _bounded(fit.moments, self._robot.length)
        _check_mass(mass)
        moments = self.to_moments @ np.array((mass, *fit.moments[1:3], *beside))
        mass_table, cog_table = self._table
        ratio = moments[2:4] / moments_along(self._robot.length, cog_table, mass_table)[2:]
        body_mass, (low, high) = self._arm.compensator["wearer.body_mass"], WORN.table_ratio
        compared = f"a person of {WORN.body_mass * ratio[0]:.0f} kg has this M3 by the table {Wearer.table}"
        refusals: tuple[str, ...] = ()
        if body_mass:
            compared = f"{ratio[0]:.0%} of M3 and {ratio[1]:.0%} of M4 by the table {Wearer.table} for {body_mass:g} kg"
            if not np.all((ratio >= low) & (ratio <= high)):
                refusals = (f"implausible: {compared}: must be from {low:.0%} to {high:.0%}",)
        node = f"{self._arm.namespace}/compensator"
        changes = [
            Change(node, f"wearer.{name}", np.round(moments[part], 4).tolist(), f"kg m, +-{row(error[part])}")
            for name, part in (("first_moment", slice(JOINT_COUNT)), ("off_axis", slice(JOINT_COUNT, None)))
        ]
        if self._arm.compensator["law"] != "exact":
            changes.append(Change(node, "law", "exact", "the other laws need masses and centres of gravity"))
        return Found(moments, tuple(changes), compared, refusals)

    def allowed(self, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `largest_moment`, (4,) kg m, and the torque of what lies beside the links, (4,) Nm."""
        whole = self._robot.moments + moments
        w, z, y3, y4 = np.abs(whole[JOINT_COUNT:])
        beside = self._robot.gravity * np.array((w + z + y3 + y4, z + y3 + y4, y3 + y4, y4))
        return whole[:JOINT_COUNT], beside

    def _wearer(self, tabled: bool = False) -> tuple[Sequence[float], Sequence[float]]:
        """Return mass (4,) kg and cog (4,) m on each link: the file's if it gives both masses, else the table's."""
        values = self._arm.compensator
        if not tabled and all(values["wearer.mass"][2:]):
            return values["wearer.mass"], values["wearer.cog"]
        body_mass = values["wearer.body_mass"] or WORN.body_mass
        table = {**values, "wearer.mass": (0.0,) * JOINT_COUNT, "wearer.body_mass": body_mass}
        return wearer_of(table, self._robot.length)


def _check_mass(mass: float) -> None:
    if mass > WORN.most:
        raise DataError(f"the wearer's arm = {mass:.1f} kg: must be at most {WORN.most:g}: is the arm relaxed?")


def worn_moments(length: np.ndarray) -> np.ndarray:
    """Return the moments M1..M4, W, Z, Y3, Y4 by those that links 3 and 4 can add: (8, 6).

    These are the mass in kg, with which both pull at the links before, and M3, M4, Z, Y3, Y4 in kg m. length: (4,) m.
    """
    matrix = np.zeros((len(MOMENTS), 6))
    matrix[:2, 0] = length[:2]
    matrix[[2, 3, 5, 6, 7], np.arange(1, 6)] = 1.0
    return matrix


def _known(length: np.ndarray, mass: np.ndarray, cog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what is known before of the six columns of `worn_moments`, as `fit_wearer` takes it, by the table."""
    along, total = moments_along(length, cog, mass)[2:], mass.sum()
    upper, lower = cog[2], cog[3]
    # The mass that the moments have at these places is the whole one.
    by_moments = np.array((1.0, -1.0 / upper, -(1.0 - length[2] / upper) / lower, 0.0, 0.0, 0.0))
    matrix = np.vstack((by_moments / (PRIOR.mass * total), np.eye(6)[1:]))
    beside = PRIOR.beside * np.array((total, mass[2], mass[3]))
    matrix[1:] /= np.concatenate((PRIOR.moments * along, beside))[:, None]
    return matrix, np.concatenate(([0.0], np.full(2, 1.0 / PRIOR.moments), np.zeros(3)))


def _bounded(found: np.ndarray, length: np.ndarray) -> tuple[float, np.ndarray]:
    """Return a mass in kg, and Z, Y3 and Y4 in kg m, that an arm with the moments `found` (6,) can have."""
    mass, m3, m4 = found[:3]
    mass = max(float(mass), m3 / length[2], m4 / length[3])
    most = MAX_OFFSET * mass
    return mass, np.clip(found[3:], -most, most)


class UrdfWorn:
    """A wearer on those links of an arm from a URDF on which the file or the table places mass.

    Of each of these links the wearer's moments are a mass in kg, and a first moment (3,) in kg m in its joint's frame.
    Raises ParameterError if the file says nothing of the wearer: the mass also gives the inertia.
    """

    expected: np.ndarray | None = None

    def __init__(self, arm: ConfiguredArm) -> None:
        values, self._arm, self.model = arm.compensator, arm, urdf_model_of(arm)
        robot = self.model.arm
        mass, cog = (np.array(part) for part in wearer_of(values, robot.length))
        if not np.any(mass):
            expected = "the wearer's, in kg, or wearer.mass and wearer.cog: they also give the inertia"
            raise ParameterError(f"{arm.namespace}/compensator wearer.body_mass", values["wearer.body_mass"], expected)
        self.changes: Mapping[str, Any] = {"tour.wearer_mass": mass.tolist(), "tour.wearer_cog": cog.tolist()}
        self._links = np.flatnonzero(mass)
        self.to_moments = np.column_stack([column for link in self._links for column in self._columns_of(int(link))])
        self._mass_columns = np.arange(0, self.to_moments.shape[1], 4)
        self._expected = robot.with_wearer(mass, cog).moments - self.model.moments
        self.known = self._prior(mass, cog)
        home, low, high = np.array(arm.limits.home), arm.low, arm.high
        down, up = (np.clip(WORN.share * way, *WORN.reach) for way in (home - low, high - home))
        self.comfortable = np.array((np.maximum(low, home - down), np.minimum(high, home + up)))

    def _columns_of(self, link: int) -> list[np.ndarray]:
        """Return what 1 kg in the link's joint, and 1 kg m along x, y and z, add to the robot's moments, (k,) each."""
        robot, own = self.model.arm, self.model.moments
        each = np.eye(len(robot.names))[link]
        masses = robot.with_wearer(each, 0.0 * each).moments - own
        return [masses, *(robot.with_wearer_moments(np.outer(each, way)).moments - own for way in np.eye(3))]

    def _prior(self, mass: np.ndarray, cog: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is known before: the table's masses within a half, and their places within some centimetres."""
        rows, values = list[np.ndarray](), list[float]()
        for number, link in enumerate(self._links):
            own, way = mass[link], self.model.arm.directions[link]
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
        _check_mass(float(fit.moments[self._mass_columns].sum()))
        moments, rows = self.to_moments @ fit.moments, self.model.rows(theta, direction)
        torque, table = rows @ moments, rows @ self._expected
        n = int(np.argmax((table**2).sum(axis=0)))  # the joint that carries most of the wearer
        name, size = self._arm.joint_names[n], float(np.sqrt(np.mean(table[:, n] ** 2)))
        share = float((torque[:, n] * table[:, n]).sum() / (table[:, n] ** 2).sum())
        error = float(fit.torque_error(rows @ self.to_moments, theta)[n])
        if not share * size > error / WORN.largest_error:
            shown = f"the wearer's arm needs {share * size:.2f} +- {error:.2f} Nm at {name}"
            raise DataError(f"{shown}: {HAS_WEIGHT}")
        low, high = WORN.table_ratio
        compared = f"{share:.0%} of the torque at {name} that the file's wearer needs"
        plausible = low <= share <= high
        refusals = () if plausible else (f"implausible: {compared}: must be from {low:.0%} to {high:.0%}",)
        own = fit.covariance[: len(fit.moments), : len(fit.moments)]
        worst = float(np.sqrt(np.diag(self.to_moments @ own @ self.to_moments.T)).max())
        node, noted = f"{self._arm.namespace}/compensator", f"kg m, +-{worst:.2g} at most"
        changes = [
            Change(node, parameter, (column.round(5) + 0.0).tolist(), noted)
            for parameter, column in zip(WORN_MOMENTS, self._in_links(moments).T, strict=True)
        ]
        return Found(moments, tuple(changes), compared, refusals)

    def _in_links(self, moments: np.ndarray) -> np.ndarray:
        """Return moments (k,) as first moments of the links, (n, 3) kg m in their joints' frames."""
        base = self.model.arm.base
        in_links = np.zeros((len(self.model.arm.names), 3))
        for (link, way), moment in zip(base, moments, strict=True):
            in_links[link] += moment * way
        return in_links

    def allowed(self, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `largest_moment`, (n,) kg m, and the torque of what lies beside the links, (n,) Nm."""
        robot = self.model.arm
        skeleton = robot.with_wearer_moments(self._in_links(moments)).skeleton()
        if skeleton is None:
            return np.zeros(len(robot.names)), np.zeros(len(robot.names))
        return skeleton.moments, robot.gravity * skeleton.beside


WornArm = PapersWorn | UrdfWorn


def worn_arm(arm: ConfiguredArm) -> WornArm:
    """Return what a wearer can add to `arm`. Raises ParameterError."""
    return UrdfWorn(arm) if arm.by_urdf else PapersWorn(arm)
