# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibration needs of an arm: its torque, linear in k moments, and which of them it takes for known.

The paper's arm has the eight moments of `core.arm.paper`; any other those of `UrdfArm.base`, which a QR decomposition
of its regressor leaves. Both are first moments in kg m.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from exo_gravity.core.arm.interface import MAX_MASS, Arm, Links
from exo_gravity.core.arm.paper import MAX_LENGTH
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.compensation.laws import URDF_LAW
from exo_gravity.core.compensation.settings import WORN_MOMENTS, robot_of
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.numbers import one_float
from exo_gravity.hardware.urdf_arm import UrdfArm, arm_in_file
from exo_gravity.lab.moments import MOMENTS, PapersChain, chain_of

# deg of each joint, within the paper's ranges: from these a missing pose is suggested.
GRID = ((-60, 0, 60), (15, 45, 75, 105, 135), (-30, 0, 30, 60, 90, 120), (0, 30, 60, 90, 120, 150))
TURNS = 3  # of a joint's place: about its axis, and about two directions across it
SUGGESTED = 600  # poses at random, from which one is suggested for another arm
FITTED = 60  # of them, in which the moments of an arm with turned axes are found
STEP = 10.0  # deg, of their angles
LITTLE = 1e-6  # Nm per kg m: a joint that carries less carries nothing


class Kind(NamedTuple):
    """What is known of arms of a kind before a tour; by default of those from a URDF."""

    #: A description says about what the arm weighs and its motors give, and the file holds what differs from it: first
    #: moments of the links, and axes that are askew. Else the file holds the moments, and a fit begins without such.
    is_described: bool = True
    down: Callable[[Tilt], Sequence[float]] = attrgetter("gravity_in_trunk")  #: gravity's direction in the base frame
    worn: tuple[str, ...] = WORN_MOMENTS  #: parameters of a wearer's moments
    worn_along: tuple[int, ...] = ()  #: numbers of those moments of a wearer that must each be plausible
    at_least_0: tuple[int, ...] = ()  #: numbers of the moments that are 0 where they seem to be less
    above_0: tuple[int, ...] = ()  #: those that must be above 0, and known
    across: tuple[tuple[int, int], ...] = ()  #: of a moment across a link, and of the larger one along it
    rises_from: int = 0  #: the first link that may not point far upwards
    #: (2, n) rad, lowest and highest angles that are comfortable for a wearer; () if only the limits are known
    comfortable: tuple[tuple[float, ...], ...] = ()


PAPERS = Kind(
    is_described=False,
    down=attrgetter("direction"),
    worn=("wearer.first_moment", "wearer.off_axis"),
    worn_along=(2, 3),
    at_least_0=(0,),
    above_0=(1, 2, 3),
    across=((7, 3), (6, 2)),
    rises_from=2,
    comfortable=((-0.4, -0.17, -0.5, -0.17), (0.6, 1.2, 1.3, 1.7)),
)


def turned_by(
    axes: np.ndarray, turns: np.ndarray, moments: np.ndarray, link: np.ndarray, moved_by: np.ndarray
) -> np.ndarray:
    """Return the derivative (m, n, k, 3, 3 n) of `along_axes` per m/s^2 of gravity by turns of the joints' places.

    axes: (m, n, 3), of the joints. turns: (m, n, 3, 3), of each joint the three directions about which its place turns.
    moments: (m, k, 3), directions of the moments. All in the base frame. link: (k,), that has each moment. moved_by:
    (n, n), whether a joint moves the link of another.

    A moment v loads the joint with axis a by -(a x v) . gravity. A turn w of joint j turns all that j moves, except the
    moment along its axis, which counts as one of the link before: a fit takes what is missing for moments of that link.
    """
    moved = moved_by[:, link]  # (n, k)
    cross = np.cross(axes[:, :, None], moments[:, None]) * moved[..., None]  # (m, n, k, 3)
    # By joint j and its turn t: (m, n, k, j, t, 3)
    both = np.cross(turns[:, None, None], cross[:, :, :, None, None])
    swept = np.cross(turns[:, None], moments[:, :, None, None])  # (m, k, j, t, 3)
    alone = np.cross(axes[:, :, None, None, None], swept[:, None]) * moved[..., None, None, None]
    with_axis, with_link = moved_by.T[:, None, :, None, None], moved.T[:, :, None, None]
    change = -np.where(with_axis, both, alone) * with_link
    return np.moveaxis(change, -1, 3).reshape(*cross.shape, -1)


