# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The paper's arm as a chain whose moments are unknown, with what `UrdfArm` has for that.

`core.arm.paper` defines its eight moments, and the torque that is linear in them. Each is a first moment of a link
along an axis of the link's frame of Table 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from exo_gravity.core.arm.chain import Body, frames
from exo_gravity.core.arm.interface import Arm, Links
from exo_gravity.core.arm.paper import ArmModel, gravity_torque
from exo_gravity.core.arm.tilt import Tilt
from exo_gravity.core.numbers import JOINT_COUNT, Torque, Vector
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.hardware.urdf_model import Skeleton

MOMENTS = ("M1", "M2", "M3", "M4", "W", "Z", "Y3", "Y4")


class PapersChain(ArmModel):
    """The paper's arm by its moments, with gains of 1."""

    #: link, and axis of its frame, of each moment: x of M1 to M4, z of W and Z, y of Y3 and Y4
    base = tuple(zip((0, 1, 2, 3, 0, 1, 2, 3), np.eye(3)[[0, 0, 0, 0, 2, 2, 1, 1]], strict=True))
    directions = np.eye(3)[[0] * JOINT_COUNT]  #: of the links, in their frames
    #: about which each joint's place turns, in its own frame of `frames`: its axis, and two directions across it
    turns = np.tile(np.eye(3)[[2, 0, 1]], (JOINT_COUNT, 1, 1))
    moved_by = np.tri(JOINT_COUNT, dtype=bool).T  #: whether a joint, the first index, moves the link of another

    @classmethod
    def of(cls, length: Vector, moments: np.ndarray, gravity: float) -> PapersChain:
        """Return the arm with links of `length` (4,) m that has these moments, (8,) kg m."""
        along, across = moments.reshape(2, -1)
        return cast(PapersChain, cls.from_moments(length, along, across, gravity=gravity))

    def regressor(self, theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the torque of each joint per unit of each moment: (m, 4, 8) in Nm per kg m.

        theta: (m, 4) rad. direction: (3,) or (m, 3), gravity's unit vector in the arm's base frame. Raises
        ParameterError as `gravity_torque` does.
        """
        return np.stack([gravity_torque(arm, theta, direction) for arm in _unit_arms(self.gravity)], axis=-1)

    def holding(self, moments: np.ndarray) -> Callable[[Sequence[float], Tilt], Torque]:
        """Return a function that computes the torque (4,) in Nm from theta (4,) rad and tilt, with moments per joint.

        moments: (4, 8) kg m, a row for each joint.
        """
        units = _unit_arms(self.gravity)

        def torque(theta: Sequence[float], tilt: Tilt) -> Torque:
            rows = np.array([unit.torque(theta, tilt) for unit in units])
            return tuple(np.einsum("kn,nk->n", rows, moments).tolist())

        return torque

    def frames(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how frames are turned at `theta` (m, 4) rad, (m, 4, 3, 3) to the base frame.

        First that of each joint, of the link before and the joint's axis; then that of its link.
        """
        links = self._links(theta)
        axis, along = links[:, :, 1], links[:, :, 2]
        before = np.concatenate((np.broadcast_to(np.eye(3)[0], along[:, :1].shape), along[:, :-1]), axis=1)
        own = np.stack((before, np.cross(axis, before), axis), axis=-1)
        return own, np.swapaxes(links[:, :, 2:], 2, 3)

    def places(self, theta: np.ndarray) -> np.ndarray:
        """Return where the joints are at `theta` (m, 4) rad, and the end of link 4: (m, 5, 3) m in the base frame."""
        links = self._links(theta)
        return np.concatenate((links[:, :, 0], links[:, 3:, 0] + self.length[3] * links[:, 3:, 2]), axis=1)

    def _links(self, theta: np.ndarray) -> np.ndarray:
        return np.array([frames(self.length.tolist(), pose) for pose in theta.tolist()])  # (m, 4, 5, 3)

    def worn_links(self, mass: Vector, cog: Vector) -> Links:  # type: ignore[override]
        """Return the inertia with a point on link 4: the last of `mass` (4,) kg, at the last of `cog` (4,) m."""
        *others, last = self.links.bodies
        return self.links._replace(bodies=(*others, last.joined_with(Body.rod(mass[-1], (cog[-1], 0.0, 0.0)))))

    def with_wearer_moments(self, moments: ArrayLike, support: float = 1.0) -> PapersChain:
        """Return this arm plus a share `support` of first moments (4, 3) kg m of the links, in their frames."""
        more = support * np.einsum("na,nak->k", np.asarray(moments), _by_links())
        return self.of(self.length, self.moments + more, self.gravity)

    def skeleton(self) -> Skeleton:
        """Return the largest moments; axes and links of the paper's arm are what `can_bridge` assumes."""
        w, z, y3, y4 = np.abs(self.off_axis).tolist()
        beside = np.array((w + z + y3 + y4, z + y3 + y4, y3 + y4, y4))
        not_stated = np.empty((0, 3))
        return Skeleton(not_stated, not_stated, np.array(self.first_moment), beside)


Chain = PapersChain | UrdfArm


def chain_of(arm: Arm) -> Chain:
    """Return an arm as a chain with a base of moments."""
    return PapersChain.of(arm.length, arm.moments, arm.gravity) if isinstance(arm, ArmModel) else cast(UrdfArm, arm)


@lru_cache(4)
def _unit_arms(gravity: float) -> list[PapersChain]:
    """Return an arm for each moment, which has that moment of 1 kg m and no other."""
    rows = np.eye(len(MOMENTS))
    no_length = (0.0,) * JOINT_COUNT  # the torque depends on the lengths through the moments only
    return [PapersChain.of(no_length, row, gravity) for row in rows]


@lru_cache(1)
def _by_links() -> np.ndarray:
    """Return what 1 kg m of each link along each axis of its frame adds to the moments, (4, 3, 8)."""
    added = np.zeros((JOINT_COUNT, 3, len(MOMENTS)))
    for k, (link, way) in enumerate(PapersChain.base):
        added[link, :, k] = way
    added[1, 1, 4] = added[2, 2, 5] = added[3, 2, 5] = 1.0  # along the axis of W, and twice along that of Z
    return added
