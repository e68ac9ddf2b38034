# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What an arm requires of its motors to carry its wearer's arm: a table, a verdict, and a map for each joint.

Over all poses within the joint limits and over the trunk's tilt. Holding an arm up is continuous work, so rated torque
decides; peak torque lasts for seconds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from exo_gravity.core.arm.interface import Arm
from exo_gravity.core.arm.wearer import PAPER_LINKS, LinkLoad, Wearer
from exo_gravity.core.compensation.settings import joint_spring_of
from exo_gravity.core.errors import named
from exo_gravity.core.safety.explain import GRAVITY
from exo_gravity.lab.budget import (
    JointBudget,
    budget,
    largest_support,
    motor_for,
    motor_torques,
    torque_at,
    workspace,
)
from exo_gravity.lab.inputs.arms import ConfiguredArm
from exo_gravity.lab.moments import chain_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

JOINTS = ("shoulder rotation", "shoulder abduction", "shoulder flexion", "elbow flexion")
HEADINGS = (
    ("", "", "rated", "peak", "needs", "within", "within", "", "support", "motor that"),
    ("joint", "motor", "Nm", "Nm", "Nm", "rated", "peak", "worst pose; pitch, roll (deg)", "within rated", "would do"),
)
LINE = "  {:<22}{:<8}{:>7}{:>7}{:>8}{:>10}{:>10}   {:<32}{:>12}{:>12}"
CELLS = 31  # of a map, along each axis
REST = 5  # values of each angle that a map does not show
MOST_RESTS, RANDOM_RESTS = 625, 200  # poses of the angles that a map does not show: at random if a grid has more


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
    def others(self) -> Sequence[int]:
        """The second axis of each map: the next joint, or the one before, or the pitch."""
        count = len(self.joints)
        return [n + 1 if n + 1 < count else n - 1 if n else 1 for n in range(count)]

    @property
    def is_beyond(self) -> bool:
        """Whether a joint needs more than rated torque somewhere."""
        return any(joint.torque > joint.rated for joint in self.joints)


def arm_budget(
    configured: ConfiguredArm, wearer: Wearer | None, support: float, max_tilt: float, payload: float
) -> ArmBudget:
    """Return the budget of an arm that carries `support` (0..1) of the wearer's arm and `payload` kg in the hand.

    wearer: None if nobody wears it. max_tilt: of the trunk, rad. Raises ParameterError if the wearer does not fit the
    robot.
    """
    values, motors = configured.compensator, configured.can_bridge["motor"]
    names = configured.joint_names if configured.by_urdf else JOINTS
    bounds = workspace(configured.low, configured.high, max_tilt)
    with named(f"{configured.namespace}/compensator "):
        robot = configured.robot.with_payload(payload, values["payload.cog"])
        links, count = values.get("wearer.links", PAPER_LINKS), len(configured.joint_names)
        load = LinkLoad(np.zeros(count), np.zeros(count))
        if wearer and any(links):
            load = wearer.on_links(configured.robot.length, links)
        torques = motor_torques(configured.can_bridge)
        joints = budget(robot, load, joint_spring_of(values), support, bounds, *torques)
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
    yield from _skeleton_lines(arm, names)


def _skeleton_lines(arm: ArmBudget, names: str) -> Iterator[str]:
    """Yield what the can_bridge needs to judge efforts; nothing if the arm is no single chain."""
    skeleton = chain_of(arm.carrying).skeleton()
    if skeleton is None:
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

    other = arm.others[joint]
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
    second = f"Joint {other + 1}" if other < len(arm.joints) else "Trunk's pitch"
    axis.set_ylabel(f"{second} (deg); maximum over the other joints and the trunk's tilt")
    return figure
