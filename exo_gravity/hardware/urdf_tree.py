# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where the joints of an arm from a URDF are, and what each first moment asks of them, in many poses at once, by NumPy.

Pinocchio computes one pose a call, and a calibration asks for thousands again and again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

# (3, 9): each row the matrix that multiplies crosswise by the unit vector along an axis, from the left.
CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2).reshape(3, 9)


class TreeJoint(NamedTuple):
    """One joint, in its own frame, which is Pinocchio's."""

    parent: int  #: number of the joint before it; -1 for the root link
    turn: np.ndarray  #: (3, 3) from its own frame while it is at 0, to that of the joint before it
    place: np.ndarray  #: (3,) m, of its origin there
    axis: np.ndarray  #: (3,) unit vector in its own frame
    slides: bool  #: along its axis; else it turns about it
    mass: float  #: kg of its link and of all beyond it


class Frames(NamedTuple):
    """The joints' own frames in m poses, in the root link's axes."""

    before: np.ndarray  #: (m, nv, 3, 3) how they would be turned with the joint itself at 0
    after: np.ndarray  #: (m, nv, 3, 3) how they are turned
    origin: np.ndarray  #: (m, nv, 3) m


class LinkMoments(NamedTuple):
    """First moments of links, each in its own direction."""

    links: np.ndarray  #: (k,) numbers of the joints whose links have them
    ways: np.ndarray  #: (k, 3, 1) unit vectors along them, in these joints' own frames
    turned_by: np.ndarray  #: (nv, k) whether a joint turns them


class JointTree:
    """The joints (nv,) of a model of Pinocchio, each of which turns or slides, with their links.

    pin: the module pinocchio. model: of which a later change is not seen.
    """

    def __init__(self, pin: Any, model: Any) -> None:
        self._joints = tuple(_joints(pin, model))
        self._slides = np.array([joint.slides for joint in self._joints])
        turning, sliding = np.where([~self._slides, self._slides], self.axes.T[:, None], 0.0).transpose(1, 2, 0)
        self._turning, self._sliding = turning[:, :, None], sliding[:, :, None]  # axes (nv, 3, 1); 0 of the others
        self._turns = np.array([joint.turn for joint in self._joints])
        self._places = np.array([joint.place[:, None] for joint in self._joints])
        across = _across(turning)
        # Rodrigues' formula, from a joint's own frame to that of the joint before it: still + sine - cosine.
        self._sine, self._cosine = self._turns @ across, self._turns @ across @ across
        self._still = self._turns + self._cosine

    @property
    def masses(self) -> np.ndarray:
        """What each joint (nv,) moves, in kg."""
        return np.array([joint.mass for joint in self._joints])

    @property
    def axes(self) -> np.ndarray:
        """The joints' axes (nv, 3) in their own frames."""
        return np.array([joint.axis for joint in self._joints])

    @cached_property
    def moves(self) -> np.ndarray:
        """Whether a joint moves the link of another, (nv, nv): the first index is that joint's."""
        moves = np.eye(len(self._joints), dtype=bool)
        for n, joint in enumerate(self._joints):
            if joint.parent >= 0:
                moves[:, n] |= moves[:, joint.parent]
        return moves

    def turned(self, positions: np.ndarray) -> np.ndarray:
        """Return how the joints' own frames are turned to the root link's axes, (m, nv, 3, 3), as `Frames.after`.

        positions: (m, nv) rad or m.
        """
        sine, cosine = np.sin(positions)[:, :, None, None], np.cos(positions)[:, :, None, None]
        turned = self._still + sine * self._sine - cosine * self._cosine
        for n, joint in enumerate(self._joints):
            if joint.parent >= 0:
                turned[:, n] = turned[:, joint.parent] @ turned[:, n]
        return np.asarray(turned)

    def frames(self, positions: np.ndarray) -> Frames:
        """Return the joints' frames for their positions (m, nv) in rad or m."""
        after = self.turned(positions)
        root = np.broadcast_to(np.eye(3), (len(positions), 1, 3, 3))
        parents = np.concatenate((root, after), axis=1)[:, [joint.parent + 1 for joint in self._joints]]
        before = parents @ self._turns
        ways = parents @ self._places + before @ self._sliding * positions[:, :, None, None]
        return Frames(before, after, self.moves.T @ ways[..., 0])

    def moments(self, links: Sequence[int], ways: Sequence[np.ndarray]) -> LinkMoments:
        """Return first moments of links, for `rows`: they are the same in all poses.

        links: (k,) numbers of the joints whose links have them. ways: (k, 3) unit vectors in these joints' own frames.
        """
        turned_by = self.moves[:, links] & ~self._slides[:, None]  # the force of one that slides shows no moment
        return LinkMoments(np.array(links), np.reshape(ways, (-1, 3, 1)), turned_by)

    def rows(self, positions: np.ndarray, gravity: np.ndarray, moments: LinkMoments) -> np.ndarray:
        """Return what each joint must give per first moment of a link, (m, nv, k) in Nm per kg m.

        positions: (m, nv) rad or m. gravity: (m, 3) m/s^2 in the root link's axes.
        """
        turned = self.turned(positions)
        levers = (turned @ self._turning)[..., 0] @ _across(gravity)  # axis x gravity
        ways = (turned[:, moments.links] @ moments.ways)[..., 0]
        return np.asarray(levers @ ways.swapaxes(1, 2) * moments.turned_by)


def _across(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (m, 3, 3) that multiply by `vectors` (m, 3) crosswise, from the left."""
    return np.reshape(vectors @ CROSS, (-1, 3, 3))


def _joints(pin: Any, model: Any) -> Iterator[TreeJoint]:
    """Yield the joints of a model of Pinocchio, in its order."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    pin.computeSubtreeMasses(model, data)
    for number in range(1, model.njoints):  # 0 is the root link
        jacobian = np.reshape(pin.getJointJacobian(model, data, number, pin.ReferenceFrame.LOCAL), (6, -1))
        along, about = np.split(jacobian[:, model.joints[number].idx_v], 2)
        slides, place = bool(np.any(along)), model.jointPlacements[number]
        turn, way = place.rotation.copy(), place.translation.copy()
        axis, mass = along if slides else about, float(data.mass[number])
        yield TreeJoint(model.parents[number] - 1, turn, way, axis, slides, mass)
