# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where the joints and links of an arm from a URDF are, and how they are turned, in the root link's axes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from exo_gravity import pip_install
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import MAX_JOINTS
from exo_gravity.hardware.urdf_checks import UrdfJoints

LEAST_LENGTH = 1e-4  # m between two joints; nearer ones have no link between them


class Frames(NamedTuple):
    """The own frames of an arm's joints in m poses, in the root link's axes."""

    before: np.ndarray  #: (m, n, 3, 3) how they would be turned with the joint itself at 0
    after: np.ndarray  #: (m, n, 3, 3) how they are turned
    origin: np.ndarray  #: (m, n, 3) m


class Skeleton(NamedTuple):
    """What `can_bridge` needs to compute the gravity of an arm of n joints itself, in the root link's axes."""

    axes: np.ndarray  #: (n, 3), unit vectors along the joints' axes while all angles are 0
    ways: np.ndarray  #: (n, 3), unit vectors along the links, zeros for one without length
    moments: np.ndarray  #: (n,) kg m, largest first moment along each link, with all mass beyond it
    beside: np.ndarray  #: (n,) kg m, the largest first moment about each joint of the masses beside the links


class UrdfShape:
    """The joints `joint_names` (n,) of the URDF `text`, and their links; `UrdfArm` has what they hold.

    hand: the link that holds a load, '' if there is none.

    Raises ParameterError if the text is not a URDF, Pinocchio is missing, the hand is no link, or a joint is missing or
    does not turn.

    length: (n,) m from each joint to the next one, and from the last one to the hand; 0 if there is no hand.
    """

    def __init__(self, text: str, joint_names: Sequence[str], hand: str) -> None:
        self._pin, names = _pinocchio(), list(joint_names)
        if not 1 <= len(set(names)) == len(names) <= MAX_JOINTS:
            raise ParameterError("joint_names", names, f"1 to {MAX_JOINTS} different joints of the URDF")
        self._moves = UrdfJoints(self._pin, text, names)  # shared by all arms that are made of this one
        self._bare = self._model = self._moves.model  # Pinocchio's, without and with what the arm holds
        if hand and not self._model.existBodyName(hand):
            links = ", ".join(frame.name for frame in self._model.frames if frame.type == self._pin.FrameType.BODY)
            raise ParameterError("urdf.hand", hand, f"a link of the URDF ({links})")
        self._hand = hand
        self._joints = [self._model.getJointId(name) for name in names]
        self._axes = self._axes_of_joints()
        self._along = self._ways()
        self.length = tuple(float(np.linalg.norm(way)) for way in self._along)

    @property
    def names(self) -> tuple[str, ...]:
        """The joints (n,)."""
        return self._moves.names

    @property
    def moves_alone(self) -> bool:
        """Whether the links move with the arm's joints alone, and no joint follows another one."""
        return len(self._joints) == self._bare.njoints - 1

    @cached_property
    def ranges(self) -> np.ndarray:
        """The joints' limits in the URDF, (2, n) rad."""
        return np.transpose([self._moves.limits(name) for name in self.names])

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors (n, 3) along the links in their joints' frames, zeros for one without length."""
        length = np.array(self.length)[:, None]
        return np.divide(self._along, length, out=np.zeros((len(length), 3)), where=length >= LEAST_LENGTH)

    def _axes_of_joints(self) -> np.ndarray:
        """Return the joints' axes (n, 3) in their own frames."""
        pin, model, data = self._pin, self._model, self._model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        jacobians = ((n, pin.getJointJacobian(model, data, n, pin.ReferenceFrame.LOCAL)) for n in self._joints)
        return np.array([np.reshape(own, (6, -1))[3:, model.joints[n].idx_v] for n, own in jacobians])

    @property
    def masses(self) -> np.ndarray:
        """What each joint (n,) moves, in kg: its link, all beyond it, and what the arm holds."""
        data = self._model.createData()
        self._pin.computeSubtreeMasses(self._model, data)
        return np.array([data.mass[joint] for joint in self._joints])

    @cached_property
    def turns(self) -> np.ndarray:
        """Of each joint's frame its axis and two unit vectors across it, (n, 3, 3), one a row."""
        return np.array([np.vstack((axis, self._across(n))) for n, axis in enumerate(self._axes)])

    def frames(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how the joints' frames are turned at `theta` (m, n) rad, (m, n, 3, 3) to the root link's axes.

        First as they would be with the joint itself at 0, then as they are.
        """
        before, after, _ = self._frames(theta)
        return before, after

    @property
    def moved_by(self) -> np.ndarray:
        """Whether a joint moves the link of another, (n, n): the first index is that joint's."""
        before = [list(self._bare.supports[joint]) for joint in self._joints]
        return np.array([[joint in moving for moving in before] for joint in self._joints])

    def _across(self, n: int) -> np.ndarray:
        """Return two unit vectors (2, 3) across the axis of joint n, in its frame."""
        return np.asarray(np.linalg.svd(self._axes[n][None])[2][1:])

    def pose(self, theta: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where the arm is at `theta` (n,) rad, in the root link's axes.

        The origins (n + 1, 3) in m of the joints and the hand, the axes (n, 3) about which the joints turn, and unit
        vectors (n, 3) across them, as far as possible along the links.
        """
        frames = self._frames(np.array([theta]))
        turns, along = frames.after[0], self._along_links
        return self._with_hand(frames)[0], *(np.einsum("nab,nb->na", turns, ways) for ways in (self._axes, along))

    @cached_property
    def _along_links(self) -> np.ndarray:
        """Unit vectors (n, 3) across the joints' axes in their own frames, as far as possible along the links."""
        along = []
        for n, (axis, way) in enumerate(zip(self._axes, self._along, strict=True)):
            across = way - axis * (axis @ way)
            size = float(np.linalg.norm(across))
            along.append(across / size if size > LEAST_LENGTH else self._across(n)[0])
        return np.array(along)

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mass (n,) kg of each joint's link, and where its centre of gravity is from the joint, (n, 3) m.

        While all angles are 0, in the root link's axes.
        """
        links = [self._bare.inertias[joint] for joint in self._joints]
        turns = self.frames(np.zeros((1, len(links))))[1][0]
        centres = [turn @ link.lever for turn, link in zip(turns, links, strict=True)]
        return np.array([link.mass for link in links]), np.array(centres)

    def skeleton(self) -> Skeleton | None:
        """Return axes, links and largest moments of all that the arm holds; None if its joints are no single chain."""
        parents = [self._model.parents[joint] for joint in self._joints]
        if not self.moves_alone or parents[1:] != self._joints[:-1]:
            return None
        turns, carried = self.frames(np.zeros((1, len(parents))))[1][0], self.masses
        ways, moments, beside = self.directions, np.zeros(len(turns)), np.zeros(len(turns))
        for n, (joint, way, length) in enumerate(zip(self._joints, ways, self.length, strict=True)):
            link = self._model.inertias[joint]
            own = link.mass * link.lever
            beyond = length * (carried[n] - link.mass)
            moments[n] = max(0.0, float(own @ way) + beyond) if np.any(way) else 0.0
            beside[n] = np.linalg.norm(own + beyond * ways[n] - moments[n] * ways[n])
        axes = np.einsum("nab,nb->na", turns, self._axes)
        return Skeleton(axes, np.einsum("nab,nb->na", turns, ways), moments, np.cumsum(beside[::-1])[::-1])

    def places(self, theta: np.ndarray) -> np.ndarray:
        """Return where the joints are at `theta` (m, n) rad, and the hand or the last joint again: (m, n + 1, 3) m.

        In the root link's axes.
        """
        return self._with_hand(self._frames(theta))

    def _with_hand(self, frames: Frames) -> np.ndarray:
        _, after, origins = frames
        return np.concatenate((origins, origins[:, -1:] + after[:, -1:] @ self._along[-1]), axis=1)

    def _frames(self, theta: np.ndarray) -> Frames:
        """Return the frames of the arm's joints at `theta` (m, n) rad."""
        model, data, frames = self._model, self._model.createData(), []
        for at in self._moves.configurations(theta):
            self._pin.forwardKinematics(model, data, at)
            frames.append([place.homogeneous for place in data.oMi])
        places, parents = np.array(frames)[..., :3, :], [model.parents[joint] for joint in self._joints]
        turned = places[:, parents, :, :3] @ [model.jointPlacements[joint].rotation for joint in self._joints]
        return Frames(turned, places[:, self._joints, :, :3], places[..., 3][:, self._joints])

    def _ways(self) -> list[np.ndarray]:
        """Return the way (3,) in m from each joint to the next one in its chain, or to the hand, in its own frame."""
        model, ways = self._model, []
        hand = model.frames[model.getBodyId(self._hand)] if self._hand else None
        for joint in self._joints:
            following = [other for other in self._joints if model.parents[other] == joint]
            if len(following) == 1:
                ways.append(model.jointPlacements[following[0]].translation.copy())
            elif hand is not None and hand.parentJoint == joint:
                ways.append(hand.placement.translation.copy())
            else:
                ways.append(np.zeros(3))
        return ways


def _pinocchio() -> Any:
    try:
        import pinocchio
    except ImportError:
        raise ParameterError("law", "urdf", f"used with Pinocchio: {pip_install('pin')}") from None
    return pinocchio
