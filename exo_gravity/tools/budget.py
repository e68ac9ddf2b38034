"""budget --params FILE --body-mass KG: which torque a wearer's arm asks of each motor, against what the motor can give.

For every arm of a parameter file: the robot alone and with the wearer's arm, over all poses within the joint limits
and over the trunk's tilt. Holding an arm up is continuous work, so rated torque decides; peak torque is for seconds.

Exit code 0: within rated torque everywhere. 1: beyond it somewhere. 2: wrong use or file.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from exo_gravity.core.arm import ArmModel, one_float
from exo_gravity.core.budget import (
    FAMILY,
    USUAL_TILT,
    JointBudget,
    Workspace,
    budget,
    largest_support,
    motor_for,
    motor_torques,
    rounded_down,
)
from exo_gravity.core.control_params import CAN_BRIDGE, COMPENSATOR
from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.core.motors import MOTORS
from exo_gravity.core.wearer import SEX, TABLES, TYPICAL_LENGTH, LinkLoad, Wearer
from exo_gravity.tools.inputs.parameter_file import load
from exo_gravity.tools.reporting.budget_figures import joint_figure

DPI = 150
# What the nodes take where a parameter file says nothing.
DEFAULTS: dict[str, Any] = {param.name: param.default for param in (*CAN_BRIDGE, *COMPENSATOR)}
NAMES = {"length": "link_length", "mass": "robot.mass", "cog": "robot.cog"}  # what ArmModel calls its own, in a file
JOINTS = ("shoulder rotation", "shoulder abduction", "shoulder flexion", "elbow flexion")


@dataclass(frozen=True)
class Arm:
    """One arm of a parameter file, who wears it, and what that asks of it."""

    name: str
    robot: ArmModel
    motors: tuple[str, ...]
    workspace: Workspace
    load: LinkLoad
    support: float
    joints: tuple[JointBudget, ...]

    @property
    def beyond(self) -> list[int]:
        """The joints that need more than rated torque somewhere."""
        return [number for number, joint in enumerate(self.joints) if joint.beyond]


def arm_of(nodes: dict[str, dict[str, Any]], namespace: str, wearer: Wearer, support: float, max_tilt: float) -> Arm:
    """Return the arm of `namespace` ('/right') in a parameter file's nodes, with its budget; max_tilt: rad.

    Raises ParameterError, naming the parameter, where one is impossible or the wearer does not fit.
    """
    bridge, compensator = f"{namespace}/can_bridge", f"{namespace}/compensator"
    if bridge not in nodes:
        raise ParameterError("params", sorted(nodes), f"with {bridge}, which has the motors and the joint limits")
    value = {**DEFAULTS, **nodes[bridge], **nodes[compensator]}
    try:
        robot = ArmModel(*(value[key] for key in ("link_length", "robot.cog", "robot.mass", "gain", "gravity")))
        workspace = Workspace(value["position_min"], value["position_max"], max_tilt)
        motors = value["motor"]
        if len(motors) != 4 or not set(motors) <= set(MOTORS):
            raise ParameterError("motor", motors, f"4, each one of {', '.join(MOTORS)}")
        load_on_links = wearer.on_links(robot.length)
        joints = budget(robot, load_on_links, support, workspace, *motor_torques(motors, value["torque_scale"]))
    except ParameterError as error:
        name = NAMES.get(error.name, error.name)
        raise ParameterError(f"{namespace} {name}", error.value, error.expected) from None
    return Arm(namespace, robot, tuple(motors), workspace, load_on_links, support, joints)


def table(arm: Arm) -> Table:
    """Return what each joint needs, where, and which share of the workspace that leaves within its motor's torque."""
    result = Table(
        title=f"{arm.name} at support {arm.support:g}, trunk tilt up to {math.degrees(arm.workspace.max_tilt):g} deg",
        box=box.SIMPLE_HEAD,
        title_justify="left",
    )
    for heading in ("joint", "motor"):
        result.add_column(heading)
    for heading in ("rated\nNm", "peak\nNm", "needs\nNm", "within\nrated", "within\npeak"):
        result.add_column(heading, justify="right")
    result.add_column("worst pose; pitch, roll (deg)", no_wrap=True)
    result.add_column("support\nwithin rated", justify="right")
    for number, joint in enumerate(arm.joints):
        *pose, pitch, roll = (f"{angle:.0f}" for angle in np.degrees(joint.worst) + 0.0)
        style = "red" if joint.torque > joint.peak else "yellow" if joint.beyond else ""
        result.add_row(
            f"{number + 1} {JOINTS[number]}",
            arm.motors[number],
            f"{joint.rated:.3g}",
            f"{joint.peak:.3g}",
            f"{joint.torque:.2f}",
            f"{100 * rounded_down(joint.within_rated):.1f} %",
            f"{100 * rounded_down(joint.within_peak):.1f} %",
            f"{', '.join(pose)}; {pitch}, {roll}",
            "none" if joint.support is None else f"{rounded_down(joint.support):.3f}",
            style=style,
        )
    return result


