# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""budget --params FILE --body-mass KG: the torque that a wearer's arm requires of each motor, against what it can give.

For every arm of a parameter file: the robot alone and with the wearer's arm, over all poses within the joint limits
and over the trunk's tilt. Holding an arm up is continuous work, so rated torque decides; peak torque lasts for seconds.

Exit code 0: within rated torque everywhere. 1: beyond it somewhere. 2: wrong use or wrong file.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from exo_gravity.core.arm.wearer import SEX, TABLES, TYPICAL_LENGTH, Wearer
from exo_gravity.core.numbers import one_float
from exo_gravity.lab.budget import USUAL_TILT, ArmBudget, arm_budget, joint_figure, table_lines, verdict
from exo_gravity.lab.inputs.arms import configured_arms
from exo_gravity.lab.report.html import png_of
from exo_gravity.tools.cli import command


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="budget", description="Torque that a wearer's arm requires of each motor.")
    option = parser.add_argument
    option("--params", required=True, metavar="FILE", help="ROS 2 parameter file with the arms")
    option("--body-mass", type=float, metavar="KG", help="the wearer's body mass (default: the file's); 0: no wearer")
    option("--sex", default="male", choices=SEX, help="sex of the wearer (%(default)s)")
    option("--table", default="de_leva", choices=tuple(TABLES), help="body segment parameters (%(default)s)")
    option(
        "--lengths", type=float, nargs=3, default=TYPICAL_LENGTH, metavar=("UPPER_ARM", "FOREARM", "HAND"),
        help="segment lengths in m, the hand to the third knuckle (%(default)s)",
    )  # fmt: skip
    option("--support", type=float, default=1.0, metavar="0..1", help="share of the wearer's arm carried (%(default)s)")
    option("--payload", type=float, default=0.0, metavar="KG", help="load in the hand (%(default)s)")
    option(
        "--max-tilt", type=float, default=USUAL_TILT, metavar="DEG",
        help="largest trunk pitch and roll, in either direction (%(default)s)",
    )  # fmt: skip
    option("--output", default="budget", metavar="DIR", help="folder for a figure of each joint (%(default)s)")
    return parser.parse_args(args)


def _run(options: argparse.Namespace) -> int:
    """Draw a figure of each joint, and print the budget of each arm; return 1 if a motor is overloaded somewhere."""
    configured = configured_arms(options.params)
    own = max(arm.compensator["wearer.body_mass"] for arm in configured)
    mass = own if options.body_mass is None else options.body_mass
    wearer = Wearer(mass, options.sex, options.table, options.lengths) if mass else None
    support = one_float("support", options.support if wearer else 0.0, 0.0, 1.0)
    tilt = math.radians(one_float("max_tilt", options.max_tilt, 0.0, 90.0, "deg"))
    arms = [arm_budget(arm, wearer, support, tilt, options.payload) for arm in configured]
    folder, written = Path(options.output), []
    folder.mkdir(parents=True, exist_ok=True)
    for arm in arms:
        for joint in range(len(arm.joints)):
            written.append(f"{arm.name.strip('/').replace('/', '_')}_joint_{joint + 1}.png")
            # At once: Ctrl-C leaves no half of a picture.
            (folder / written[-1]).write_bytes(png_of(joint_figure(arm, joint)))
    if wearer:
        masses = zip(("upper arm", "forearm", "hand"), wearer.segments, strict=True)
        segments = ", ".join(f"{name} {mass:.2f} kg at {cog:.3f} m" for name, (mass, cog) in masses)
        print(f"Wearer: {wearer.body_mass:g} kg, {wearer.sex}, table {wearer.table}: {segments}")
    zero_g = "Full Zero-G" if support == 1.0 else f"Support {support:g}"
    carried = f"{zero_g} of a wearer of {mass:g} kg" if wearer else "The arm without a wearer"
    held = f" with {options.payload:g} kg in the hand" if options.payload else ""
    alike: dict[str, list[ArmBudget]] = {}  # one table names all arms that share it, as mirrored ones do
    for arm in arms:
        alike.setdefault("\n".join(table_lines(arm)), []).append(arm)
    for table, (arm, *others) in alike.items():
        names = " and ".join(one.name for one in (arm, *others))
        print(f"\n{names} at support {support:g}, trunk tilt up to {options.max_tilt:g} deg", table, "", sep="\n")
        print(*verdict(arm, names, f"{carried}{held}"), sep="\n")
    print(f"\nWritten: {', '.join(written)} in {folder}")
    return int(any(arm.is_beyond for arm in arms))


main = command("budget", "report", _arguments, _run)
