# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The torque budget: the gravity torque on each motor over the whole workspace, compared with the motor's limits.

It is given as a table, a verdict, and a map for each joint. Holding an arm up is continuous work, so rated torque
decides; peak torque lasts for seconds.

The workspace is every pose within the joint limits at every trunk tilt up to a bound. Gravity's torque is linear in the
masses (M1..M4 of `gravity.py`), hence in the support s of the wearer's arm: tau = tau_robot + s tau_wearer. The largest
s that keeps a joint within its limit in a pose, |tau_robot + s tau_wearer| <= limit, is therefore a quotient.

Shares of the workspace are estimated from uniform random poses. The search for a worst pose starts from the worst of
these and improves one coordinate after another until nothing gets worse.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.springs import Springs
from exo_gravity.core.arm.wearer import PAPER_LINKS, LinkLoad, Wearer
from exo_gravity.core.compensation.settings import joint_spring_of
from exo_gravity.core.errors import named
from exo_gravity.core.motors.ak import AK
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import scale_at
from exo_gravity.core.numbers import Vector, floats
from exo_gravity.core.safety.explain import GRAVITY
from exo_gravity.core.safety.limits import HEAT
from exo_gravity.lab.inputs.arms import ConfiguredArm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cost = Callable[[np.ndarray], np.ndarray]  # points (m, n + 2) -> (m, n)

USUAL_TILT = 20.0  # deg of trunk pitch and roll, in both directions, that a budget covers by default
SAMPLES = 50_000  # random poses, which give shares to within 0.5 %
STARTS = 5  # poses from which the worst one is sought, because a search can end in a local maximum
CHUNK = 2_000  # poses, about 1 ms of computation
TOLERANCE = 1e-3  # Nm, or support; smaller differences are irrelevant to a motor
STEPS = np.array(sorted(np.linspace(-1.0, 1.0, 21), key=abs))  # 0 comes first, so that the search stays put at a tie
HEADINGS = (
    ("", "", "rated", "peak", "needs", "within", "within", "", "support", "motor that"),
    ("joint", "motor", "Nm", "Nm", "Nm", "rated", "peak", "worst pose; pitch, roll (deg)", "within rated", "would do"),
)
LINE = "  {:<22}{:<8}{:>7}{:>7}{:>8}{:>10}{:>10}   {:<32}{:>12}{:>12}"
CELLS = 31  # of a map, along each axis
REST = 5  # values of each angle that a map does not show
MOST_RESTS, RANDOM_RESTS = 625, 200  # poses of the angles that a map does not show: at random if a grid has more


def motor_for(torque: float) -> str | None:
    """Return the AK motor with the smallest rated torque that covers `torque` Nm, or None if no motor does."""
    strong = [spec for spec in AK.motors.values() if spec.rated_torque >= torque]
    return min(strong, key=lambda spec: spec.rated_torque).name if strong else None


def motor_torques(bridge: Mapping[str, Any]) -> np.ndarray:
    """Return rated and peak torque (2, n) in Nm of the motors of `can_bridge`'s parameter values.

    They are as warm as they may be with all of their torque. Raises ParameterError.
    """
    names = ("torque_scale", "torque_scale_slope", "torque_scale_temperature")
    columns = zip(*(bridge[name] for name in names), strict=True)
    warm = HEAT.most - HEAT.span
    weakest = [min(scale, scale_at(scale, slope, reference, warm)) for scale, slope, reference in columns]
    # A motor that gives less than commanded already reaches its rated current when its rated torque is commanded.
    scale = np.minimum(floats("torque_scale", weakest, len(weakest), 0.1, 2.0), 1.0)
    torques = [(MOTORS[name].rated_torque, MOTORS[name].peak_torque) for name in bridge["motor"]]
    return np.asarray(scale * np.transpose(torques))


def workspace(position_min: Vector, position_max: Vector, max_tilt: float) -> np.ndarray:
    """Return the lowest and the highest point (2, n + 2): the joint angles, then pitch and roll of the trunk, in rad.

    position_min, position_max: the joint limits, (n,) rad. max_tilt: of the trunk, in either direction, rad.
    """
    return np.array(((*position_min, -max_tilt, -max_tilt), (*position_max, max_tilt, max_tilt)))


