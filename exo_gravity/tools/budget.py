"""budget --params FILE --body-mass KG: the torque that a wearer's arm requires of each motor, against what it can give.

For every arm of a parameter file: the robot alone and with the wearer's arm, over all poses within the joint limits
and over the trunk's tilt. Holding an arm up is continuous work, so rated torque decides; peak torque lasts for seconds.

Exit code 0: within rated torque everywhere. 1: beyond it somewhere. 2: wrong use or wrong file.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from exo_gravity.core.arm.arm import ArmModel
from exo_gravity.core.arm.budget import (
    USUAL_TILT,
    JointBudget,
    budget,
    largest_support,
    motor_for,
    motor_torques,
    torque_at,
    workspace,
)
from exo_gravity.core.arm.wearer import SEX, TABLES, TYPICAL_LENGTH, Wearer
from exo_gravity.core.errors import named
from exo_gravity.core.numbers import JOINT_COUNT, one_float
from exo_gravity.lab.inputs.arms import ConfiguredArm, configured_arms
from exo_gravity.tools.cli import exit_code

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 150
JOINTS = ("shoulder rotation", "shoulder abduction", "shoulder flexion", "elbow flexion")
HEADINGS = (
    ("", "", "rated", "peak", "needs", "within", "within", "", "support", "motor that"),
    ("joint", "motor", "Nm", "Nm", "Nm", "rated", "peak", "worst pose; pitch, roll (deg)", "within rated", "would do"),
)
LINE = "  {:<22}{:<8}{:>7}{:>7}{:>8}{:>10}{:>10}   {:<32}{:>12}{:>12}"
CELLS = 31  # of a map, along each axis
REST = 5  # values of each angle that a map does not show
OTHER = (1, 2, 3, 2)  # the second axis of each joint's map: the angle that affects it most


@dataclass(frozen=True)
class ArmBudget:
    """What each joint of an arm needs to carry its wearer's arm."""

    name: str  #: of the arm's namespace
    carrying: ArmModel  #: with its share of the wearer's arm
    support: float  #: 0..1, that share
    motors: Sequence[str]
    bounds: np.ndarray  #: of its workspace, (2, 6) rad
    joints: tuple[JointBudget, ...]

    @property
    def is_beyond(self) -> bool:
        """Whether a joint needs more than rated torque somewhere."""
        return any(joint.torque > joint.rated for joint in self.joints)


def arm_budget(configured: ConfiguredArm, wearer: Wearer, support: float, max_tilt: float, payload: float) -> ArmBudget:
    """Return the budget of an arm that carries `support` (0..1) of the wearer's arm and `payload` kg in the hand.

    max_tilt: of the trunk, rad. Raises ParameterError if the wearer does not fit the robot.
    """
    motors = configured.can_bridge["motor"]
    robot = configured.robot.with_payload(payload, configured.compensator["payload.cog"])
    bounds = workspace(configured.low, configured.high, max_tilt)
    with named(f"{configured.namespace}/compensator "):
        load = wearer.on_links(robot.length)
        torques = motor_torques(motors, configured.can_bridge["torque_scale"])
        joints = budget(robot, load, support, bounds, *torques)
        carrying = robot.with_wearer(*load, support)
    return ArmBudget(configured.namespace, carrying, support, motors, bounds, joints)


