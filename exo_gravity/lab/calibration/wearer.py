# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""calibrate wearer: what a relaxed wearer's arm adds to a calibrated robot, from a slow tour or a recording.

The moments of the wearer's arm (worn_arm.py) and springs in their joints explain what the robot's moments do not
(wearer_fit.py).
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm.wearer import MAX_TISSUE, TISSUE_REACH
from exo_gravity.core.compensation.settings import joint_spring_of
from exo_gravity.core.errors import DataError
from exo_gravity.core.numbers import COVER, for_joints, one_float
from exo_gravity.lab.calibration.live import Say
from exo_gravity.lab.calibration.pose_fit import columns
from exo_gravity.lab.calibration.result import CalibrationResult, Change
from exo_gravity.lab.calibration.tours import at_links, row, torque_error, tour_observations
from exo_gravity.lab.calibration.tracking import Observation
from exo_gravity.lab.calibration.wearer_fit import WearerFit, fit_wearer, unrest, visits
from exo_gravity.lab.calibration.worn_arm import WornArm
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


WEARER = WearerTour()


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
    theta, direction, effort, spread = columns(observations)
    rows = worn.model.rows(theta, direction)
    torque = effort - rows @ worn.model.moments - joint_spring_of(arm.compensator).torques(theta)
    pairs = visits(theta)
    again = len({other for _, other in pairs})
    least = min(WEARER.least_poses, WEARER.least_of_one + len(arm.joint_names) - 1)
    if len(observations) - again < least:
        raise DataError(f"{len(observations) - again} different poses were measured, must be at least {least}")
    fit = fit_wearer(rows @ worn.to_moments, theta, torque, spread, worn.known)
    change = unrest(pairs, fit.remainder)
    restless = [
        f"{name}: {off:.2f} Nm between two visits of a pose: must be at most {WEARER.unrest:g}: did the wearer relax?"
        for name, off in zip(arm.joint_names, change, strict=True)
        if off > WEARER.unrest
    ]
    if restless:
        raise DataError("; ".join(restless))
    found = worn.found(fit, theta, direction)
    low, high = worn.comfortable
    poses = np.random.default_rng(0).uniform(low, high, (WEARER.samples, len(arm.joint_names)))
    unsure = fit.torque_error(worn.model.rows(poses, direction[0]) @ worn.to_moments, poses)
    refusals = found.refusals + tuple(
        f"{name}: a spring of {stiffness:.1f} Nm/rad: must be at most {MAX_TISSUE:g}: was the arm touched?"
        for name, stiffness in zip(arm.joint_names, fit.stiffness.tolist(), strict=True)
        if stiffness > MAX_TISSUE
    )
    lines = (
        f"largest remainder of a pose: {np.abs(fit.remainder).max():.2f} Nm", found.compared,
        f"{again} poses were visited again, and differed by {change.max():.2f} Nm at most",
        f"a wearer who holds up to {carried:.0%} of their arm throughout looks like one with a lighter arm: "
        "the band contains that, and nothing shows it",
        _bridge_line(arm, worn, found.moments, fit),
    )  # fmt: skip
    changes = (*found.changes, *_spring_changes(arm, fit, unsure, carried))
    if "model_error.torque" not in arm.compensator:
        assumed = list(for_joints(torque_error(arm), len(arm.joint_names), max))
        note = "Nm of the robot, assumed: `calibrate gravity` measures it"
        changes = (*changes, Change(f"{arm.namespace}/compensator", "model_error.torque", assumed, note))
    return CalibrationResult(changes, lines, refusals, arm, observations=tuple(observations))


def _spring_changes(arm: ConfiguredArm, fit: WearerFit, unsure: np.ndarray, carried: float) -> tuple[Change, ...]:
    """Return the new springs, and how unsure the wearer is; unsure: standard error (n,) in Nm of their torque."""
    node, stiffness_error = f"{arm.namespace}/compensator", fit.stiffness_error
    # Any share up to `carried` is as likely to be held unseen. Two of these errors cover 95 % of them.
    unseen = 0.95 * carried / (1.0 - 0.95 * carried) / COVER
    return (
        Change(node, "wearer.joint_stiffness", fit.stiffness.round(3).tolist(), f"Nm/rad, +-{row(stiffness_error)}"),
        Change(node, "wearer.joint_rest", fit.rest.round(3).tolist(), "rad"),
        Change(node, "model_error.wearer_torque", unsure.round(3).tolist(), "Nm, of the wearer's passive arm"),
        Change(node, "model_error.wearer", round(unseen, 3), "share that the wearer may have held"),
    )


def _bridge_line(arm: ConfiguredArm, worn: WornArm, moments: np.ndarray, fit: WearerFit) -> str:
    """Return what can_bridge must let the efforts of this wearer have at support 1, if it checks them.

    moments: (k,) kg m of the wearer.
    """
    largest, beside = worn.allowed(moments)
    way = np.maximum(np.abs(arm.low - fit.rest), np.abs(arm.high - fit.rest))
    device = joint_spring_of(arm.compensator).largest(arm.low.tolist(), arm.high.tolist())
    added = beside + device + fit.stiffness * np.minimum(way, TISSUE_REACH)
    values = ", ".join(f"{math.ceil(100.0 * moment) / 100.0:g}" for moment in largest)
    more = ", ".join(f"{math.ceil(10.0 * torque) / 10.0:g}" for torque in added)
    return (
        f"can_bridge, for this wearer at support 1: largest_moment [{values}] kg m, largest_addition {more} Nm or more"
    )