@dataclass(frozen=True)
class JointBudget:
    """The torque that one joint needs at a given support, and the largest support it allows."""

    rated: float  #: Nm, of its motor
    peak: float  #: Nm
    torque: float  #: Nm, the largest needed in the workspace
    worst: np.ndarray  #: (n + 2,) rad, the pose and the trunk's pitch and roll at which it is needed
    within_rated: float  #: share 0..1 of the workspace in which the motor stays within its rated torque, rounded down
    within_peak: float  #: the same for peak torque
    #: the largest support 0..1 at which the joint stays within rated torque everywhere, rounded down; None: the robot
    #: alone needs more
    support: float | None


def largest_support(joints: Sequence[JointBudget]) -> float | None:
    """Return the largest support 0..1 that keeps all joints within rated torque; None if none does."""
    supports = [joint.support for joint in joints if joint.support is not None]
    return min(supports) if len(supports) == len(joints) else None


def _rounded_down(share: float) -> float:
    """Return a share rounded down to a thousandth, so that the rounded value is still within the limit."""
    return math.floor(1000 * share + 1e-9) / 1000


def overload(names: Sequence[str], joints: Sequence[JointBudget]) -> str:
    """Return which joints are overloaded and which support would fit, in a sentence; '' if no joint is overloaded."""
    needs = [
        f"{name} needs {joint.torque:.1f} Nm in its worst pose (rated {joint.rated:.3g}, peak {joint.peak:.3g})"
        for name, joint in zip(names, joints, strict=True)
        if joint.torque > joint.rated
    ]
    if not needs:
        return ""
    fits = largest_support(joints)
    remedy = "the robot alone needs too much" if fits is None else f"the largest support that fits is {fits:g}"
    return f"motors overloaded: {', '.join(needs)}; {remedy}"


def torque_at(arm: Arm, points: np.ndarray) -> np.ndarray:
    """Return the exact torque (m, n) in Nm at points (m, n + 2) in rad: joint angles, pitch and roll of the trunk."""
    pitch, roll = points[:, -2], points[:, -1]
    # This is `Tilt.of` for arrays and the left arm. A workspace has both signs of roll, so it covers the right arm too.
    level = np.cos(pitch)
    directions = np.stack((-np.sin(roll) * level, np.sin(pitch), np.cos(roll) * level), axis=1)
    return arm.torques(points[:, :-2], directions)


