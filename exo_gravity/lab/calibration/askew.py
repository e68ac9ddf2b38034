# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What axes that do not lie as they are drawn leave of a calibrated arm's torque, in poses that no tour has visited.

It is for the paper's arm, whose closed forms have no place for other axes; those of an arm from a URDF are identified.

A turn w of the places of the joints, about directions across their axes, adds D w to the torque of an arm. A fit that
knows no such turns explains part of it with the moments: P, its derivative by the measured efforts, tells how much.
With the Jacobian J of the efforts in a new pose,

    wrong(new pose) = (D - J P D_tour) w        left in the poses of the tour: (1 - H) D_tour w

Before the tour w is normal, of a known standard error; what the tour's residuals leave of that is the posterior.

J has nothing of what the fit finds and the file does not hold: offsets, and without an IMU the tilt of the stand. A
turn of the first axis looks like such a tilt, so it leaves all of its torque where no mounting of an IMU takes it over.
"""

import numpy as np

from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.lab.calibration.moment_model import TURNS, MomentModel
from exo_gravity.lab.calibration.pose_fit import EXACT, Rows, Solution, unmeasured

POSES = 100  # new ones, at random
LEAN = 0.15  # rad, standard deviation of the trunk's pitch and roll in these


def error_of_axes(model: MomentModel, rows: Rows, solution: Solution, axis_error: float) -> np.ndarray:
    """Return the error (n,) in Nm of the torque that axes leave, root mean square over new poses.

    rows, solution: of a fit without turns, with the errors of the efforts that it has found.
    axis_error: rad, standard error of the direction of an axis, about each direction across it.
    """
    at, unknowns = rows.layout, solution.unknowns
    across = np.flatnonzero(np.arange(TURNS * at.joints) % TURNS)
    tour = rows.by_turns(model.turned(rows.theta)[..., across], unknowns) / rows.sigma[..., None]
    left = (tour - np.tensordot(solution.hat, tour, 2)).reshape(-1, len(across))
    precision = np.eye(len(across)) / max(axis_error, EXACT) ** 2 + left.T @ left
    covariance = np.linalg.inv(precision)
    turn = covariance @ left.T @ (solution.residual / rows.sigma).ravel()
    new = _new_poses(model, rows.start)
    jacobian = new.jacobian(unknowns)
    jacobian[..., at.offset] *= unknowns[at.spring] > 0.0  # the file has no offset but that of a spring
    jacobian[..., at.tilt] *= model.keeps_tilt
    change = solution.inverse[:, : tour.size // len(across)] @ tour.reshape(-1, len(across))
    wrong = new.by_turns(model.turned(new.theta)[..., across], unknowns) - jacobian @ change
    square = (wrong @ turn) ** 2 + np.einsum("qnt,tu,qnu->qn", wrong, covariance, wrong)
    return np.asarray(np.exp(unknowns[at.scale]) * np.sqrt(square.mean(axis=0)))


def _new_poses(model: MomentModel, start: np.ndarray) -> Rows:
    """Return poses at random without a weight, under tilts of the trunk if an IMU measures them."""
    random = np.random.default_rng(2)
    theta = random.choice(model.suggested, POSES)
    leans = random.normal(0.0, LEAN * model.keeps_tilt, (POSES, 2)).tolist()
    down = np.array([model.down(Tilt.of(SIDES[0], pitch, roll)) for pitch, roll in leans])
    return unmeasured(model, theta, down, start)
