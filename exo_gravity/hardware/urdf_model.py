# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The joints of an arm from a URDF: how they move, and where they and their links are, in the root link's axes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from functools import cached_property
from typing import Any
from xml.etree import ElementTree

import numpy as np

from exo_gravity import pip_install
from exo_gravity.core.arm.interface import STANDARD_GRAVITY, Frames, Skeleton
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import MAX_JOINTS
from exo_gravity.hardware.urdf_checks import LIMITS, carrier_of, checked, links_of, mimics_of, robot_of

TURNING = "JointModelR"  # how Pinocchio's names of revolute and continuous joints begin
LARGEST = 1e3  # rad or m; a larger limit means that there is none
TINY = 1e-12  # Nm
LEAST_LENGTH = 1e-4  # m between two joints; nearer ones have no link between them


class UrdfJoints:
    """How the joints of a URDF move: the arm's by themselves, mimic joints with them, others as is reported.

    pin: the module pinocchio. text: of the URDF. joint_names: (n,) of the arm. Raises ParameterError if the text is not
    a URDF, or if a joint is not in it, does not turn, or follows another one.

    model: of Pinocchio, with the joints alone that move.
    own: (nv, n), the velocities of the model for the arm's, and transposed the arm's torques for those of the model.
    others: joints that are not the arm's, and that change its torque.
    moved: the links that the arm's joints move.
    peak: (n,) Nm, the largest torque that gravity needs in any pose and tilt.
    """

    def __init__(self, pin: Any, text: str, joint_names: Sequence[str]) -> None:
        self.root = robot_of(text)  #: the `robot` element
        try:
            self.model = pin.buildModelFromXML(text)
        except (RuntimeError, ValueError) as error:
            expected = f"a URDF that Pinocchio reads: the lines above say more ({error})"
            raise ParameterError("urdf", f"{text[:60].strip()} ...", expected) from None
        self._pin, self.names, self.mimics = pin, tuple(joint_names), mimics_of(self.root)
        movable = {name: joint for name, joint in self._model_joints() if joint.nv == 1}
        self.turning = [name for name, joint in movable.items() if joint.shortname().startswith(TURNING)]
        self.links, self._reported = tuple(links_of(self.root, self.model)), set[str]()
        self.others = tuple(sorted(movable.keys() - {*self.names, *self.mimics}))
        checked("joints", self)
        joints = {self.model.getJointId(name) for name in self.names}
        self.moved = [link for link in self.links if joints.intersection(self.model.supports[link.joint])]
        self._couple()
        self.peak, effects = self._tried()
        self._lock([other for other, effect in zip(self.others, effects, strict=True) if effect > LIMITS.share])

    def configuration(self, theta: Sequence[float]) -> np.ndarray:
        """Return Pinocchio's configuration (nq,) for the angles `theta` (n,) in rad.

        Raises ParameterError while a joint that cannot be at 0 is not reported.
        """
        self._check_others(self._reported)
        return self._configuration_at(self.own @ np.asarray(theta) + self._still)

    def configurations(self, theta: np.ndarray) -> Iterator[np.ndarray]:
        """Yield Pinocchio's configuration (nq,) for each row of `theta` (m, n) in rad. Raises likewise."""
        self._check_others(self._reported)
        return map(self._configuration_at, theta @ self.own.T + self._still)

    def follow(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take the positions (m,) of all joints that are reported, by their names (m,).

        Raises ParameterError if one that changes the torque is not finite, or is missing although it was reported
        before or cannot be at 0.
        """
        given = {name: float(at) for name, at in zip(names, positions, strict=False) if name in self.others}
        for name, position in given.items():
            if not math.isfinite(position):
                raise ParameterError(f"position of {name}", position, "finite: the arm's torque depends on it")
        self._check_others(given, self._reported)
        self._reported |= given.keys()
        if given:
            self._hold_others([given.get(name, at) for name, at in zip(self.others, self._at, strict=True)])

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest angle of a joint in rad; a continuous one may be anywhere."""
        model = self.model
        joint = model.joints[model.getJointId(name)]
        if joint.nq != 1:
            return -math.pi, math.pi
        lower, upper = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        return max(float(lower), -LARGEST), min(float(upper), LARGEST)

    @property
    def efforts(self) -> list[float]:
        """The effort limits (n,) in Nm of the arm's joints, 0 for a joint without one."""
        joints = (self.model.joints[self.model.getJointId(name)] for name in self.names)
        efforts = (float(self.model.effortLimit[joint.idx_v]) for joint in joints)
        return [effort if 0.0 < effort < math.inf else 0.0 for effort in efforts]

    @property
    def fixed(self) -> tuple[str, ...]:
        """The other joints that are taken to be at 0, because none is reported."""
        return tuple(name for name in self.others if name not in self._reported)

    def share_of(self, links: Collection[str]) -> float:
        """Return which share of the arm's largest torque comes from the masses of these links."""
        without = robot_of(ElementTree.tostring(self.root, encoding="unicode"))
        for link in without.findall("link"):
            for inertial in link.findall("inertial"):
                if link.get("name") in links:
                    link.remove(inertial)
        peak = UrdfJoints(self._pin, ElementTree.tostring(without, encoding="unicode"), self.names).peak
        return float(np.max(self.peak - peak)) / max(float(np.max(self.peak)), TINY)

    def _model_joints(self) -> Iterator[tuple[str, Any]]:
        """Yield name and joint of Pinocchio's model, without the first, which is the universe."""
        return zip(list(self.model.names)[1:], list(self.model.joints)[1:], strict=True)

    def _check_others(self, known: Collection[str], needed: Collection[str] = ()) -> None:
        """Raise ParameterError if another joint is not `known` although it is `needed` or cannot be at 0."""
        for name, (low, high) in self._ranges.items():
            cannot = "" if low <= 0.0 <= high else f", and it cannot be at 0 (limits {low:g} to {high:g})"
            if name not in known and (cannot or name in needed):
                expected = f"in the joint states: it moves what the arm holds{cannot}"
                raise ParameterError(f"position of {name}", None, expected)

    def _couple(self) -> None:
        """Find how the joints of the model move with the arm's and the others: some follow another one."""
        at = {name: joint.idx_v for name, joint in self._model_joints() if joint.nv == 1}
        follows, offset = np.eye(self.model.nv), np.zeros(self.model.nv)
        for name in at.keys() & self.mimics:
            offset[at[name]] = float(self.mimics[name].get("offset", "0"))
            if (leader := self.mimics[name].get("joint", "")) in at:
                follows[at[name], at[leader]] = -float(self.mimics[name].get("multiplier", "1"))
        moving = np.linalg.inv(follows)
        self._coupling, self._offset = moving[:, [at[name] for name in (*self.names, *self.others)]], moving @ offset
        self.own = self._coupling[:, : len(self.names)]
        self._neutral, self._data = self._pin.neutral(self.model), self.model.createData()
        self._ranges = {name: self.limits(name) for name in self.others}
        self._hold_others([min(max(0.0, low), high) for low, high in self._ranges.values()])

    def _hold_others(self, at: Sequence[float]) -> None:
        """Take the positions `at` of the other joints, and compute once what they add to those of the model, (nv,)."""
        self._at, self._still = at, self._coupling[:, len(self.names) :] @ np.array(at) + self._offset

    def _lock(self, others: Sequence[str]) -> None:
        """Keep the arm's joints, `others`, and what follows them; lock all other joints of the model."""
        kept = [n for n, name in enumerate((*self.names, *self.others)) if name in self.names or name in others]
        moving = self._coupling[:, kept].any(axis=1)
        joints = (joint for _, joint in self._model_joints())
        locked = [joint.id for joint in joints if not moving[joint.idx_v : joint.idx_v + joint.nv].any()]
        if locked:
            try:
                self.model = self._pin.buildReducedModel(self.model, locked, self._configuration_at(self._still))
            except ValueError as error:  # Pinocchio looks frames up by name alone
                twice = ", ".join(sorted({*self.model.names} & {link.name for link in self.links}))
                raise ParameterError("joints of the URDF", twice, f"named otherwise than its links ({error})") from None
        self.others = tuple(others)
        self._couple()

    def _configuration_at(self, positions: np.ndarray) -> np.ndarray:
        """Return the configuration (nq,) for the positions of the model's joints, (nv,)."""
        if self.model.nq == self.model.nv:  # no continuous joint, which has two numbers in a configuration
            return positions
        return np.asarray(self._pin.integrate(self.model, self._neutral, positions))

    def _torque(self, positions: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        self.model.gravity.linear = gravity
        at = self._configuration_at(self._coupling @ positions + self._offset)
        return np.asarray(self.own.T @ self._pin.computeGeneralizedGravity(self.model, self._data, at))

    def _tried(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest torque (n,) in Nm in random poses, and each other joint's effect as a share of it."""
        random, count = np.random.default_rng(0), len(self.names)
        low, high = np.transpose([self.limits(name) for name in (*self.names, *self.others)])
        peak, effects = np.zeros(count), np.zeros(len(self.others))
        for _ in range(LIMITS.poses):
            gravity, positions = random.normal(size=3), random.uniform(low, high)
            gravity *= STANDARD_GRAVITY / np.linalg.norm(gravity)
            torque = self._torque(positions, gravity)
            peak = np.maximum(peak, np.abs(torque))
            for k, position in enumerate(self._at):
                moved = positions.copy()
                moved[count + k] = position
                effects[k] = max(effects[k], float(np.max(np.abs(self._torque(moved, gravity) - torque))))
        return peak, effects / max(float(np.max(peak)), TINY)


class UrdfShape:
    """The joints `joint_names` (n,) of the URDF `text`, and their links; `UrdfArm` has what they hold.

    hand: the link that holds a load, '' if there is none.

    Raises ParameterError if the text is not a URDF, Pinocchio is missing, the hand is no link, or a joint is missing or
    does not turn.

    length: (n,) m from each joint to the next one, and from the last one to the hand; 0 if there is no hand.
    """

    def __init__(self, text: str, joint_names: Sequence[str], hand: str) -> None:
        try:
            import pinocchio
        except ImportError:
            raise ParameterError("law", "urdf", f"used with Pinocchio: {pip_install('pin')}") from None
        self._pin, names = pinocchio, list(joint_names)
        if not 1 <= len(set(names)) == len(names) <= MAX_JOINTS:
            raise ParameterError("joint_names", names, f"1 to {MAX_JOINTS} different joints of the URDF")
        self.moves = UrdfJoints(self._pin, text, names)  # shared by all arms that are made of this one
        self.names = self.moves.names  #: the joints (n,)
        self._bare = self._model = self.moves.model  # Pinocchio's, without and with what the arm holds
        if hand and not self._model.existBodyName(hand):
            links = ", ".join(frame.name for frame in self._model.frames if frame.type == self._pin.FrameType.BODY)
            raise ParameterError("urdf.hand", hand, f"a link of the URDF ({links})")
        self._hand = hand
        self._joints = [self._model.getJointId(name) for name in names]
        self._parents = [self._model.parents[joint] for joint in self._joints]
        self._axes = self._axes_of_joints()
        self._along = self._ways()
        self.length = tuple(np.linalg.norm(self._along, axis=1).tolist())

    @property
    def moves_alone(self) -> bool:
        """Whether the links move with the arm's joints alone, and no joint follows another one."""
        return len(self._joints) == self._bare.njoints - 1

    @cached_property
    def ranges(self) -> np.ndarray:
        """The joints' limits in the URDF, (2, n) rad."""
        return np.transpose([self.moves.limits(name) for name in self.names])

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

    @cached_property
    def turns(self) -> np.ndarray:
        """Of each joint's frame its axis and two unit vectors across it, (n, 3, 3), one a row."""
        return np.array([np.vstack((axis, np.linalg.svd(axis[None])[2][1:])) for axis in self._axes])

    @property
    def moved_by(self) -> np.ndarray:
        """Whether a joint moves the link of another, (n, n): the first index is that joint's."""
        before = [list(self._bare.supports[joint]) for joint in self._joints]
        return np.array([[joint in moving for moving in before] for joint in self._joints])

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mass (n,) kg of each joint's link, and where its centre of gravity is from the joint, (n, 3) m.

        While all angles are 0, in the root link's axes.
        """
        links = [self._bare.inertias[joint] for joint in self._joints]
        turns = self.frames(np.zeros((1, len(links)))).after[0]
        centres = [turn @ link.lever for turn, link in zip(turns, links, strict=True)]
        return np.array([link.mass for link in links]), np.array(centres)

    def skeleton(self) -> Skeleton | None:
        """Return axes, links and largest moments of all that the arm holds; None if its joints are no single chain."""
        if not self.moves_alone or self._parents[1:] != self._joints[:-1]:
            return None
        turns, ways = self.frames(np.zeros((1, len(self._joints)))).after[0], self.directions
        links = [self._model.inertias[joint] for joint in self._joints]
        moved = self._model.createData()  # kg that each joint moves: its link, all beyond it, and what the arm holds
        self._pin.computeSubtreeMasses(self._model, moved)
        more = [moved.mass[joint] - link.mass for joint, link in zip(self._joints, links, strict=True)]
        beyond = np.multiply(self.length, more)
        own = np.array([link.mass * link.lever for link in links]) + beyond[:, None] * ways
        moments = np.maximum(np.einsum("na,na->n", own, ways), 0.0)
        beside = np.linalg.norm(own - moments[:, None] * ways, axis=1)
        axes, along = (np.einsum("nab,nb->na", turns, vectors) for vectors in (self._axes, ways))
        return Skeleton(axes, along, moments, np.cumsum(beside[::-1])[::-1])

    def frames(self, theta: np.ndarray) -> Frames:
        """Return where the arm is at `theta` (m, n) rad, in the root link's axes; a link has its joint's frame."""
        model, data, frames = self._model, self._model.createData(), []
        for at in self.moves.configurations(theta):
            self._pin.forwardKinematics(model, data, at)
            frames.append([place.homogeneous for place in data.oMi])
        places = np.reshape(frames, (-1, model.njoints, 4, 4))[..., :3, :]
        turned = places[:, self._parents, :, :3] @ [model.jointPlacements[joint].rotation for joint in self._joints]
        turns, origins = places[:, self._joints, :, :3], places[..., 3][:, self._joints]
        hand = origins[:, -1:] + turns[:, -1:] @ self._along[-1]
        return Frames(turned, turns, np.concatenate((origins, hand), axis=1))

    def _ways(self) -> np.ndarray:
        """Return the way (n, 3) in m from each joint to the next one in its chain, or to the hand, in its own frame."""
        model, ways = self._model, np.zeros((len(self._joints), 3))
        hands = [carrier_of(model, self._hand)] if self._hand else []
        for way, joint in zip(ways, self._joints, strict=True):
            following = [model.jointPlacements[other] for other in self._joints if model.parents[other] == joint]
            ends = following if len(following) == 1 else [place for carrier, place in hands if carrier == joint]
            way[:] = sum(end.translation for end in ends)
        return ways