def budget(
    robot: Arm,
    full: Arm,
    springs: tuple[Springs, Springs],
    support: float,
    bounds: np.ndarray,
    rated: Vector,
    peak: Vector,
) -> tuple[JointBudget, ...]:
    """Return the budget of each joint of `robot` when it carries a share `support` (0..1) of a wearer's arm.

    full: the robot with the wearer's whole arm. springs: the device's and the wearer's. bounds: of the workspace,
    (2, n + 2) rad. rated, peak: (n,) Nm at the joints.
    """
    (spring, tissue), count = springs, len(rated)

    def torques(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the torques (m, n) in Nm of robot and springs, and what the wearer's arm adds."""
        chunks = np.array_split(points, len(points) // CHUNK + 1)
        own, with_all = (np.concatenate([torque_at(arm, chunk) for chunk in chunks]) for arm in (robot, full))
        theta = points[:, :count]
        more = tissue.torques(theta) if tissue.on else 0.0
        return own + spring.torques(theta), with_all - own + more

    points = np.random.default_rng(0).uniform(bounds[0], bounds[1], (SAMPLES, count + 2))
    upright = np.repeat((1.0, 0.0), (count, 2))
    starts = np.vstack((points[: SAMPLES // 5] * upright, points))  # those with an upright trunk first

    def need(own: np.ndarray, added: np.ndarray) -> np.ndarray:
        return np.asarray(np.abs(own + support * added))

    def shortage(own: np.ndarray, added: np.ndarray) -> np.ndarray:
        """Return the negative of the largest support, at most 1, within rated torque; 1 where none fits."""
        room = rated - np.sign(added) * own  # in the direction of the wearer's torque
        most = np.divide(room, np.abs(added), out=np.ones_like(room), where=np.abs(added) > 1e-9)
        return np.where(np.abs(own) > rated, 1.0, -np.minimum(most, 1.0))

    at_starts = torques(starts)
    needs, shortages = need(*at_starts), shortage(*at_starts)
    joints = []
    for joint, limits in enumerate(zip(map(float, rated), map(float, peak), strict=True)):
        worst, torque = _worst(lambda at: need(*torques(at)), joint, bounds, starts, needs[:, joint])
        _, short = _worst(lambda at: shortage(*torques(at)), joint, bounds, starts, shortages[:, joint])
        # The search can find an overloaded pose that no sample shows. Then the share must not be 1.
        low, high = (
            _rounded_down(min(float(np.mean(needs[-SAMPLES:, joint] <= limit)), 0.9999 if torque > limit else 1.0))
            for limit in limits
        )
        joints.append(JointBudget(*limits, torque, worst, low, high, None if short > 0.0 else _rounded_down(-short)))
    return tuple(joints)


def _worst(
    cost: Cost, joint: int, bounds: np.ndarray, starts: np.ndarray, costs: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the point (n + 2,) with the largest cost of `joint`, and that cost.

    Among equal points it prefers upright ones and sets as many coordinates as possible to 0. costs: (k,), of `starts`
    (k, n + 2).
    """
    low, high = bounds
    chosen = sorted({*np.argsort(costs)[-STARTS:].tolist(), int(np.argmax(costs[: SAMPLES // 5]))})
    points, values, width = starts[chosen], costs[chosen], (high - low) / 8
    while np.any(width > 1e-4):  # climb from each of the points along one coordinate at a time
        for axis in range(points.shape[1]):
            lines = np.repeat(points[:, None], len(STEPS), axis=1)
            lines[:, :, axis] = np.clip(lines[:, :, axis] + STEPS * width[axis], low[axis], high[axis])
            found = cost(lines.reshape(-1, points.shape[1]))[:, joint].reshape(len(points), len(STEPS))
            best_step = np.arange(len(points)), np.argmax(found, axis=1)
            points, values = lines[best_step], found[best_step]
        width = width / 4
    best, largest = points[np.argmax(values >= values.max() - TOLERANCE)], float(values.max())
    for axis in range(len(best)):
        simpler = best.copy()
        simpler[axis] = np.clip(0.0, low[axis], high[axis])
        if cost(simpler[None])[0, joint] >= largest - TOLERANCE:
            best = simpler
    return best, largest


@dataclass(frozen=True)
class ArmBudget:
    """What each joint of an arm needs to carry its wearer's arm."""

    name: str  #: of the arm's namespace
    joint_names: Sequence[str]
    carrying: Arm  #: with its share of the wearer's arm
    support: float  #: 0..1, that share
    motors: Sequence[str]
    bounds: np.ndarray  #: of its workspace, (2, n + 2) rad
    joints: tuple[JointBudget, ...]

    @property
    def is_beyond(self) -> bool:
        """Whether a joint needs more than rated torque somewhere."""
        return any(joint.torque > joint.rated for joint in self.joints)


def arm_budget(
    configured: ConfiguredArm, wearer: Wearer | None, support: float, max_tilt: float, payload: float
) -> ArmBudget:
    """Return the budget of an arm that carries `support` (0..1) of the wearer's arm and `payload` kg in the hand.

    wearer: None for an arm that is not worn. max_tilt: of the trunk, rad. Raises ParameterError if the wearer does not
    fit the robot.
    """
    values, motors = configured.compensator, configured.can_bridge["motor"]
    names = [name.removeprefix(f"{configured.side}_") for name in configured.joint_names]
    bounds = workspace(configured.low, configured.high, max_tilt)
    with named(f"{configured.namespace}/compensator "):
        robot = configured.robot.with_payload(payload, values["payload.cog"])
        links, count = values.get("wearer.links", PAPER_LINKS), len(configured.joint_names)
        load = LinkLoad(np.zeros(count), np.zeros(count))
        if wearer and any(links):
            load = wearer.on_links(configured.robot.length, links)
        torques = motor_torques(configured.can_bridge)
        springs = joint_spring_of(values), Springs()
        joints = budget(robot, robot.with_wearer(*load), springs, support, bounds, *torques)
        carrying = robot.with_wearer(*load, support)
    return ArmBudget(configured.namespace, names, carrying, support, motors, bounds, joints)


def table_lines(arm: ArmBudget) -> Iterator[str]:
    """Yield the lines of a table with one row per joint."""
    yield from (LINE.format(*heading).rstrip() for heading in HEADINGS)
    for number, joint in enumerate(arm.joints):
        *pose, pitch, roll = (f"{angle:.0f}" for angle in np.degrees(joint.worst) + 0.0)  # + 0.0: no minus zero
        yield LINE.format(
            f"{number + 1} {arm.joint_names[number]}",
            arm.motors[number],
            f"{joint.rated:.3g}",
            f"{joint.peak:.3g}",
            f"{joint.torque:.2f}",
            f"{100 * joint.within_rated:.1f} %",
            f"{100 * joint.within_peak:.1f} %",
            f"{', '.join(pose)}; {pitch}, {roll}",
            "none" if joint.support is None else f"{joint.support:.3f}",
            motor_for(joint.torque) or "none",
        )


def verdict(arm: ArmBudget, names: str, what: str) -> Iterator[str]:
    """Yield the conclusion on `what` the arms `names` carry, the support that fits, and can_bridge's parameter."""
    if arm.is_beyond:
        yield f"{what} is beyond the motors of {names}."
        yield "A larger motor is heavier and loads the joints before it: change the masses and run this again."
        yield "The wearer can hardly move an AK80-64 by hand: its gear is 64:1."
    else:
        yield f"{what} is within rated torque everywhere on {names}."
    fits = largest_support(arm.joints)
    if fits is None:
        yield "The robot alone needs more than rated torque somewhere: no support stays within it."
    elif arm.support:
        yield f"The largest support within rated torque everywhere is {fits:g}."
    skeleton = arm.carrying.skeleton()
    if skeleton is None:  # not a single chain: can_bridge cannot judge its efforts
        return
    yield f"For the can_bridge of {names}, if it never carries more; add what assistance and terms may add:"
    rows = {
        "largest_moment": np.ceil(1000.0 * skeleton.moments) / 1000.0,  # kg m
        "largest_addition": np.ceil(100.0 * GRAVITY * skeleton.beside) / 100.0,  # Nm
        **{f"axis_{name}": column for name, column in zip("xyz", skeleton.axes.T, strict=True)},
        **{f"link_{name}": column for name, column in zip("xyz", skeleton.ways.T, strict=True)},
    }
    for name, values in rows.items():
        if len(values):
            yield f"    {name}: {(values.round(4) + 0.0).tolist()}"


def joint_figure(arm: ArmBudget, joint: int) -> "Figure":
    """Map the largest torque of a joint (from 0) over two angles: the maximum over the others and the trunk's tilt."""
    from matplotlib.figure import Figure

    count = len(arm.joints)
    other = joint + 1 if joint + 1 < count else joint - 1 if joint else 1  # the next, the one before, or the pitch
    if REST ** (len(arm.bounds.T) - 2) > MOST_RESTS:
        points = np.random.default_rng(0).uniform(arm.bounds[0], arm.bounds[1], (RANDOM_RESTS, len(arm.bounds.T)))
    else:
        axes = [np.linspace(low, high, REST) for low, high in arm.bounds.T]
        axes[joint] = axes[other] = np.zeros(1)
        points = np.array(list(product(*axes)))
    rest = np.vstack((points, arm.joints[joint].worst))
    across, up = (np.linspace(low, high, CELLS) for low, high in arm.bounds.T[[joint, other]])
    points = np.tile(rest, (CELLS * CELLS, 1))
    grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    points[:, [joint, other]] = np.repeat(grid, len(rest), axis=0)
    torque = np.abs(torque_at(arm.carrying, points)[:, joint])
    largest = torque.reshape(CELLS, CELLS, len(rest)).max(axis=-1)
    figure = Figure(figsize=(6.5, 5.2), layout="constrained")
    axis = figure.subplots()
    angles = np.degrees(across), np.degrees(up)
    mesh = axis.pcolormesh(*angles, largest, cmap="cividis", vmin=0.0, shading="gouraud")
    figure.colorbar(mesh, ax=axis, label=f"Largest torque at support {arm.support:g} (Nm)")
    for limit, style in ((arm.joints[joint].rated, "-"), (arm.joints[joint].peak, ":")):
        if largest.min() < limit < largest.max():
            axis.clabel(axis.contour(*angles, largest, [limit], colors="red", linestyles=style), fmt=f"{limit:g} Nm")
    axis.set_title(
        f"{arm.name} joint {joint + 1}, {arm.joint_names[joint]}: {arm.motors[joint]}", loc="left", weight="bold"
    )
    axis.set_xlabel(f"Joint {joint + 1} (deg)")
    second = f"Joint {other + 1}" if other < count else "Trunk's pitch"
    axis.set_ylabel(f"{second} (deg); maximum over the other joints and the trunk's tilt")
    return figure
