# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a parameter file holds of a fit, and what it leaves of the torque in poses that no tour has visited.

The fit knows more of an arm than its file: offsets where there is no spring, the turn of gravity without an IMU to
mount, and on the paper's arm, whose closed forms have fixed axes, axes that are askew. So the file's moments are those
with which its law comes nearest, in new poses, to the torque t of the whole fit. What they leave of it, b, is known.
With the Jacobian J of the torque, and the covariance C of the unknowns, the error in a new pose is normal about b, of
variance J C J^T and the part of the residuals that their stated noise does not explain. What b leaves is no noise: it
is much the same in many poses. So the band is that which contains 95 % of all errors in all poses, and not a multiple
of their root mean square, which would contain more.

A common factor of moments and torque scales is in C, however large, and cancels in J: it holds the arm all the same.
"""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.numbers import COVER
from exo_gravity.lab.calibration.moment_model import TURNS, MomentModel
from exo_gravity.lab.calibration.pose_fit import Rows, unmeasured
from exo_gravity.lab.calibration.poses import PRIOR

POSES = 100  # new ones, at random
LEAN = 0.15  # rad, standard deviation of the trunk's pitch and roll in these
NORMAL = np.array([NormalDist().inv_cdf((number + 0.5) / 400.0) for number in range(400)])  # in place of random numbers


class InFile(NamedTuple):
    """The file of a fit of n joints and k moments."""

    unknowns: np.ndarray  #: (count,) as the file has them, with its moments
    error: np.ndarray  #: (n,) Nm; COVER times this contains 95 % of the errors of its torque in new poses


def held(
    model: MomentModel, rows: Rows, unknowns: np.ndarray, covariance: np.ndarray, known: np.ndarray, misfit: np.ndarray
) -> InFile:
    """Return what the file holds of a fit, and how well.

    rows: that were fitted. unknowns, covariance: (count,) and (count, count), of the fit.
    known: (k,), whether the poses show a moment; the others stay as they are, as unsure as before a tour.
    misfit: (n,) Nm as commanded, root mean square of what noise does not explain of the residuals.
    """
    at, scale = rows.layout, np.exp(unknowns[rows.layout.scale])
    unknowns, covariance = unknowns.copy(), covariance.copy()
    for index in np.flatnonzero(~known):
        unknowns[index] = model.moments[index]
        covariance[index] = covariance[:, index] = 0.0  # what the file has is not from this fit
        covariance[index, index] = (PRIOR.share * abs(model.moments[index]) + PRIOR.moment) ** 2
    new = _new_poses(model, rows.start)
    kept = unknowns.copy()
    kept[at.offset] *= unknowns[at.spring] > 0.0
    kept[at.tilt] *= model.keeps_tilt
    turns = kept[at.turn].reshape(-1, TURNS)
    turns[:, 1:] *= model.is_described
    free = np.flatnonzero(known)
    left = scale * (new.predicted(unknowns) - new.predicted(kept))
    by_moments = scale[:, None] * new.jacobian(kept)[..., at.moment]
    while True:
        moments = kept[at.moment].copy()
        moments[free] += np.linalg.lstsq(by_moments[..., free].reshape(-1, len(free)), left.ravel(), rcond=None)[0]
        below = [index for index in free if index in model.at_least_0 and moments[index] < 0.0]
        if not below:
            break
        left += by_moments[..., below] @ kept[below]  # as if they were 0
        kept[below] = 0.0
        free = np.setdiff1d(free, below)
    left -= by_moments @ (moments - kept[at.moment])
    kept[at.moment] = moments
    jacobian = scale[:, None] * new.jacobian(unknowns)
    variance = np.einsum("qnt,tu,qnu->qn", jacobian, covariance, jacobian, optimize=True)
    errors = left + np.sqrt(variance + (scale * misfit) ** 2) * NORMAL[:, None, None]
    return InFile(kept, np.quantile(np.abs(errors), 0.95, axis=(0, 1)) / COVER)


def _new_poses(model: MomentModel, start: np.ndarray) -> Rows:
    """Return poses at random without a weight, under tilts of the trunk if an IMU measures them."""
    random = np.random.default_rng(2)
    theta = random.choice(model.suggested, POSES)
    leans = random.normal(0.0, LEAN * model.keeps_tilt, (POSES, 2)).tolist()
    down = np.array([model.down(Tilt.of(SIDES[0], pitch, roll)) for pitch, roll in leans])
    rows = unmeasured(model, theta, down, start)
    return rows._replace(turned=model.turned(theta))
