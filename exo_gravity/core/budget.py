"""The torque budget: what gravity asks of each motor over the whole workspace, against what the motor can give.

The workspace is every pose within the joint limits at every trunk tilt up to a bound. Gravity's torque is linear in the
masses (M1..M4 of `gravity.py`), hence in the support s of the wearer's arm: tau = tau_robot + s tau_wearer. So the
largest s at which a joint stays within its limit, |tau_robot + s tau_wearer| <= limit, is a quotient at each pose.

Shares of the workspace are counted over uniform random poses. A worst pose is the worst of them, improved along one
coordinate after the other until it gets no worse.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.arm import JOINT_COUNT, ArmModel, four_floats, one_float
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.gravity import gravity_torque
from exo_gravity.core.motors import MOTORS
from exo_gravity.core.wearer import LinkLoad

USUAL_TILT = 20.0  # deg of pitch and roll that a trunk is counted on to do, either way
SAMPLES = 50_000  # shares to within 0.5 %
STARTS = 5  # poses from which a worst one is sought: one blind alley does no harm
PIECE = 2_000  # poses, about 1 ms of arithmetic
EQUAL = 1e-3  # Nm, or support: finer than a motor can
STEPS = np.array(sorted(np.linspace(-1.0, 1.0, 21), key=abs))  # 0 first: a tie stays where it is

# Rated and peak torque in Nm. Beyond the two motors that the package drives: the maker's product pages of February
# 2024, as collected in gatech-epic-power/epically-powerful (actuation/motor_data.py); AK10-9 is V2.0.
FAMILY = {
    **{spec.name: (spec.rated_torque, spec.peak_torque) for spec in MOTORS.values()},
    "AK70-10": (10.0, 24.8),
    "AK10-9": (18.0, 48.0),
    "AK80-64": (48.0, 120.0),
}


def motor_for(torque: float) -> str | None:
    """Return the motor of the family with the least rated torque that covers `torque` Nm, or None if none does."""
    return min((name for name in FAMILY if FAMILY[name][0] >= torque), key=lambda name: FAMILY[name][0], default=None)


def motor_torques(motors: Sequence[str], torque_scale: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return rated and peak torque (4,) in Nm of `motors` that give `torque_scale` times what they are told."""
    # A motor that gives less than it is told is at its rated current when told its rated torque.
    scale = np.minimum(four_floats("torque_scale", torque_scale, 0.2, 2.0), 1.0)
    rated, peak = (scale * [FAMILY[motor][which] for motor in motors] for which in (0, 1))
    return rated, peak


@dataclass(frozen=True)
class Workspace:
    """Joint limits (4,) in rad, and the largest pitch and roll of the trunk, either way, in rad (to pi/2)."""

    position_min: Sequence[float]
    position_max: Sequence[float]
    max_tilt: float

    def __post_init__(self):
        low = four_floats("position_min", self.position_min, -3.15, 3.15, "rad")
        high = four_floats("position_max", self.position_max, -3.15, 3.15, "rad")
        if np.any(low >= high):
            raise ParameterError("position_max", self.position_max, f"above position_min = {low.tolist()} rad")
        object.__setattr__(self, "position_min", low)
        object.__setattr__(self, "position_max", high)
        object.__setattr__(self, "max_tilt", one_float("max_tilt", self.max_tilt, 0.0, np.pi / 2, "rad"))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest point (6,): four joint angles, pitch and roll of the trunk, rad."""
        tilt = np.repeat(self.max_tilt, 2)
        return np.append(self.position_min, -tilt), np.append(self.position_max, tilt)

    def points(self, count: int = SAMPLES) -> np.ndarray:
        """Return points (count, 6), uniform over the workspace; the same ones every time."""
        return np.random.default_rng(0).uniform(*self.bounds, (count, JOINT_COUNT + 2))


@dataclass(frozen=True)
class JointBudget:
    """What one joint needs at the support asked for, and which support it allows.

    rated, peak: Nm, what its motor gives. torque: Nm, the largest needed anywhere. worst: (6,) rad, the pose and the
    trunk's pitch and roll that ask for it.
    within_rated, within_peak: shares 0..1 of the workspace. support: the largest, 0..1, within rated torque
    everywhere; None where the robot alone needs more.
    """

    rated: float
    peak: float
    torque: float
    worst: np.ndarray
    within_rated: float
    within_peak: float
    support: float | None

    @property
    def beyond(self) -> bool:
        """Whether the joint needs more than rated torque somewhere."""
        return self.torque > self.rated


def largest_support(joints: Sequence[JointBudget]) -> float | None:
    """Return the largest support, 0..1, within rated torque everywhere, rounded down to a thousandth; None if none."""
    supports = [joint.support for joint in joints]
    return None if None in supports else rounded_down(min(supports))


def rounded_down(share: float) -> float:
    """Return a share to a thousandth, down: whoever follows it stays within, and 1 means all."""
    return math.floor(1000 * share + 1e-9) / 1000


def overload(names: Sequence[str], joints: Sequence[JointBudget]) -> str:
    """Return what is beyond rated torque, and which support would not be, in a sentence; '' where all is within."""
    needs = [
        f"{name} needs {joint.torque:.1f} Nm in its worst pose (rated {joint.rated:.3g}, peak {joint.peak:.3g})"
        for name, joint in zip(names, joints, strict=True)
        if joint.beyond
    ]
    if not needs:
        return ""
    fits = largest_support(joints)
    remedy = (
        "no support fits: the robot alone is beyond" if fits is None else f"the largest support that fits is {fits:g}"
    )
    return f"beyond the motors: {', '.join(needs)}; {remedy}"


def torque_at(arm: ArmModel, points: np.ndarray) -> np.ndarray:
    """Return the exact law's torque (n, 4) in Nm at points (n, 6): joint angles, pitch and roll of the trunk, rad."""
    pitch, roll = points[:, JOINT_COUNT], points[:, JOINT_COUNT + 1]
    # `Tilt.of`, for arrays and the left arm. A workspace has every roll both ways, so it is the right arm's too.
    level = np.cos(pitch)
    directions = np.stack((-np.sin(roll) * level, np.sin(pitch), np.cos(roll) * level), axis=1)
    return gravity_torque(arm, points[:, :JOINT_COUNT], directions)


