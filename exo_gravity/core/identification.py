"""Held poses -> the arm's moments, the torque scale of each motor, and what the poses do not tell.

The commanded effort that holds the arm in pose i, with weight i on link 4, is for joint n

    effort = torque(moments + load) / scale + offset          torque: `core.moments.regressor` times the moments

without friction, which averages out over both directions of motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from exo_gravity.core.arm import STANDARD_GRAVITY, Vector


class Observation(NamedTuple):
    """One pose, passed in both directions of motion.

    theta: (4,) rad. direction: (3,), gravity's unit vector in the base frame. effort: (4,) Nm as commanded, mean of
    both directions. friction: (4,) Nm, half of their difference. spread: (4,) Nm, standard error of `effort`.
    load_mass, load_lever: a weight in kg on link 4, and its distance in m from the elbow; 0 for none.
    """

    theta: Vector
    direction: Vector
    effort: Vector
    friction: Vector
    spread: Vector
    load_mass: float = 0.0
    load_lever: float = 0.0


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of `identify`; n is the number of observations.

    moments: (8,) kg m in the order of `MOMENTS`. covariance: (8, 8), infinite for what the data do not tell, in which
    case the moment is that of `known`, or 0. scale: (4,), true torque per commanded torque; if no load was hung, the
    product of the four is 1 and the moments are in commanded torque, not in kilograms (`relative`). scale_error: (4,),
    standard error. offset, friction: (4,) Nm as commanded. residual: (n, 4) Nm, effort minus prediction; held_out: the
    same, predicted without that pose. singular_values: of the information about all unknowns, the largest first; those
    below 1 belong to `unknown`. unknown: sentences, each of which names what the data do not tell and what would.
    rejected: index and reason of each observation that the result does not use.
    """

    moments: np.ndarray
    covariance: np.ndarray
    scale: np.ndarray
    scale_error: np.ndarray
    offset: np.ndarray
    friction: np.ndarray
    residual: np.ndarray
    held_out: np.ndarray
    singular_values: np.ndarray
    unknown: tuple[str, ...]
    rejected: tuple[tuple[int, str], ...]
    relative: bool

    @property
    def error(self) -> np.ndarray:
        """Standard error (8,) of the moments in kg m."""
        return np.sqrt(np.diag(self.covariance))


def identify(
    observations: Sequence[Observation],
    length: Vector,
    gravity: float = STANDARD_GRAVITY,
    known: Identified | None = None,
    solve_scale: bool = True,
) -> Identified:
    """Return what the observations tell about an arm with links of `length` (4,) m.

    known: an earlier result of the same arm. solve_scale: False holds scale and offset at those of `known` (without it
    at 1 and 0). Raises DataError that names the missing pose if the result would be unphysical, and the observation if
    a value is impossible.
    """
    raise NotImplementedError


def next_pose(
    taken: Sequence[Vector],
    candidates: np.ndarray,
    direction: Vector = (0.0, 0.0, 1.0),
    moments: Vector | None = None,
    gravity: float = STANDARD_GRAVITY,
) -> int:
    """Return the index of the candidate (n, 4) in rad that adds the most information to the poses `taken`.

    direction: (3,). moments: (8,) kg m, a guess; without it those of a light arm.
    """
    raise NotImplementedError