def table_lines(arm: ArmBudget) -> Iterator[str]:
    """Yield the lines of a table with one row per joint."""
    yield from (LINE.format(*heading).rstrip() for heading in HEADINGS)
    for number, joint in enumerate(arm.joints):
        *pose, pitch, roll = (f"{angle:.0f}" for angle in np.degrees(joint.worst) + 0.0)  # + 0.0: no minus zero
        yield LINE.format(
            f"{number + 1} {JOINTS[number]}",
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
    else:
        yield f"The largest support within rated torque everywhere is {fits:g}."
    moments = ", ".join(f"{math.ceil(1000.0 * moment) / 1000.0:g}" for moment in arm.carrying.first_moment)
    yield f"For the can_bridge of {names}, if it never carries more: largest_moment: [{moments}]  # kg m"


def _joint_figure(arm: ArmBudget, joint: int) -> "Figure":
    """Map the largest torque of a joint (0..3) over two angles: the maximum over the others and the trunk's tilt."""
    from matplotlib.figure import Figure

    other = OTHER[joint]
    axes = [np.linspace(low, high, REST) for low, high in arm.bounds.T]
    axes[joint] = axes[other] = np.zeros(1)
    rest = np.vstack((list(product(*axes)), arm.joints[joint].worst))
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
    axis.set_title(f"{arm.name} joint {joint + 1}, {JOINTS[joint]}: {arm.motors[joint]}", loc="left", weight="bold")
    axis.set_xlabel(f"Joint {joint + 1} (deg)")
    axis.set_ylabel(f"Joint {other + 1} (deg); maximum over the other joints and the trunk's tilt")
    return figure


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="budget", description="Torque that a wearer's arm requires of each motor.")
    option = parser.add_argument
    option("--params", required=True, metavar="FILE", help="ROS 2 parameter file with the arms")
    option("--body-mass", required=True, type=float, metavar="KG", help="body mass of the wearer")
    option("--sex", default="male", choices=SEX, help="sex of the wearer (%(default)s)")
    option("--table", default="de_leva", choices=tuple(TABLES), help="body segment parameters (%(default)s)")
    option(
        "--lengths", type=float, nargs=3, default=TYPICAL_LENGTH, metavar=("UPPER_ARM", "FOREARM", "HAND"),
        help="segment lengths in m, the hand to the third knuckle (%(default)s)",
    )  # fmt: skip
    option("--support", type=float, default=1.0, metavar="0..1", help="share of the wearer's arm carried (%(default)s)")
    option("--payload", type=float, default=0.0, metavar="KG", help="load in the hand (%(default)s)")
    tilt = "largest trunk pitch and roll, in either direction (%(default)s)"
    option("--max-tilt", type=float, default=USUAL_TILT, metavar="DEG", help=tilt)
    option("--output", default="budget", metavar="DIR", help="folder for a figure of each joint (%(default)s)")
    return parser.parse_args(args)


def _run(options: argparse.Namespace) -> int:
    """Draw a figure of each joint, and print the budget of each arm; return 1 if a motor is overloaded somewhere."""
    wearer = Wearer(options.body_mass, options.sex, options.table, options.lengths)
    support = one_float("support", options.support, 0.0, 1.0)
    tilt = math.radians(one_float("max_tilt", options.max_tilt, 0.0, 90.0, "deg"))
    arms = [arm_budget(arm, wearer, support, tilt, options.payload) for arm in configured_arms(options.params)]
    folder, written = Path(options.output), []
    folder.mkdir(parents=True, exist_ok=True)
    for arm, joint in product(arms, range(JOINT_COUNT)):
        written.append(f"{arm.name.strip('/').replace('/', '_')}_joint_{joint + 1}.png")
        _joint_figure(arm, joint).savefig(folder / written[-1], dpi=DPI)
    masses = zip(("upper arm", "forearm", "hand"), wearer.segments, strict=True)
    segments = ", ".join(f"{name} {mass:.2f} kg at {cog:.3f} m" for name, (mass, cog) in masses)
    print(f"Wearer: {wearer.body_mass:g} kg, {wearer.sex}, table {wearer.table}: {segments}")
    zero_g = "Full Zero-G" if support == 1.0 else f"Support {support:g}"
    held = f" with {options.payload:g} kg in the hand" if options.payload else ""
    alike: dict[str, list[ArmBudget]] = {}  # one table names all arms that share it, as mirrored ones do
    for arm in arms:
        alike.setdefault("\n".join(table_lines(arm)), []).append(arm)
    for table, (arm, *others) in alike.items():
        names = " and ".join(one.name for one in (arm, *others))
        print(f"\n{names} at support {support:g}, trunk tilt up to {options.max_tilt:g} deg", table, "", sep="\n")
        print(*verdict(arm, names, f"{zero_g} of a wearer of {wearer.body_mass:g} kg{held}"), sep="\n")
    print(f"\nWritten: {', '.join(written)} in {folder}")
    return int(any(arm.is_beyond for arm in arms))


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    return exit_code("budget", "report", lambda: _run(options))