class MomentModel:
    """An arm whose moments are unknown.

    arm: of which the moments are known so far; its gains do not count.
    uses_imu: whether an IMU measures gravity's direction, whose mounting is corrected by what a fit finds.
    rotors: (n,) kg m^2, inertia of the motors' rotors at the joints, where the arm does not know them.

    count, names, moments: n joints; of the k moments their names, and kg m as far as known.
    suggested: (m, n) rad, poses from which a missing one is taken.
    shows_tilt: whether gravity's direction is fitted, too: its turn is also one of the first joint's place.

    Raises ParameterError if a joint that is not the arm's moves its links, or one of them follows another.
    """

    def __init__(self, arm: Arm, uses_imu: bool, rotors: Sequence[float] = ()) -> None:
        self.arm = chain_of(arm)
        self.kind = PAPERS if isinstance(self.arm, PapersChain) else Kind()
        self.gravity, self.moments, self.count = self.arm.gravity, self.arm.moments, len(self.arm.directions)
        self.keeps_tilt, self.shows_tilt = uses_imu, uses_imu or not self.kind.is_described
        self._rotors = np.diag(rotors) if len(rotors) else np.zeros((self.count, self.count))
        self._inertia = lru_cache(4)(self._links_with)
        if isinstance(self.arm, PapersChain):
            self.names: tuple[str, ...] = MOMENTS
            self.suggested = np.radians(list(itertools.product(*GRID)))
            return
        if not self.arm.moves_alone:
            listed = list(self.arm.names)
            raise ParameterError("joint_names", listed, "all joints that move the arm's links, for a calibration")
        numbers = [n for n, _ in self.arm.base]
        self.names = tuple(f"{self.arm.names[n]} {numbers[:k].count(n) + 1}" for k, n in enumerate(numbers))
        low, high = self.arm.ranges
        poses = np.random.default_rng(1).uniform(low, high, (SUGGESTED, self.count))
        self.suggested = np.radians(STEP * np.round(np.degrees(poses) / STEP))

    def down(self, tilt: Tilt) -> np.ndarray:
        """Return gravity's unit vector (3,) in the base frame of the paper's arm, or the root link's axes."""
        return np.array(self.kind.down(tilt))

    def rows(self, theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the torque (m, n, k) in Nm per kg m at `theta` (m, n) rad. direction: (3,) or (m, 3)."""
        return self.arm.regressor(theta, direction)

    @cached_property
    def upright(self) -> np.ndarray:
        """Whether each moment (k,) loads each joint (n,) in any pose while the base is upright, (n, k)."""
        rows = self.rows(self.suggested, self.down(Tilt.of(SIDES[0])))
        return np.asarray((np.abs(rows) > LITTLE).any(axis=0))

    @property
    def compared(self) -> np.ndarray:
        """The joints whose torque scales have a product of 1 without a weight: those that carry something upright."""
        return np.flatnonzero(self.upright.any(axis=1))

    def added(self, link: int) -> np.ndarray:
        """Return what 1 kg in the joint of a link, and 1 kg m on it along x, y, z, add to the moments, (4, k)."""
        each = np.eye(self.count)[link]
        ways = [self.arm.with_wearer_moments(np.outer(each, way)) for way in np.eye(3)]
        return np.array([one.moments - self.moments for one in (self.arm.with_wearer(each, 0.0 * each), *ways)])

    @cached_property
    def _on_last(self) -> np.ndarray:
        return self.added(self.count - 1)

    def load(self, mass: float, lever: float) -> np.ndarray:
        """Return the moments (k,) of `mass` kg on the last link, `lever` m from its joint. Raises ParameterError."""
        mass = one_float("load_mass", mass, 0.0, MAX_MASS, "kg")
        lever = one_float("load_lever", lever, 0.0, MAX_LENGTH, "m")
        if not mass:
            return np.zeros(len(self.names))
        return np.asarray(mass * np.append(1.0, lever * self.arm.directions[-1]) @ self._on_last)

    def load_beside(self, mass: float, lever: float) -> np.ndarray:
        """Return the change (k, 2) of these moments with the weight in the two directions across its link."""
        if not mass:
            return np.zeros((len(self.names), 2))
        across = np.linalg.svd(self.arm.directions[-1:])[2][1:]
        return np.asarray(mass * lever * (across @ self._on_last[1:]).T)

    def turned(self, theta: np.ndarray) -> np.ndarray:
        """Return the derivative (m, n, k, 3, 3 n) of `along_axes` by turns of the joints' places."""
        before, after = self.arm.frames(theta)
        link, ways = np.array([n for n, _ in self.arm.base]), np.array([way for _, way in self.arm.base])
        moments = np.einsum("mkab,kb->mka", after[:, link], ways)
        turns = np.einsum("mnab,ntb->mnta", before, self.arm.turns)
        return self.gravity * turned_by(turns[:, :, 0], turns, moments, link, self.arm.moved_by)

    def found(self, arm: UrdfArm, moments: np.ndarray, turn: np.ndarray) -> UrdfArm:
        """Return `arm` with these `moments` (k,) kg m and `turn` (n, 3) rad of the joints' axes, as a fit found them.

        The turns about the axes are errors of the zeros, and not part of it. The fit has turned no moment along an
        axis: what that changes in an arm whose places are turned, the moments make up for.
        """
        across = np.einsum("nt,ntb->nb", turn[:, 1:], arm.turns[:, 1:])
        poses, down = self.suggested[:FITTED], np.eye(3)[np.arange(FITTED) % 3]
        askew = (turn * (0.0, 1.0, 1.0)).ravel()
        wanted = self.rows(poses, down) @ moments
        wanted += np.einsum("mnkat,ma,k,t->mn", self.turned(poses), down, moments, askew, optimize=True)
        turned = arm.turned(arm.turn + across)
        own = turned.torques(poses, [Tilt.of_gravity(SIDES[0], way).direction for way in down])
        rows = turned.regressor(poses, down).reshape(-1, len(moments))
        return turned.with_more_moments(np.linalg.lstsq(rows, (wanted - own).ravel(), rcond=None)[0])

    def in_links(self, moments: np.ndarray) -> np.ndarray:
        """Return moments (k,) as first moments of the links, (n, 3) kg m along x, y, z of their frames."""
        in_links = np.zeros((self.count, 3))
        for (link, way), moment in zip(self.arm.base, moments, strict=True):
            in_links[link] += moment * way
        return in_links

    def common(self, moments: np.ndarray) -> np.ndarray:
        """Return what the joint shows that carries the moment with its own link."""
        return np.array([moments[n, k] for k, (n, _) in enumerate(self.arm.base)])

    def matrix(self, theta: Sequence[float], load: tuple[float, float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 of the arm as far as known, with the load."""
        return self._inertia(*load).matrix(theta) + self._rotors

    def _links_with(self, mass: float, lever: float) -> Links:
        if not mass:  # a point on the last link would take the place of a wearer
            return self.arm.links
        none = [0.0] * (self.count - 1)
        return self.arm.worn_links([*none, mass], [*none, lever])

    def upwards(self, theta: np.ndarray) -> np.ndarray:
        """Return the sine (m,) of the largest angle of a link above the horizontal of an upright trunk."""
        ways = np.diff(self.arm.places(theta), axis=1)[:, self.kind.rises_from :]
        length, rise = np.linalg.norm(ways, axis=2), -ways @ self.down(Tilt.of(SIDES[0]))
        return np.asarray(np.divide(rise, length, out=np.full_like(length, -1.0), where=length > 0.0).max(axis=1))


def model_of(values: Mapping[str, Any], worn: tuple[Sequence[float], Sequence[float]] | None = None) -> MomentModel:
    """Return the moments of the arm that the parameters of compensator or calibrator describe.

    values: with the motors of an arm from a URDF, by whose rotors its inertia is larger.
    worn: mass (n,) in kg and centre of gravity (n,) in m of a wearer's segments on its links.

    Raises ParameterError, also if the URDF comes from a topic.
    """
    robot: Arm
    if values["law"] == URDF_LAW:
        own = arm_in_file(values, ": a calibration does not wait for a topic")
        robot = own.scaled([1.0] * len(own.names), values["gravity"])
        rotors = [MOTORS[name].rotor_inertia for name in values["motor"]]
    else:
        robot, rotors = robot_of(values), []
    if worn:
        robot = robot.with_wearer(*worn)
    return MomentModel(robot, values["use_imu"], rotors)


def along_axes(model: MomentModel, theta: np.ndarray) -> np.ndarray:
    """Return the torque (m, n, k, 3) in Nm per kg m with gravity along each axis of the base frame."""
    return np.stack([model.rows(theta, axis) for axis in np.eye(3)], axis=-1)
