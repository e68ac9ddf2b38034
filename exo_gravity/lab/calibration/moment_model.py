# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibration needs of an arm: its torque, linear in k moments, and which of them it takes for known.

The torque follows from where the arm's joints are and how they turn (`Arm.frames`). The paper's arm has the eight
moments of `core.arm.paper`; any other those which a QR decomposition of its regressor leaves. Both are first moments of
links, in kg m.
"""

import itertools
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np

from exo_gravity.core.arm.interface import MAX_MASS, Arm
from exo_gravity.core.arm.paper import MAX_LENGTH, ArmModel
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.compensation.settings import WORN_MOMENTS, robot_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.numbers import JOINT_COUNT, one_float
from exo_gravity.hardware.urdf_arm import MOMENT_NAMES, TURN_NAMES, UrdfArm, arm_in_file

# deg of each joint, within the paper's ranges: from these a missing pose is suggested.
GRID = ((-60, 0, 60), (15, 45, 75, 105, 135), (-30, 0, 30, 60, 90, 120), (0, 30, 60, 90, 120, 150))
SUGGESTED = 600  # poses at random, from which one is suggested for another arm
STEP = 10.0  # deg, of their angles
FITTED = 60  # poses in which the moments of an arm are found from its torque
DEPENDENT = 1e-6  # of the largest column: what is left of one that depends on others
LITTLE = 0.1  # Nm per kg m: a joint that carries less carries nothing
TURN = np.cross(np.eye(3), np.eye(3)[:, None])  # (3, 3, 3): v @ TURN has the rows v x X, v x Y and v x Z
MOMENT_PARAMETERS = {"robot.first_moment": slice(JOINT_COUNT), "robot.off_axis": slice(JOINT_COUNT, None)}

Base = Sequence[tuple[int, np.ndarray]]  # of each moment the link's number, and a unit vector (3,) in its frame


class MomentModel:
    """The paper's arm, whose moments are unknown; `DescribedModel` is another one.

    What is known of either kind before a tour stands in the class; the numbers are those of moments.

    arm: of which the moments are known so far; its gains do not count.
    uses_imu: whether an IMU measures gravity's direction, whose mounting is corrected by what a fit finds.
    rotors: (n,) kg m^2, inertia of the motors' rotors at the joints, where the arm does not know them.

    count, names, moments: n joints; of the k moments their names, and kg m as far as known.
    suggested: (m, n) rad, poses from which a missing one is taken.
    """

    #: Whether a description says about what the arm weighs and its motors give. The file holds what differs from it:
    #: first moments of the links, and axes that are askew. Else it holds the moments, and a fit begins without such.
    is_described = False
    fitted_turns = 1  #: of each joint's place: about its axis; a description also holds those across it
    at_least_0: tuple[int, ...] = (0,)  #: moments that are 0 where they seem to be less
    across: tuple[tuple[int, int], ...] = ((7, 3), (6, 2))  #: of one across a link, and of the larger one along it
    rises_from = 2  #: the first link that may not point far upwards
    #: (2, n) rad, lowest and highest angles that are comfortable for a wearer; () if only the limits are known
    comfortable: tuple[tuple[float, ...], ...] = ((-0.4, -0.17, -0.5, -0.17), (0.6, 1.2, 1.3, 1.7))
    names: tuple[str, ...] = ("M1", "M2", "M3", "M4", "W", "Z", "Y3", "Y4")
    #: link, and direction in its frame, of each moment: x of M1 to M4, z of W and Z, y of Y3 and Y4
    base: Base = tuple(zip((0, 1, 2, 3, 0, 1, 2, 3), np.eye(3)[[0, 0, 0, 0, 2, 2, 1, 1]], strict=True))
    directions = np.eye(3)[[0] * JOINT_COUNT]  #: of the links, in their frames
    #: about which each joint's place turns, in its own frame: its axis, and two directions across it
    turns = np.tile(np.eye(3)[[2, 0, 1]], (JOINT_COUNT, 1, 1))
    moved_by = np.tri(JOINT_COUNT, dtype=bool).T  #: whether a joint, the first index, moves the link of another

    def __init__(self, arm: Arm, uses_imu: bool, rotors: Sequence[float] = ()) -> None:
        self.arm, self.gravity, self.count = arm, arm.gravity, len(self.directions)
        self.keeps_tilt = uses_imu
        self._rotors = np.diag(rotors) if len(rotors) else np.zeros((self.count, self.count))
        self.moments = self.moments_of(arm)
        self.suggested = self._suggested()

    def _suggested(self) -> np.ndarray:
        return np.radians(list(itertools.product(*GRID)))

    def moments_of(self, arm: Any) -> np.ndarray:
        """Return the moments (k,) in kg m of an arm with these joints, and of all that it holds."""
        return np.asarray(arm.moments)

    def down(self, tilt: Tilt) -> np.ndarray:
        """Return gravity's unit vector (3,) in the axes of `Arm.frames`."""
        return np.array(tilt.direction)

    def along_axes(self, theta: np.ndarray) -> np.ndarray:
        """Return the torque (m, n, k, 3) in Nm per kg m with gravity along each axis of the base, at `theta` (m, n)."""
        turns, moments, moved = self._turned(theta)
        pulls = -moments[:, None] @ TURN  # (m, 3, k, 3), each axis of the base x moment
        return np.moveaxis(turns[:, None, :, 0] @ np.swapaxes(pulls, 2, 3) * self.gravity * moved, 1, -1)

    def rows(self, theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the torque (m, n, k) in Nm per kg m at `theta` (m, n) rad. direction: (3,) or (m, 3)."""
        return np.einsum("mnka,ma->mnk", self.along_axes(theta), np.broadcast_to(direction, (len(theta), 3)))

    def _turned(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return turns (m, n, 3, 3) and directions of the moments (m, k, 3) in the base's axes; and what moves what.

        The last: whether a joint moves the link of a moment, (n, k).
        """
        frames, links = self.arm.frames(theta), [link for link, _ in self.base]
        turns = self.turns @ np.swapaxes(frames.before, 2, 3)
        ways = np.array([way for _, way in self.base])[..., None]
        return turns, (frames.after[:, links] @ ways)[..., 0], self.moved_by[:, links]

    @cached_property
    def upright(self) -> np.ndarray:
        """Whether each moment (k,) loads each joint (n,) in any pose while the base is upright, (n, k)."""
        rows = self.rows(self.suggested, self.down(Tilt.of(SIDES[0])))
        return np.asarray((np.abs(rows) > LITTLE).any(axis=0))

    @property
    def compared(self) -> np.ndarray:
        """The joints whose torque scales have a product of 1 without a weight: those that carry something upright."""
        return np.flatnonzero(self.upright.any(axis=1))

    def load(self, mass: float, lever: float) -> np.ndarray:
        """Return the moments (k,) of `mass` kg on the last link, `lever` m from its joint. Raises ParameterError."""
        mass = one_float("load_mass", mass, 0.0, MAX_MASS, "kg")
        lever = one_float("load_lever", lever, 0.0, MAX_LENGTH, "m")
        if not mass:
            return np.zeros(len(self.names))
        last = np.eye(self.count)[-1]
        return np.asarray(self.moments_of(self.arm.with_wearer(mass * last, lever * last)) - self.moments)

    def turned(self, theta: np.ndarray) -> np.ndarray:
        """Return the derivative (m, n, k, 3, t) of `along_axes` by `fitted_turns` of each joint's place.

        A moment v loads the joint with axis a by -(a x v) . gravity. A turn w of joint j turns all that j moves, except
        the moment along its axis, which counts as one of the link before: a fit takes what is missing for moments of
        that link.
        """
        turns, moments, moved = self._turned(theta)
        axes, turns = turns[:, :, 0], turns[:, :, : self.fitted_turns]
        cross = np.cross(axes[:, :, None], moments[:, None]) * moved[..., None]  # (m, n, k, 3)
        # By joint j and its turn t: (m, n, k, j, t, 3)
        both = np.cross(turns[:, None, None], cross[:, :, :, None, None])
        swept = np.cross(turns[:, None], moments[:, :, None, None])  # (m, k, j, t, 3)
        alone = np.cross(axes[:, :, None, None, None], swept[:, None]) * moved[..., None, None, None]
        with_axis, with_link = self.moved_by.T[:, None, :, None, None], moved.T[:, :, None, None]
        change = -self.gravity * np.where(with_axis, both, alone) * with_link
        return np.moveaxis(change, -1, 3).reshape(*cross.shape, -1)

    def in_file(self, moments: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
        """Return the compensator's parameters, (n,) each, that hold `moments` (k,) kg m as a fit found them.

        turn: (n, 3) rad, of the joints' axes.
        """
        return {name: moments[part] for name, part in MOMENT_PARAMETERS.items()}

    def holding(self, moments: np.ndarray) -> Arm:
        """Return a copy of the arm with these moments, (k,) kg m. Only its torque and skeleton are valid."""
        arm = copy(self.arm)
        for name, part in zip(("first_moment", "off_axis"), moments.reshape(2, -1).tolist(), strict=True):
            object.__setattr__(arm, name, tuple(part))  # not within the bounds of a file, which a guess may leave
        return arm

    def worn_in_file(self, moments: np.ndarray) -> dict[str, np.ndarray]:
        """Return the compensator's parameters, (n,) each, that hold what a wearer adds to the moments, (k,) kg m."""
        return {"wearer.first_moment": moments[:JOINT_COUNT], "wearer.off_axis": moments[JOINT_COUNT:]}

    def matrix(self, theta: Sequence[float], load: tuple[float, float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 of the arm as far as known, with the load as a point."""
        (mass, lever), frames = load, self.arm.frames(np.array([theta]))
        axes = np.einsum("nab,nb->na", frames.before[0], self.turns[:, 0])
        place = frames.places[0, -2] + lever * frames.after[0, -1] @ self.directions[-1]
        ways = np.cross(axes, place - frames.places[0, :-1]) * self.moved_by[:, -1:]  # (n, 3) m, the point's per rad
        return np.asarray(self.arm.links.matrix(theta) + self._rotors + mass * ways @ ways.T)

    def upwards(self, theta: np.ndarray) -> np.ndarray:
        """Return the sine (m,) of the largest angle of a link above the horizontal of an upright trunk."""
        ways = np.diff(self.arm.frames(theta).places, axis=1)[:, self.rises_from :]
        length, rise = np.linalg.norm(ways, axis=2), -ways @ self.down(Tilt.of(SIDES[0]))
        return np.asarray(np.divide(rise, length, out=np.full_like(length, -1.0), where=length > 0.0).max(axis=1))


class DescribedModel(MomentModel):
    """An arm that a URDF describes, of n joints.

    Raises ParameterError if a joint that is not the arm's moves its links, or one of them follows another.
    """

    is_described, fitted_turns = True, 3
    rises_from = 0
    at_least_0 = across = comfortable = ()  # a description says enough of its moments
    arm: UrdfArm

    def __init__(self, arm: UrdfArm, uses_imu: bool, rotors: Sequence[float] = ()) -> None:
        if not arm.moves_alone:
            raise ParameterError(
                "joint_names", list(arm.names), "all joints that move the arm's links, for a calibration"
            )
        self.directions, self.turns, self.moved_by = arm.directions, arm.turns, arm.moved_by
        self.base = self._base_of(arm)
        numbers = [n for n, _ in self.base]
        self.names = tuple(f"{arm.names[n]} {numbers[:k].count(n) + 1}" for k, n in enumerate(numbers))
        super().__init__(arm, uses_imu, rotors)

    def _suggested(self) -> np.ndarray:
        low, high = self.arm.ranges
        poses = np.random.default_rng(1).uniform(low, high, (SUGGESTED, self.count))
        return np.radians(STEP * np.round(np.degrees(poses) / STEP))

    def down(self, tilt: Tilt) -> np.ndarray:
        """Return gravity's unit vector (3,) in the root link's axes, which are the trunk's."""
        return np.array(tilt.gravity_in_trunk)

    def _base_of(self, arm: UrdfArm) -> Base:
        """Return the k moments that gravity's torque can show.

        Of a link's first moment the part along its joint's axis turns with the link before, as masses do: both count as
        the first moments of that link. The rest are columns of the regressor, from which a QR decomposition in random
        poses leaves out those that depend on others (M. Gautier, ICRA 1990). The axes are those of the URDF, not turned
        ones: axes that are nearly parallel show next to nothing more.
        """
        every, (masses, _) = copy(self), arm.bodies()
        every.arm, every.gravity = arm.turned(0.0 * arm.turn), 1.0
        every.base = [(n, way) for n in np.flatnonzero(masses).tolist() for way in self.turns[n, 1:]]
        rows = every.rows(*_sampled(len(masses))).reshape(-1, len(every.base))
        size = np.abs(np.diag(np.linalg.qr(rows, mode="r")))
        return [one for one, own in zip(every.base, size, strict=True) if own > DEPENDENT * size.max()]

    def moments_of(self, arm: UrdfArm) -> np.ndarray:
        """Return the moments (k,) in kg m of an arm with these joints, and of all that it holds."""
        poses, down = _sampled(self.count)
        rows = self.rows(poses, down).reshape(-1, len(self.base))
        return np.asarray(np.linalg.lstsq(rows, _needed(arm, poses, down).ravel(), rcond=None)[0])

    def found(self, arm: UrdfArm, moments: np.ndarray, turn: np.ndarray) -> UrdfArm:
        """Return `arm` with these `moments` (k,) kg m and `turn` (n, 3) rad of the joints' axes, as a fit found them.

        The turns about the axes are errors of the zeros, and not part of it. The fit has turned no moment along an
        axis: what that changes in an arm whose places are turned, the moments make up for.
        """
        across = np.einsum("nt,ntb->nb", turn[:, 1:], self.turns[:, 1:])
        poses, down = self.suggested[:FITTED], np.eye(3)[np.arange(FITTED) % 3]
        askew = (turn * (0.0, 1.0, 1.0)).ravel()
        wanted = self.rows(poses, down) @ moments
        wanted += np.einsum("mnkat,ma,k,t->mn", self.turned(poses), down, moments, askew, optimize=True)
        new = copy(self)
        new.arm = arm.turned(arm.turn + across)
        rows = new.rows(poses, down).reshape(-1, len(moments))
        more = np.linalg.lstsq(rows, (wanted - _needed(new.arm, poses, down)).ravel(), rcond=None)[0]
        return new.arm.corrected(arm.change + self.in_links(more))

    def in_links(self, moments: np.ndarray) -> np.ndarray:
        """Return moments (k,) as first moments of the links, (n, 3) kg m along x, y, z of their frames."""
        in_links = np.zeros((self.count, 3))
        for (link, way), moment in zip(self.base, moments, strict=True):
            in_links[link] += moment * way
        return in_links

    def in_file(self, moments: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
        """Return the same: by what the first moments and places of the joints differ from the URDF's."""
        new = self.found(self.arm, moments, turn)
        return dict(zip((*MOMENT_NAMES, *TURN_NAMES), (*new.change.T, *new.turn.T), strict=True))

    def holding(self, moments: np.ndarray) -> Arm:
        """Return a copy of the arm with these moments, (k,) kg m."""
        return self.arm.corrected(self.arm.change + self.in_links(moments - self.moments))

    def worn_in_file(self, moments: np.ndarray) -> dict[str, np.ndarray]:
        """Return the same along x, y and z of the links."""
        return dict(zip(WORN_MOMENTS, self.in_links(moments).T, strict=True))


def _sampled(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (m, n) in rad at random of an arm of `count` joints, each with a vector of gravity (m, 3)."""
    random = np.random.default_rng(1)
    return random.uniform(-np.pi, np.pi, (FITTED, count)), random.normal(size=(FITTED, 3))


def _needed(arm: UrdfArm, poses: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return the torque (m, n) in Nm at `poses` (m, n) rad; down: (m, 3), gravity in the root link's axes."""
    x, y, z = down.T
    return arm.torques(poses, np.stack((y, x, -z), axis=1))


def model_of(values: Mapping[str, Any], worn: tuple[Sequence[float], Sequence[float]] | None = None) -> MomentModel:
    """Return the moments of the arm that the parameters of compensator or calibrator describe.

    values: with the motors of an arm from a URDF, by whose rotors its inertia is larger.
    worn: mass (n,) in kg and centre of gravity (n,) in m of a wearer's segments on its links.

    Raises ParameterError, also if the URDF comes from a topic.
    """
    if own := arm_in_file(values, ": a calibration does not wait for a topic"):
        described = own.scaled([1.0] * len(own.names), values["gravity"])
        rotors = [MOTORS[name].rotor_inertia for name in values["motor"]]
        return DescribedModel(described.with_wearer(*worn) if worn else described, values["use_imu"], rotors)
    robot = robot_of(values)
    bare = ArmModel.from_moments(robot.length, robot.first_moment, robot.off_axis, gravity=robot.gravity)
    return MomentModel(bare.with_wearer(*worn) if worn else bare, values["use_imu"])
