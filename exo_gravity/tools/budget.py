"""budget --params FILE --body-mass KG: the torque that a wearer's arm requires of each motor, against what it can give.

For every arm of a parameter file: the robot alone and with the wearer's arm, over all poses within the joint limits
and over the trunk's tilt. Holding an arm up is continuous work, so rated torque decides; peak torque lasts for seconds.

Exit code 0: within rated torque everywhere. 1: beyond it somewhere. 2: wrong use or wrong file.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.core.model.budget import USUAL_TILT
from exo_gravity.core.model.wearer import SEX, TABLES, TYPICAL_LENGTH, Wearer
from exo_gravity.core.numbers import one_float
from exo_gravity.tools.cli import missing
from exo_gravity.tools.inputs.arms import configured_arms
from exo_gravity.tools.reporting.budget_table import ArmBudget, arm_budget, table_lines, verdict

DPI = 150


def _write_figures(arms: Sequence[ArmBudget], folder: Path) -> str:
    """Draw a figure of each joint into `folder`; return a line on what was written."""
    try:
        from exo_gravity.tools.reporting.budget_figures import joint_figure
    except ModuleNotFoundError as error:
        return f"No figures: {missing(error.name or 'matplotlib', 'report')}"
    names = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for arm in arms:
            for joint in range(len(arm.joints)):
                names.append(f"{arm.name.strip('/').replace('/', '_')}_joint_{joint + 1}.png")
                joint_figure(arm, joint).savefig(folder / names[-1], dpi=DPI)
    except OSError as error:
        raise ParameterError("output", str(folder), f"a folder to write to ({error.strerror})") from None
    return f"Written: {', '.join(names)} in {folder}"


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
    tilt = "largest trunk pitch and roll, in either direction (%(default)s)"
    option("--max-tilt", type=float, default=USUAL_TILT, metavar="DEG", help=tilt)
    option("--output", default="budget", metavar="DIR", help="folder for a figure of each joint (%(default)s)")
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    try:
        wearer = Wearer(options.body_mass, options.sex, options.table, options.lengths)
        support = one_float("support", options.support, 0.0, 1.0)
        tilt = math.radians(one_float("max_tilt", options.max_tilt, 0.0, 90.0, "deg"))
        arms = [arm_budget(arm, wearer, support, tilt) for arm in configured_arms(options.params)]
        written = _write_figures(arms, Path(options.output))
    except ExoGravityError as error:
        print(f"budget: {error}", file=sys.stderr)
        return 2
    masses = zip(("upper arm", "forearm", "hand"), wearer.segments, strict=True)
    segments = ", ".join(f"{name} {mass:.2f} kg at {cog:.3f} m" for name, (mass, cog) in masses)
    print(f"Wearer: {wearer.body_mass:g} kg, {wearer.sex}, table {wearer.table}: {segments}")
    for arm in arms:
        print("", *table_lines(arm, sys.stdout.isatty()), "", *verdict(arm, wearer), sep="\n")
    print(f"\n{written}")
    return int(any(arm.beyond for arm in arms))
