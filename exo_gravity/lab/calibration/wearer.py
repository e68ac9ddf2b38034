# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate wearer: what a relaxed wearer's arm adds to a calibrated robot, from a slow tour or a recording.

The fit is that of the robot (`identification.solve`), with other things known before: the robot's moments and torque
scales are exact, the moments of the wearer's arm those of the body-mass table, widely. Relaxed joints have springs,
which stay where the poses ask for them. What neither explains, such as a shoulder that rises with the arm, widens the
error of the torque. Two more moments, which grow with elevation, were tried: ten poses do not tell them from springs.

What varies of the wearer's own activity shows when a pose is visited again. What does not vary is not visible: a person
who carries a constant share of their arm looks like one with a lighter arm.
"""

import argparse
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm.wearer import MAX_TISSUE, TISSUE_REACH
from exo_gravity.core.compensation.settings import joint_spring_of, wearer_of
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.numbers import COVER, for_joints, one_float
from exo_gravity.lab.calibration.identification import EXACT, Known, columns, held, layout_of, rows_at, with_springs
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.calibration.tours import Say, at_links, exact_law, model_of, row, torque_error, tour_observations
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.inputs.arms import ConfiguredArm

MOST_CARRIED = 0.5  # share of their arm that a person can hold who means to relax


@dataclass(frozen=True)
class WearerTour:
    """The tour of a worn arm."""

    poses: int = 8  #: the hanging arm and seven others
    again: int = 2  #: of them, visited again at the end
    least_poses: int = 5  #: different ones: fewer do not tell springs from weight
    least_of_one: int = 4  #: of a single joint, which has two moments, and a spring with two numbers
    #: share of their arm's weight that a relaxed person may hold throughout, unseen: it looks like a lighter arm
    carried: float = 0.2
    unrest: float = 0.5  #: Nm by which what holds the arm may differ between two visits of a pose: breathing, 3.5 times
    samples: int = 200  #: poses of the comfortable range in which the error of the torque is taken
    same_pose: float = 0.05  #: rad, within which two poses are visits of one


@dataclass(frozen=True)
class WearerPrior:
    """What is known of a person's relaxed arm before a pose is measured, as standard errors, and what is plausible."""

    mass: float = 0.5  #: share of the table's mass of a segment
    moment: float = 10.0  #: kg m, besides
    place: float = 0.05  #: m, of a segment's centre of gravity in each direction
    stiffness: float = 1.5  #: Nm/rad, of a relaxed shoulder or elbow
    middle: float = 1.0  #: Nm, of its torque in the middle of the poses
    breathing: float = 0.1  #: Nm: standard deviation by which a relaxed, breathing person differs from pose to pose
    body_mass: float = 70.0  #: kg, where the file has none
    judged: float = 0.2  #: of the largest torque by the table, from which a joint's is compared with it
    largest_error: float = 0.25  #: of that torque
    table_ratio: tuple[float, float] = (0.6, 1.6)  #: measured to tabled torque that is plausible
    share: float = 0.6  #: of the way from `home` to a limit of a joint of which no comfortable range is known
    reach: tuple[float, float] = (0.2, 1.2)  #: rad, least and most of that way


WEARER, PRIOR = WearerTour(), WearerPrior()


