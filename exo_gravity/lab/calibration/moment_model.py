# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibration needs of an arm: its torque, linear in k moments, and which of them it takes for known.

The paper's arm has the eight moments of `core.arm.paper`; any other those of `UrdfArm.base`, which a QR decomposition
of its regressor leaves. Both are first moments in kg m. Both arms have

    count, names, moments, start   n joints; of the k moments: names, kg m as far as known, kg m from which a fit begins
    gravity                        m/s^2
    suggested                      (m, n) rad, poses from which a missing one is taken
    beside                         number of directions in which a weight may hang beside its link
    turns                          of the joints' places that are fitted
    keeps_axes, keeps_tilt         whether the parameter file takes over axes that are askew; and gravity's direction as
                                   found, as an IMU's mounting
    shows_tilt, expects_scales     whether gravity's direction is fitted, too; and whether a torque scale is expected to
                                   be near that of the file
    compared                       joints whose torque scales have a product of 1 without a weight
    positive                       numbers of the moments that are at least 0
    optional                       numbers of the unknowns of `pose_fit.FitLayout` that need not show
"""

import itertools
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from exo_gravity.core.arm.chain import frames
from exo_gravity.core.arm.paper import ArmModel
from exo_gravity.core.arm.tilt import SIDES, Tilt
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import JOINT_COUNT, NO_TORQUE, Torque
from exo_gravity.hardware.urdf_arm import UrdfArm
from exo_gravity.lab.moments import MOMENTS, load_moments, regressor

Holder = Callable[[Sequence[float], Tilt], Torque]
# kg m, of a robot arm with the motors of this package; only the share of noise and scale in a pose depends on it.
TYPICAL_MOMENTS = (0.08, 0.15, 0.2, 0.026, 0.0, 0.0, 0.0, 0.0)
# deg of each joint, within the paper's ranges: from these a missing pose is suggested.
GRID = ((-60, 0, 60), (15, 45, 75, 105, 135), (-30, 0, 30, 60, 90, 120), (0, 30, 60, 90, 120, 150))
TURNS = 3  # of a joint's place: about its axis, and about two directions across it
SUGGESTED = 600  # poses at random, from which one is suggested for another arm
FITTED = 60  # of them, in which the moments of an arm with turned axes are found
STEP = 10.0  # deg, of their angles


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


class PapersMoments:
    """The paper's arm.

    arm: of which the moments are known, and the lengths.
    keeps_tilt: whether an IMU measures gravity's direction, whose mounting is corrected by what a fit finds.
    """

    count = JOINT_COUNT
    names: tuple[str, ...] = MOMENTS
    start = np.array((0.0, *TYPICAL_MOMENTS[1:]))
    beside, turns, keeps_axes = 3, TURNS * JOINT_COUNT, False
    compared: tuple[int, ...] = 1, 2, 3  # joint 1 carries nothing while its axis is vertical
    positive: tuple[int, ...] = (0,)  # M1, the least certain
    optional: tuple[int, ...] = 0, 4, 8, 12  # M1, W, scale and offset of joint 1
    shows_tilt, expects_scales = True, False
    suggested = np.radians(list(itertools.product(*GRID)))

    def __init__(self, arm: ArmModel, keeps_tilt: bool) -> None:
        self.length, self.gravity, self.moments = arm.length, arm.gravity, arm.moments
        self.keeps_tilt = keeps_tilt

    def down(self, tilt: Tilt) -> np.ndarray:
        """Return gravity's unit vector (3,) in the arm's base frame."""
        return np.array(tilt.direction)

    def rows(self, theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the torque (m, 4, 8) in Nm per kg m at `theta` (m, 4) rad. direction: (3,) or (m, 3)."""
        return regressor(theta, direction, self.gravity)

    def load(self, mass: float, lever: float) -> np.ndarray:
        """Return the moments (8,) of `mass` kg on link 4, `lever` m from the elbow. Raises ParameterError."""
        return load_moments(self.length.tolist(), mass, lever)

    def load_beside(self, mass: float, lever: float) -> np.ndarray:
        """Return their change (8, 3) by how far the weight hangs off its link: M3 to Y3, M4 to Y4, and M4 to Z."""
        load, change = self.load(mass, lever), np.zeros((len(MOMENTS), self.beside))
        for angle, (along, across) in enumerate(((2, 6), (3, 7), (3, 5))):
            change[across, angle] = load[along]
        return change

    def turned(self, theta: np.ndarray) -> np.ndarray:
        """Return the derivative (m, 4, 8, 3, 12) of `along_axes` by turns of the joints' places."""
        links = np.array([frames(NO_TORQUE, pose) for pose in theta.tolist()])  # (m, 4, 5, 3), without lengths
        axes, along = links[:, :, 1], links[:, :, 2]
        beside = [axes[:, 1], axes[:, 2], *(np.cross(axes[:, 2], along[:, link]) for link in (2, 3))]
        moments = np.stack((*np.swapaxes(along, 0, 1), *beside), axis=1)
        before = np.concatenate((np.broadcast_to(np.eye(3)[:1], along[:, :1].shape), along[:, :-1]), axis=1)
        turns = np.stack((axes, before, np.cross(axes, before)), axis=2)
        link = np.tile(np.arange(self.count), 2)
        return self.gravity * turned_by(axes, turns, moments, link, np.tri(self.count, dtype=bool).T)

    def holding(self, moments: np.ndarray) -> Holder:
        """Return the exact law in plain floats, of an arm for each joint, less that of what is below 0 of its M1..M4.

        An arm has none below 0, but a joint may seem to, until more poses are known.
        """
        along, across = moments[:, :JOINT_COUNT], moments[:, JOINT_COUNT:]
        arms = self._arms(np.maximum(along, 0.0), across)
        below = self._arms(np.maximum(-along, 0.0), np.zeros_like(across))

        def hold(theta: Sequence[float], tilt: Tilt) -> Torque:
            pairs = enumerate(zip(arms, below, strict=True))
            return tuple(arm.torque(theta, tilt)[n] - less.torque(theta, tilt)[n] for n, (arm, less) in pairs)

        return hold

    def _arms(self, along: np.ndarray, across: np.ndarray) -> list[ArmModel]:
        """Return the arms with M1..M4 (n, 4) and W, Z, Y3, Y4 (n, 4), in kg m."""
        pairs = zip(along, across, strict=True)
        return [ArmModel.from_moments(self.length, *pair, gravity=self.gravity) for pair in pairs]

    def common(self, moments: np.ndarray) -> np.ndarray:
        """Return the mean of the joints; M_n is that of joint n."""
        return np.append(np.diag(moments[:, :JOINT_COUNT]), moments[:, JOINT_COUNT:].mean(axis=0))

    def matrix(self, theta: Sequence[float], moments: np.ndarray, load: tuple[float, float]) -> np.ndarray:
        """Return the mass matrix (4, 4) in kg m^2 of an arm with these moments."""
        weight, lever = load
        bare = np.maximum(moments - self.load(weight, lever), 0.0)[:JOINT_COUNT]
        arm = ArmModel.from_moments(self.length, bare).with_payload(weight, (lever - self.length[3], 0.0, 0.0))
        return arm.links.matrix(theta)

    def upwards(self, theta: np.ndarray) -> np.ndarray:
        """Return the sine (m,) of the largest angle of links 3 and 4 above the horizontal of an upright trunk."""
        down = np.cos(theta[:, 1:2]) * np.cos(np.stack((theta[:, 2], theta[:, 2] + theta[:, 3]), axis=1))
        return np.asarray(-down.min(axis=1))


