# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A relaxed wearer's arm in held poses -> what it adds to the robot's moments, and the springs of its joints.

Of an arm of n joints, what holds the wearer's arm beyond the robot is linear in m moments and in two numbers a joint:

    torque = columns(pose) x + stiffness (theta - middle) + torque at the middle        columns: (n, m) of the regressor

Few poses leave combinations of these open, so each has a prior: the moments that of the body-mass table, widely; the
springs none, within what relaxed joints have. A spring stays only if the poses ask for it, by Akaike's criterion; the
covariance is that with all springs, so that it contains the choice.

What neither moments nor springs explain, such as a shoulder that rises with the arm, stays in the remainder and widens
the error of the torque. Two more moments, which grow with elevation, were tried: ten poses do not tell them from
springs.

What varies of the wearer's own activity shows when a pose is visited again. What does not vary is no longer visible: a
person who carries a constant share of their arm looks like one with a lighter arm.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.numbers import Vector


@dataclass(frozen=True)
class WearerPrior:
    """What is known of a person's relaxed arm before a pose is measured, as standard errors."""

    moments: float = 0.5  #: share of the table's moments along the links
    beside: float = 0.05  #: m, of a segment's centre of gravity beside its link
    along: float = 0.03  #: m, of the same along its link, where the mass is another unknown
    mass: float = 0.15  #: share of the whole mass, against that which the moments have at the table's places
    stiffness: float = 1.5  #: Nm/rad, of a relaxed shoulder or elbow
    middle: float = 1.0  #: Nm, of its torque in the middle of the poses
    offset: float = 1.0  #: rad, farthest of a rest angle from the middle of the poses: beyond, it is no spring
    least_gain: float = 4.0  #: of the sum of squares that a spring must explain: 2 for each of its two numbers
    breathing: float = 0.1  #: Nm: standard deviation by which a relaxed, breathing person differs from pose to pose
    same_pose: float = 0.05  #: rad, within which two poses are visits of one


PRIOR = WearerPrior()


@dataclass(frozen=True, eq=False)
class WearerFit:
    """What `fit_wearer` found of an arm of n joints with m moments."""

    moments: np.ndarray  #: (m,)
    stiffness: np.ndarray  #: (n,) Nm/rad, 0 where the poses ask for no spring
    rest: np.ndarray  #: (n,) rad, where the joints rest
    covariance: np.ndarray  #: (m + 2 n, m + 2 n) of moments, stiffness, and torque in the middle of the poses
    middle: np.ndarray  #: (n,) rad
    remainder: np.ndarray  #: (p, n) Nm, measured minus predicted
    misfit: np.ndarray  #: (n,) Nm, RMS of the remainder beyond what chance leaves: what no moment or spring explains

    @property
    def stiffness_error(self) -> np.ndarray:
        """Standard errors (n,) of the stiffness in Nm/rad."""
        first = len(self.moments)
        return np.asarray(np.sqrt(np.diag(self.covariance)[first : first + len(self.stiffness)]))

    def torque_error(self, columns: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the standard error (n,) in Nm of the wearer's torque, RMS over poses, with the misfit.

        columns: (q, n, m), and theta: (q, n) rad, of these poses.
        """
        matrix = _with_springs(columns, theta, self.middle)
        variance = np.einsum("qnk,kl,qnl->qn", matrix, self.covariance, matrix)
        return np.asarray(np.sqrt(variance.mean(axis=0) + self.misfit**2))


def fit_wearer(
    columns: np.ndarray, theta: np.ndarray, torque: np.ndarray, spread: np.ndarray, known: tuple[np.ndarray, np.ndarray]
) -> WearerFit:
    """Return what explains the torque of p poses beyond the robot's.

    columns: (p, n, m) Nm per unit of a moment. theta: (p, n) rad. torque, spread: (p, n) Nm, measured, and its standard
    error. known: matrix (r, m) and values (r,) of what the moments have before, divided by their standard errors.
    """
    count, moments = theta.shape[1], columns.shape[2]
    middle = (theta.min(axis=0) + theta.max(axis=0)) / 2.0
    sigma = np.hypot(spread, PRIOR.breathing)
    rows = (_with_springs(columns, theta, middle) / sigma[..., None]).reshape(torque.size, -1)
    springs = np.repeat((1.0 / PRIOR.stiffness, 1.0 / PRIOR.middle), count)
    matrix = np.zeros((torque.size + len(known[1]) + 2 * count, moments + 2 * count))
    matrix[: torque.size] = rows
    matrix[torque.size : -2 * count, :moments] = known[0]
    matrix[-2 * count :, moments:] = np.diag(springs)
    wanted = np.concatenate(((torque / sigma).ravel(), known[1], np.zeros(2 * count)))

    def solved(free: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the solution in which only `free` springs (n,) act, and the sum of squares that it leaves."""
        use = np.concatenate((np.ones(moments, bool), free, free))
        solution = np.zeros(len(use))
        solution[use] = np.linalg.lstsq(matrix[:, use], wanted, rcond=None)[0]
        left = wanted - matrix @ solution
        return solution, float(left @ left)

    every = np.ones(count, bool)
    whole, least = solved(every)
    asked = np.array([solved(every & (np.arange(count) != n))[1] - least > PRIOR.least_gain for n in range(count)])
    best, _ = solved(asked & (whole[moments : moments + count] > 0.0))
    for _ in range(count):  # without what is no spring
        stiffness, at_middle = best[moments : moments + count], best[moments + count :]
        way = np.divide(at_middle, stiffness, out=np.zeros(count), where=stiffness > 0.0)
        best, _ = solved((stiffness > 0.0) & (np.abs(way) <= PRIOR.offset))
    stiffness, at_middle = np.maximum(best[moments : moments + count], 0.0), best[moments + count :]
    rest = middle - np.divide(at_middle, stiffness, out=np.zeros(count), where=stiffness > 0.0)
    remainder = torque - (_with_springs(columns, theta, middle) @ best)
    freedom = max(1.0, torque.size - moments - 2.0 * np.count_nonzero(asked))
    factor = max(1.0, float(np.sum((remainder / sigma) ** 2)) / freedom)
    covariance = factor * np.linalg.inv(matrix.T @ matrix)
    by_chance = freedom / torque.size * np.mean(sigma**2, axis=0)
    misfit = np.sqrt(np.maximum(0.0, np.mean(remainder**2, axis=0) - by_chance))
    return WearerFit(best[:moments], stiffness, rest, covariance, middle, remainder, misfit)


def visits(theta: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of poses, of theta (p, n) rad, that are visits of one."""
    pairs = itertools.combinations(range(len(theta)), 2)
    return [(one, other) for one, other in pairs if np.abs(theta[one] - theta[other]).max() < PRIOR.same_pose]


def unrest(pairs: Sequence[tuple[int, int]], remainder: np.ndarray) -> np.ndarray:
    """Return the largest change (n,) in Nm of what held the arm between two visits of a pose.

    remainder: (p, n) Nm, what a fit leaves of the torque: two visits may be some degrees apart.
    """
    changes = [np.abs(remainder[one] - remainder[other]) for one, other in pairs]
    return np.max([np.zeros(remainder.shape[1]), *changes], axis=0)


def _with_springs(columns: np.ndarray, theta: np.ndarray, middle: Vector) -> np.ndarray:
    """Return `columns` (p, n, m) with two more for each joint, (p, n, m + 2 n)."""
    each = np.eye(theta.shape[1])
    springs = (theta - middle)[:, :, None] * each
    return np.concatenate((columns, springs, np.broadcast_to(each, springs.shape)), axis=2)
