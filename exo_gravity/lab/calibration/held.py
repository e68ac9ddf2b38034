# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a parameter file holds of a fit, and what it leaves of the torque in poses that no tour has visited.

The fit knows more of an arm than its file: offsets where there is no spring, the turn of gravity without an IMU to
mount, and on the paper's arm, whose closed forms have fixed axes, axes that are askew. So the file's moments are those
with which its law comes nearest, in new poses, to the torque t of the whole fit. What they leave of it, b, is known.
With the Jacobian J of the torque, and the covariance C of the unknowns, the error in a new pose is normal about b, of
variance J C J^T and the part of the residuals that their stated noise does not explain. What b leaves is no noise: it
is much the same in many poses. So the band is that which contains 95 % of all errors in all poses, and not a multiple
of their root mean square, which would contain more.

No pose shows that friction differs between the two directions, whose mean counts as gravity's torque. A gear that loses
more while it drives its load than while it is driven makes a share of that torque look like more torque or less. How
friction grows with the torque is measured; `UNEQUAL` of it, as a standard error, is in the band. It was chosen on 28
devices of another make (3, 4 and 7 joints), where 95 % bands contained 74 to 100 % by joint, and without it 62 to
100 %. On 28 others they contained 86 to 100 %, and without it 70 to 99 %. Unequal Coulomb friction shows as an
offset.

A common factor of moments and torque scales is in C, however large, and cancels in J: it holds the arm all the same.
"""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.numbers import COVER
from exo_gravity.lab.calibration.moment_model import TURNS, MomentModel
from exo_gravity.lab.calibration.pose_fit import Rows, Solution, rows_at

POSES = 100  # new ones, at random
LEAN = 0.15  # rad, standard deviation of the trunk's pitch and roll in these
UNEQUAL = 0.25  # of the friction that grows with the torque: by how much it differs between both directions
NORMAL = np.array([NormalDist().inv_cdf((number + 0.5) / 400.0) for number in range(400)])  # in place of random numbers


class InFile(NamedTuple):
    """The file of a fit of n joints and k moments."""

    unknowns: np.ndarray  #: (count,) as the file has them, with its moments
    error: np.ndarray  #: (n,) Nm; COVER times this contains 95 % of the errors of its torque in new poses


def held(model: MomentModel, new: Rows, solution: Solution, misfit: np.ndarray, grows: np.ndarray) -> InFile:
    """Return what the file holds of a fit, and how well.

    new: the poses in which its torque is judged.
    misfit: (n,) Nm as commanded, root mean square of what noise does not explain of the residuals.
    grows: (n,), by how much of the torque friction grows.
    """
    at, unknowns = new.layout, solution.unknowns
    scale, kept = np.exp(unknowns[at.scale]), unknowns.copy()
    kept[at.offset] *= unknowns[at.spring] > 0.0
    kept[at.tilt] *= model.keeps_tilt
    turns = kept[at.turn].reshape(-1, TURNS)
    turns[:, 1:] *= model.is_described
    free = np.flatnonzero(~solution.hidden[at.moment])
    lowest = np.full(at.moment.stop, -np.inf)
    lowest[list(model.at_least_0)] = 0.0
    left = scale * (new.predicted(unknowns) - new.predicted(kept))
    by_moments = (scale[:, None] * new.jacobian(kept))[..., free].reshape(-1, len(free))
    kept[free] += lsq_linear(by_moments, left.ravel(), (lowest[free] - kept[free], np.inf)).x
    left = scale * (new.predicted(unknowns) - new.predicted(kept))
    jacobian = scale[:, None] * new.jacobian(unknowns)
    variance = np.einsum("qnt,tu,qnu->qn", jacobian, solution.covariance, jacobian, optimize=True)
    unequal = UNEQUAL * grows * new.predicted(unknowns)
    errors = left + np.sqrt(variance + scale**2 * (misfit**2 + unequal**2)) * NORMAL[:, None, None]
    return InFile(kept, np.quantile(np.abs(errors), 0.95, axis=(0, 1)) / COVER)


def new_poses(model: MomentModel) -> Rows:
    """Return poses at random without a weight, under tilts of the trunk if an IMU measures them."""
    random = np.random.default_rng(2)
    theta = random.choice(model.suggested, POSES)
    leans = random.normal(0.0, LEAN * model.keeps_tilt, (POSES, 2)).tolist()
    down = np.array([model.down(Tilt.of(SIDES[0], pitch, roll)) for pitch, roll in leans])
    return rows_at(model, theta, down, model.turned(theta))