class WornArm:
    """A wearer on those links of an arm on which the file or the table places mass, before a pose is measured.

    Raises ParameterError if the file of an arm from a URDF says nothing of the wearer: the mass also gives the inertia.

    model: of the robot, of n joints and k moments.
    expected: (k,) kg m, what the wearer adds to these by file or table; whose: of which wearer, in words.
    is_known: whether the file says who it is.
    known: what is known before of the unknowns of a fit, of robot and wearer.
    comfortable: (2, n) rad, lowest and highest angles.
    changes: parameters of `calibrator`, so that its tour expects this wearer.
    """

    def __init__(self, arm: ConfiguredArm) -> None:
        values, self.model = arm.compensator, model_of(arm)
        model, robot = self.model, self.model.arm
        given = (*values["wearer.mass"], values["wearer.body_mass"], *values.get("wearer.first_moment", ()))
        self.is_known = any(given)
        if not self.is_known and model.is_described:
            expected = "the wearer's, in kg, or wearer.mass and wearer.cog: they also give the inertia"
            raise ParameterError(f"{arm.namespace}/compensator wearer.body_mass", values["wearer.body_mass"], expected)
        self.whose = "the file's wearer" if self.is_known else f"a wearer of {PRIOR.body_mass:g} kg"
        assumed = {} if self.is_known else {"wearer.body_mass": PRIOR.body_mass}
        mass, cog = (np.array(part) for part in wearer_of({**values, **assumed}, robot.length))
        self.changes = {"tour.wearer_mass": mass.tolist(), "tour.wearer_cog": cog.tolist()}
        self.expected = model.moments_of(robot.with_wearer(mass, cog)) - model.moments
        self.known = self._known(mass, cog)
        home, low, high = np.array(arm.limits.home), arm.low, arm.high
        down, up = (np.clip(PRIOR.share * way, *PRIOR.reach) for way in (home - low, high - home))
        self.comfortable = np.array(model.comfortable or (np.maximum(low, home - down), np.minimum(high, home + up)))

    def _known(self, mass: np.ndarray, cog: np.ndarray) -> Known:
        """Return what is known, for a wearer of mass (n,) in kg at cog (n,) in m on the links."""
        at, deviations = layout_of(self.model, 0), []
        for link in np.flatnonzero(mass):
            heavier = PRIOR.mass * np.append(1.0, cog[link] * self.model.directions[link])
            of_link = mass[link] * np.vstack((heavier, PRIOR.place * np.eye(4)[1:]))  # mass, and moments along x, y, z
            deviations.append(of_link @ self.model.added(int(link)))
        moments = np.vstack(deviations)
        covariance = moments.T @ moments + EXACT**2 * np.eye(at.moment.stop)
        start, least, error = np.zeros(at.total), np.full(at.total, -np.inf), np.full(at.total, EXACT)
        start[at.moment] = self.model.moments + self.expected
        least[at.spring] = 0.0
        error[at.spring], error[at.offset], error[at.moment] = PRIOR.stiffness, PRIOR.middle, PRIOR.moment
        known = np.zeros((at.moment.stop, at.total))
        known[:, at.moment] = np.linalg.inv(np.linalg.cholesky(covariance))
        return Known(start, error, least, known)


def calibrate_wearer(options: argparse.Namespace, arm: ConfiguredArm, say: Say) -> CalibrationResult:
    """Measure the wearer's relaxed arm, or take it from `options.bag`. Raises ParameterError."""
    carried = WEARER.carried if options.carried is None else one_float("carried", options.carried, 0.0, MOST_CARRIED)
    worn = WornArm(arm)
    # Few poses, in a comfortable range, with the weight that the table expects.
    low, high = np.maximum(arm.low, worn.comfortable[0]), np.minimum(arm.high, worn.comfortable[1])
    changes = {"tour.poses": WEARER.poses, "tour.again": WEARER.again, **worn.changes}
    changes |= {"position_min": low.tolist(), "position_max": high.tolist()}
    request = "Wear the arm, sit upright and relax: it will be moved slowly. Pull to stop it"
    return wearer_from(arm, tour_observations(options, arm, say, changes, request), carried)


