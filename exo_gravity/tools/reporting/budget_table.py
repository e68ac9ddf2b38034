"""The torque budget of one arm: its numbers, a table of them, and sentences that interpret them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.model.arm import ArmModel
from exo_gravity.core.model.budget import (
    FAMILY,
    JointBudget,
    Workspace,
    budget,
    largest_support,
    motor_for,
    motor_torques,
    rounded_down,
)
from exo_gravity.core.model.wearer import LinkLoad, Wearer
from exo_gravity.tools.inputs.arms import ConfiguredArm, named

JOINTS = ("shoulder rotation", "shoulder abduction", "shoulder flexion", "elbow flexion")
HEADINGS = (
    ("", "", "rated", "peak", "needs", "within", "within", "", "support"),
    ("joint", "motor", "Nm", "Nm", "Nm", "rated", "peak", "worst pose; pitch, roll (deg)", "within rated"),
)
RED, YELLOW, PLAIN = "\033[31m", "\033[33m", "\033[0m"


@dataclass(frozen=True)
class ArmBudget:
    """One arm of a parameter file, the load of its wearer's arm, and what each joint needs to carry it."""

    name: str
    robot: ArmModel
    motors: tuple[str, ...]
    workspace: Workspace
    load: LinkLoad
    support: float
    joints: tuple[JointBudget, ...]

    @property
    def beyond(self) -> list[int]:
        """Indices of the joints that need more than rated torque somewhere."""
        return [number for number, joint in enumerate(self.joints) if joint.overloaded]


def arm_budget(configured: ConfiguredArm, wearer: Wearer, support: float, max_tilt: float) -> ArmBudget:
    """Return the budget of an arm that carries `support` (0..1) of the wearer's arm; max_tilt: of the trunk, rad.

    Raises ParameterError if the wearer does not fit the robot.
    """
    motors = tuple(configured.can_bridge["motor"])
    workspace = Workspace(configured.limits.position_min, configured.limits.position_max, max_tilt)
    with named(f"{configured.namespace}/compensator"):
        load = wearer.on_links(configured.robot.length)
        torques = motor_torques(motors, configured.can_bridge["torque_scale"])
        joints = budget(configured.robot, load, support, workspace, *torques)
    return ArmBudget(configured.namespace, configured.robot, motors, workspace, load, support, joints)


def table_lines(arm: ArmBudget, colour: bool = False) -> Iterator[str]:
    """Yield the lines of a table with one row per joint; colour: for a terminal, mark joints beyond rated torque."""
    yield f"{arm.name} at support {arm.support:g}, trunk tilt up to {math.degrees(arm.workspace.max_tilt):g} deg"
    yield from (_line(*heading) for heading in HEADINGS)
    for number, joint in enumerate(arm.joints):
        *pose, pitch, roll = (f"{angle:.0f}" for angle in np.degrees(joint.worst) + 0.0)  # + 0.0: no minus zero
        line = _line(
            f"{number + 1} {JOINTS[number]}",
            arm.motors[number],
            f"{joint.rated:.3g}",
            f"{joint.peak:.3g}",
            f"{joint.torque:.2f}",
            f"{100 * rounded_down(joint.within_rated):.1f} %",
            f"{100 * rounded_down(joint.within_peak):.1f} %",
            f"{', '.join(pose)}; {pitch}, {roll}",
            "none" if joint.support is None else f"{rounded_down(joint.support):.3f}",
        )
        mark = RED if joint.torque > joint.peak else YELLOW
        yield f"{mark}{line}{PLAIN}" if colour and joint.overloaded else line


def _line(*cells: str) -> str:
    joint, motor, rated, peak, needs, within_rated, within_peak, pose, support = cells
    torques = f"{rated:>7}{peak:>7}{needs:>8}{within_rated:>10}{within_peak:>10}"
    return f"  {joint:<22}{motor:<8}{torques}   {pose:<32}{support:>12}".rstrip()


def verdict(arm: ArmBudget, wearer: Wearer) -> list[str]:
    """Return the conclusion in sentences: what is beyond the motors, which motor would do, which support fits."""
    support = "Full Zero-G" if arm.support == 1.0 else f"Support {arm.support:g}"
    what = f"{support} of a wearer of {wearer.body_mass:g} kg"
    if arm.beyond:
        sentences = [f"{what} is beyond the motors of {arm.name}."]
        sentences += [_shortage(arm, number) for number in arm.beyond]
        sentences.append(
            "A larger motor is heavier and loads the joints before it: change the masses and run this again."
        )
        if any(motor_for(arm.joints[number].torque) == "AK80-64" for number in arm.beyond):
            sentences.append("AK80-64 has a 64:1 gear: the wearer can hardly move it by hand.")
    else:
        sentences = [f"{what} is within rated torque everywhere on {arm.name}."]
    largest = largest_support(arm.joints)
    if largest is None:
        sentences.append("The robot alone needs more than rated torque somewhere: no support stays within it.")
    else:
        sentences.append(f"The largest support within rated torque everywhere is {largest:g}.")
    return sentences


def _shortage(arm: ArmBudget, number: int) -> str:
    joint, needs = arm.joints[number], arm.joints[number].torque
    motor = motor_for(needs)
    remedy = f"{motor} would do ({FAMILY[motor][0]:g} Nm rated)" if motor else "No motor of its family would do"
    return (
        f"Joint {number + 1}, {JOINTS[number]}: {needs:.1f} Nm, {needs / joint.rated:.1f} times the rated torque of "
        f"its {arm.motors[number]} ({joint.rated:.3g} Nm), {'beyond' if needs > joint.peak else 'within'} its peak "
        f"({joint.peak:.3g} Nm). {remedy}."
    )