def verdict(arm: Arm, wearer: Wearer) -> list[str]:
    """Return in sentences what the table means."""
    what = "full Zero-G" if arm.support == 1.0 else f"support {arm.support:g}"
    sentences = []
    for number in arm.beyond:
        joint = arm.joints[number]
        need, motor = joint.torque, motor_for(joint.torque)
        remedy = f"{motor} would do ({FAMILY[motor][0]:g} Nm rated)" if motor else "No motor of its family would do"
        sentences.append(
            f"Joint {number + 1}, {JOINTS[number]}: {need:.1f} Nm, {need / joint.rated:.1f} times the rated torque of "
            f"its {arm.motors[number]} ({joint.rated:.3g} Nm), {'beyond' if need > joint.peak else 'within'} its peak "
            f"({joint.peak:.3g} Nm). {remedy}."
        )
    if sentences:
        sentences.insert(0, f"{what} of a wearer of {wearer.body_mass:g} kg is beyond the motors of {arm.name}.")
        sentences.append("A larger motor weighs more, on the joints before it too: weigh it in and run this again.")
        if any(motor_for(arm.joints[joint].torque) == "AK80-64" for joint in arm.beyond):
            sentences.append("AK80-64 has a gear of 64 to 1: the wearer can hardly turn it from outside.")
    else:
        sentences.append(
            f"{what} of a wearer of {wearer.body_mass:g} kg is within rated torque everywhere on {arm.name}."
        )
    largest = largest_support(arm.joints)
    if largest is None:
        sentences.append("The robot alone asks for more than rated torque somewhere: no support stays within it.")
    else:
        sentences.append(f"The largest support within rated torque everywhere is {largest:g}.")
    return [sentence[0].upper() + sentence[1:] for sentence in sentences]


def _write(arm: Arm, folder: Path) -> list[Path]:
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for joint in range(4):
            paths.append(folder / f"{arm.name.strip('/').replace('/', '_')}_joint_{joint + 1}.png")
            joint_figure(arm, joint, JOINTS[joint]).savefig(paths[-1], dpi=DPI)
    except OSError as error:
        raise ParameterError("output", str(folder), f"a folder to write to ({error.strerror})") from None
    return paths


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="budget", description="Torque that a wearer's arm asks of each motor.")
    option = parser.add_argument
    option("--params", required=True, metavar="FILE", help="the parameter file that the launcher starts from")
    option("--body-mass", required=True, type=float, metavar="KG", help="of the wearer")
    option("--sex", default="male", choices=SEX, help="of the wearer (%(default)s)")
    option("--table", default="de_leva", choices=tuple(TABLES), help="body segment parameters (%(default)s)")
    option(
        "--lengths", type=float, nargs=3, default=TYPICAL_LENGTH, metavar=("UPPER_ARM", "FOREARM", "HAND"),
        help="m; the hand to the third knuckle (%(default)s)",
    )  # fmt: skip
    option("--support", type=float, default=1.0, metavar="0..1", help="share of the wearer's arm carried (%(default)s)")
    tilt = "trunk pitch and roll, either way (%(default)s)"
    option("--max-tilt", type=float, default=USUAL_TILT, metavar="DEG", help=tilt)
    option("--output", default="budget", metavar="DIR", help="folder for a picture per joint (%(default)s)")
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    console = Console(highlight=False)
    console = console if console.is_terminal else Console(highlight=False, width=140)
    try:
        wearer = Wearer(options.body_mass, options.sex, options.table, options.lengths)
        support = one_float("support", options.support, 0.0, 1.0)
        tilt = math.radians(one_float("max_tilt", options.max_tilt, 0.0, 90.0, "deg"))
        nodes = load(options.params)
        spaces = [node.rsplit("/", 1)[0] for node in nodes if node.endswith("/compensator")]
        if not spaces:
            raise ParameterError("params", options.params, "a file with a compensator")
        arms = [arm_of(nodes, space, wearer, support, tilt) for space in spaces]
        pictures = [path for arm in arms for path in _write(arm, Path(options.output))]
    except ExoGravityError as error:
        Console(stderr=True, highlight=False).print(f"budget: {error}", markup=False, soft_wrap=True)
        return 2
    masses = zip(("upper arm", "forearm", "hand"), wearer.segments, strict=True)
    told = ", ".join(f"{name} {mass:.2f} kg at {cog:.3f} m" for name, (mass, cog) in masses)
    console.print(f"Wearer: {wearer.body_mass:g} kg, {wearer.sex}, table {wearer.table}: {told}", soft_wrap=True)
    for arm in arms:
        console.print(table(arm))
        console.print("\n".join(verdict(arm, wearer)), markup=False, soft_wrap=True)
    console.print(f"\nWritten: {', '.join(path.name for path in pictures)} in {Path(options.output)}", soft_wrap=True)
    return int(any(arm.beyond for arm in arms))
