# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""urdf --params FILE: writes the robot description (URDF) of the arms of a parameter file, for RViz and other programs.

The root link is `trunk` (REP-103); the joints have the names and the order of `joint_names`. `law: exact` with gains of
1 computes the torques of this description.

Exit code 0: written. 2: wrong use or wrong file.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.core.errors import named
from exo_gravity.lab.inputs.arms import configured_arm, configured_arms
from exo_gravity.lab.view import described, urdf
from exo_gravity.tools.cli import command


def urdf_of(params: str | Path, side: str = "", meshes: str = "") -> str:
    """Return the URDF of the arms in a parameter file, or of the arm on one `side`. Raises ParameterError."""
    arms = [configured_arm(params, side)] if side else configured_arms(params)
    with named(f"{arms[0].namespace}/compensator " if len(arms) == 1 else f"{params} "):
        return urdf([described(arm.compensator, arm.can_bridge) for arm in arms], meshes)


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="urdf", description="Write the robot description of the arms of a file.")
    option = parser.add_argument
    option("--params", required=True, metavar="FILE", help="ROS 2 parameter file with the arms")
    option("--side", default="", choices=SIDES, help="only this arm (default: every arm of the file)")
    option("--meshes", default="", metavar="URI", help="folder with LINK.stl per link, as package://NAME/FOLDER")
    option("--output", metavar="FILE", help="file to write (default: standard output)")
    return parser.parse_args(args)


def _run(options: argparse.Namespace) -> int:
    text = urdf_of(options.params, options.side, options.meshes)
    if options.output:
        Path(options.output).write_text(text, encoding="utf-8")
        print(f"Written: {options.output}")
    else:
        print(text, end="")
    return 0


main = command("urdf", "report", _arguments, _run)