def budget(
    robot: ArmModel,
    load: LinkLoad,
    support: float,
    workspace: Workspace,
    rated: Sequence[float],
    peak: Sequence[float],
    pause: Callable[[], None] = lambda: None,
) -> tuple[JointBudget, ...]:
    """Return the budget of each joint of `robot` that carries `support` (0..1) of a wearer's arm.

    rated, peak: (4,) Nm at the joints. pause: called before each millisecond or so of arithmetic, of which there are
    some 500. Raises ParameterError where the load does not fit the robot.
    """
    full = robot.with_wearer(*load)

    def torques(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pieces = []
        for piece in np.array_split(points, len(points) // PIECE + 1):
            pause()
            pieces.append((torque_at(robot, piece), torque_at(full, piece)))
        own, with_all = map(np.concatenate, zip(*pieces, strict=True))
        return own, with_all

    points = workspace.points()
    starts = np.vstack((points[: SAMPLES // 5] * (1, 1, 1, 1, 0, 0), points))  # upright ones first
    at_starts = torques(starts)

    def of_joint(joint: int) -> JointBudget:
        def need(own: np.ndarray, with_all: np.ndarray) -> np.ndarray:
            return np.abs(own + support * (with_all - own))[:, joint]

        def shortage(own: np.ndarray, with_all: np.ndarray) -> np.ndarray:
            return -_support(own[:, joint], with_all[:, joint], rated[joint])

        needs = need(*at_starts)
        worst, torque = _worst(lambda at: need(*torques(at)), workspace, starts, needs)
        _, short = _worst(lambda at: shortage(*torques(at)), workspace, starts, shortage(*at_starts))
        # The worst pose is sought finer than shares are counted: never claim all of the workspace beside a pose beyond.
        shares = (
            min(float(np.mean(needs[-len(points) :] <= limit)), 0.9999 if torque > limit else 1.0)
            for limit in (rated[joint], peak[joint])
        )
        return JointBudget(
            float(rated[joint]), float(peak[joint]), torque, worst, *shares, None if short > 0.0 else -short
        )

    return tuple(map(of_joint, range(JOINT_COUNT)))


def _support(own: np.ndarray, with_all: np.ndarray, limit: float) -> np.ndarray:
    """Return the largest support (n,), at most 1, with |own + support (with_all - own)| <= limit; negative if none."""
    added = with_all - own
    room = limit - np.sign(added) * own  # in the direction in which the wearer's arm pulls
    support = np.divide(room, np.abs(added), out=np.ones_like(room), where=np.abs(added) > 1e-9)
    return np.where(np.abs(own) > limit, -1.0, np.minimum(support, 1.0))


def _worst(cost, workspace: Workspace, starts: np.ndarray, costs: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point (6,) of the largest cost, and that cost; of equals an early one, with as many zeros as can be.

    cost: of points (n, 6). costs: (m,), of `starts` (m, 6).
    """
    low, high = workspace.bounds
    chosen = sorted({*np.argsort(costs)[-STARTS:].tolist(), int(np.argmax(costs[: SAMPLES // 5]))})
    points, values = _climb(cost, starts[chosen], low, high)
    best, largest = points[np.argmax(values >= values.max() - EQUAL)], float(values.max())
    for axis in range(len(best)):
        simpler = best.copy()
        simpler[axis] = np.clip(0.0, low[axis], high[axis])
        if cost(simpler[None])[0] >= largest - EQUAL:
            best = simpler
    return best, largest


def _climb(cost, points: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 6) that no step along one coordinate makes worse, from `points` on, and their costs."""
    width = (high - low) / 8
    values = cost(points)
    while np.any(width > 1e-4):
        for axis in range(points.shape[1]):
            lines = np.repeat(points[:, None], len(STEPS), axis=1)
            lines[:, :, axis] = np.clip(lines[:, :, axis] + STEPS * width[axis], low[axis], high[axis])
            costs = cost(lines.reshape(-1, points.shape[1])).reshape(len(points), len(STEPS))
            chosen = np.arange(len(points)), np.argmax(costs, axis=1)
            points, values = lines[chosen], costs[chosen]
        width = width / 4
    return points, values