class UrdfMoments:
    """An arm from a URDF.

    arm: with gains of 1.
    rotors: (n,) kg m^2, inertia of the motors' rotors at the joints.
    shows_tilt: whether an IMU measures gravity's direction, and its mounting may be wrong.

    Raises ParameterError if a joint that is not the arm's moves its links, or one of them follows another.
    """

    beside, keeps_axes = 2, True
    positive: tuple[int, ...] = ()
    optional: tuple[int, ...] = ()
    expects_scales = True

    def __init__(self, arm: UrdfArm, rotors: Sequence[float], shows_tilt: bool) -> None:
        if not arm.moves_alone:
            listed = list(arm.names)
            raise ParameterError("joint_names", listed, "all joints that move the arm's links, for a calibration")
        self.arm, self.gravity, self.moments = arm, arm.gravity, arm.moments
        self._rotors, self.shows_tilt, self.keeps_tilt = np.diag(rotors), shows_tilt, shows_tilt
        self.count, self.start = len(arm.names), self.moments
        self.turns = TURNS * self.count
        numbers = [n for n, _ in arm.base]
        self.names = tuple(f"{arm.names[n]} {numbers[:k].count(n) + 1}" for k, n in enumerate(numbers))
        self.compared = tuple(range(self.count))
        low, high = arm.ranges
        poses = np.random.default_rng(1).uniform(low, high, (SUGGESTED, self.count))
        self.suggested = np.radians(STEP * np.round(np.degrees(poses) / STEP))
        self._loaded: dict[tuple[float, float], UrdfArm] = {(0.0, 0.0): arm}

    def down(self, tilt: Tilt) -> np.ndarray:
        """Return gravity's unit vector (3,) in the root link's axes."""
        return np.array(tilt.gravity_in_trunk)

    def rows(self, theta: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the torque (m, n, k) in Nm per kg m at `theta` (m, n) rad. direction: (3,) or (m, 3)."""
        return self.arm.regressor(theta, direction)

    def load(self, mass: float, lever: float) -> np.ndarray:
        """Return the moments (k,) of `mass` kg on the way from the last joint to the hand. Raises ParameterError."""
        return np.asarray(self._with(mass, lever).moments - self.moments) if mass else np.zeros(len(self.names))

    def load_beside(self, mass: float, lever: float) -> np.ndarray:
        """Return the change (k, 2) of these moments with the weight in the two directions across its way."""
        return mass * lever * self._across

    @cached_property
    def _across(self) -> np.ndarray:
        """What 1 kg m on the last link in either direction across its way adds to the moments, (k, 2)."""
        last = np.eye(self.count)[-1]
        ways = np.linalg.svd(self.arm.directions[-1:])[2][1:]
        if not self.arm.bodies()[0][-1]:
            return np.zeros((len(self.names), len(ways)))
        bare, *changed = [self.arm.with_wearer_moments(np.outer(last, way)).moments for way in (0.0 * ways[0], *ways)]
        return np.transpose(changed) - bare[:, None]

    def turned(self, theta: np.ndarray) -> np.ndarray:
        """Return the derivative (m, n, k, 3, 3 n) of `along_axes` by turns of the joints' places."""
        before, after = self.arm.frames(theta)
        link, ways = np.array([n for n, _ in self.arm.base]), np.array([way for _, way in self.arm.base])
        moments = np.einsum("mkab,kb->mka", after[:, link], ways)
        turns = np.einsum("mnab,ntb->mnta", before, self.arm.turns)
        return self.gravity * turned_by(turns[:, :, 0], turns, moments, link, self.arm.moved_by)

    def found(self, moments: np.ndarray, turn: np.ndarray) -> UrdfArm:
        """Return the arm with these `moments` (k,) kg m and `turn` (n, 3) rad of the joints' axes, as a fit found them.

        The turns about the axes are errors of the zeros, and not part of it. The fit has turned no moment along an
        axis: what that changes in an arm whose places are turned, the moments make up for.
        """
        across = np.einsum("nt,ntb->nb", turn[:, 1:], self.arm.turns[:, 1:])
        poses, down = self.suggested[:FITTED], np.eye(3)[np.arange(FITTED) % 3]
        askew = (turn * (0.0, 1.0, 1.0)).ravel()
        wanted = self.rows(poses, down) @ moments
        wanted += np.einsum("mnkat,ma,k,t->mn", self.turned(poses), down, moments, askew, optimize=True)
        turned = self.arm.turned(self.arm.turn + across)
        own = turned.torques(poses, [Tilt.of_gravity(SIDES[0], way).direction for way in down])
        rows = turned.regressor(poses, down).reshape(-1, len(moments))
        return turned.with_more_moments(np.linalg.lstsq(rows, (wanted - own).ravel(), rcond=None)[0])

    def holding(self, moments: np.ndarray) -> Holder:
        """Return `UrdfArm.by_moments`."""
        return self.arm.by_moments(moments)

    def common(self, moments: np.ndarray) -> np.ndarray:
        """Return what the joint shows that carries the moment with its own link."""
        return np.array([moments[n, k] for k, (n, _) in enumerate(self.arm.base)])

    def matrix(self, theta: Sequence[float], moments: np.ndarray, load: tuple[float, float]) -> np.ndarray:
        """Return the mass matrix (n, n) in kg m^2 by the URDF, with the load."""
        return self._with(*load).links.matrix(theta) + self._rotors

    def upwards(self, theta: np.ndarray) -> np.ndarray:
        """Return the sine (m,) of the largest angle of a link above the plane across the root link's z axis."""
        ways = np.diff(self.arm.places(theta), axis=1)
        length = np.linalg.norm(ways, axis=2)
        rise = np.divide(ways[:, :, 2], length, out=np.full_like(length, -1.0), where=length > 0.0)
        return np.asarray(rise.max(axis=1))

    def _with(self, mass: float, lever: float) -> UrdfArm:
        key = mass, lever
        if key not in self._loaded:
            none = [0.0] * (self.count - 1)
            self._loaded[key] = self.arm.with_wearer([*none, mass], [*none, lever])
        return self._loaded[key]


MomentModel = PapersMoments | UrdfMoments


def along_axes(model: MomentModel, theta: np.ndarray) -> np.ndarray:
    """Return the torque (m, n, k, 3) in Nm per kg m with gravity along each axis of the base frame."""
    return np.stack([model.rows(theta, axis) for axis in np.eye(3)], axis=-1)