def wearer_from(
    arm: ConfiguredArm, observations: Sequence[Observation], carried: float = WEARER.carried
) -> CalibrationResult:
    """Return moments and springs of the wearer's arm: what the robot alone does not explain.

    carried: share 0..MOST_CARRIED of their arm's weight that they may hold throughout. Raises DataError if the poses do
    not show an arm.
    """
    worn, observations = WornArm(arm), at_links(arm, observations)
    model, at, count = worn.model, layout_of(worn.model, 0), len(arm.joint_names)
    theta, direction, effort, spread = columns(observations)
    of_two = itertools.combinations(range(len(theta)), 2)
    visits = [pair for pair in of_two if np.ptp(theta[list(pair)], axis=0).max() < WEARER.same_pose]
    again = len({other for _, other in visits})
    least = min(WEARER.least_poses, WEARER.least_of_one + count - 1)
    if len(observations) - again < least:
        raise DataError(f"{len(observations) - again} different poses were measured, must be at least {least}")
    middle, spread = (theta.min(axis=0) + theta.max(axis=0)) / 2.0, np.hypot(spread, PRIOR.breathing)
    rows = rows_at(model, theta, direction)._replace(theta=theta - middle)
    own = joint_spring_of(arm.compensator)
    solution = with_springs(rows, worn.known, effort - own.torques(theta), spread, EXACT)
    changes_between = [np.ptp(solution.residual[list(pair)], axis=0) for pair in visits]
    change = np.max([np.zeros(count), *changes_between], axis=0)
    restless = [
        f"{name}: {off:.2f} Nm between two visits of a pose: must be at most {WEARER.unrest:g}: did the wearer relax?"
        for name, off in zip(arm.joint_names, change, strict=True)
        if off > WEARER.unrest
    ]
    if restless:
        raise DataError("; ".join(restless))
    low, high = worn.comfortable
    poses = np.random.default_rng(0).uniform(low, high, (WEARER.samples, count))
    new = rows_at(model, poses, np.tile(direction[0], (len(poses), 1)))._replace(theta=poses - middle)
    misfit = np.sqrt(np.maximum(solution.sigma**2 - spread**2, 0.0).mean(axis=0))
    unsure = held(model, new, solution, misfit, np.zeros(count)).error
    moments, stiffness = solution.unknowns[at.moment] - model.moments, solution.unknowns[at.spring]
    rest = middle - np.where(stiffness > 0.0, solution.unknowns[at.offset] / np.maximum(stiffness, EXACT), 0.0)
    compared, refusals = _compared(arm, worn, moments, model.rows(theta, direction), unsure)
    refusals += [
        f"{name}: a spring of {one:.1f} Nm/rad: must be at most {MAX_TISSUE:g}: was the arm touched?"
        for name, one in zip(arm.joint_names, stiffness, strict=True)
        if one > MAX_TISSUE
    ]
    skeleton, nothing = model.holding(model.moments + moments).skeleton(), np.zeros(count)
    largest, beside = (skeleton.moments, model.gravity * skeleton.beside) if skeleton else (nothing, nothing)
    way = np.minimum(np.maximum(np.abs(arm.low - rest), np.abs(arm.high - rest)), TISSUE_REACH)
    added = beside + own.largest(arm.low.tolist(), arm.high.tolist()) + stiffness * way
    lines = (
        f"largest remainder of a pose: {np.abs(solution.residual).max():.2f} Nm", compared,
        f"{again} poses were visited again, and differed by {change.max():.2f} Nm at most",
        f"a wearer who holds up to {carried:.0%} of their arm throughout looks like one with a lighter arm: "
        "the band contains that, and nothing shows it",
        f"can_bridge, for this wearer at support 1: largest_moment [{_rounded_up(largest, 2)}] kg m, "
        f"largest_addition {_rounded_up(added, 1)} Nm or more",
    )  # fmt: skip
    node, errors = f"{arm.namespace}/compensator", solution.error
    noted = f"kg m, +-{row(errors[at.moment])}"
    # Any share up to `carried` is as likely to be held unseen. Two of these errors cover 95 % of them.
    unseen = 0.95 * carried / (1.0 - 0.95 * carried) / COVER
    changes = [
        *(
            Change(node, name, (part.round(5) + 0.0).tolist(), noted)
            for name, part in model.worn_in_file(moments).items()
        ),
        *exact_law(arm),
        Change(node, "wearer.joint_stiffness", stiffness.round(3).tolist(), f"Nm/rad, +-{row(errors[at.spring])}"),
        Change(node, "wearer.joint_rest", rest.round(3).tolist(), "rad"),
        Change(node, "model_error.wearer_torque", unsure.round(3).tolist(), "Nm, of the wearer's passive arm"),
        Change(node, "model_error.wearer", round(unseen, 3), "share that the wearer may have held"),
    ]
    if "model_error.torque" not in arm.compensator:
        assumed = list(for_joints(torque_error(arm), count, max))
        note = "Nm of the robot, assumed: `calibrate gravity` measures it"
        changes.append(Change(node, "model_error.torque", assumed, note))
    return CalibrationResult(tuple(changes), lines, tuple(refusals), arm, observations=tuple(observations))


def _compared(
    arm: ConfiguredArm, worn: WornArm, moments: np.ndarray, rows: np.ndarray, unsure: np.ndarray
) -> tuple[str, list[str]]:
    """Return how the torque of the wearer's arm compares with the table's, and what of it no person's arm has.

    moments: (k,) kg m of the wearer. rows: (m, n, k), of the poses. unsure: (n,) Nm. Raises DataError if it is no arm.
    """
    torque, table = rows @ moments, rows @ worn.expected
    size, (low, high) = np.sqrt(np.mean(table**2, axis=0)), PRIOR.table_ratio
    said, refusals = [], []
    for n in np.flatnonzero(size > PRIOR.judged * size.max()):
        share = float((torque[:, n] * table[:, n]).sum() / (table[:, n] ** 2).sum())
        needs = f"{share * size[n]:.2f} +- {unsure[n]:.2f} Nm at {arm.joint_names[n]}"
        if not share * size[n] > unsure[n] / PRIOR.largest_error:
            raise DataError(f"the wearer's arm needs {needs}: is the arm relaxed, the robot calibrated?")
        said.append(f"{share:.0%} of the torque at {arm.joint_names[n]}")
        if worn.is_known and not low <= share <= high:
            refusals.append(f"implausible: {said[-1]} that {worn.whose} needs: must be from {low:.0%} to {high:.0%}")
    return f"{', '.join(said)} that {worn.whose} needs", refusals


def _rounded_up(values: np.ndarray, digits: int) -> str:
    """Return numbers with so many digits after the point, none less than it is."""
    return ", ".join(f"{math.ceil(10.0**digits * value) / 10.0**digits:g}" for value in values)
