# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""validate: reproduces the paper's comparison: every law against the Robotics Toolbox's gravload and Pinocchio.

It compares over 1,053 positions of the workspace, then over 100,000 random ones at each of five limits of the trunk's
tilt; with centres of gravity at the far ends of the links, as in the paper's equations, and as configured. Tables go to
the terminal, CSV and figures to a folder.

Exit code 0: all checks held. 1: a check failed. 2: wrong use or wrong file.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.lab.inputs.arms import configured_arm, with_cog_at_link_ends
from exo_gravity.tools.cli import command

COUNT, QUICK_COUNT = 100_000, 2_000  # random poses per limit of the tilt


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="validate", description="Compare every law with gravload and Pinocchio.")
    option = parser.add_argument
    option("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged exo.yaml)")
    option("--side", choices=SIDES, default="right", help="which of its arms (default: right)")
    option("--output", metavar="DIR", default="validation", help="folder for CSV and figures (default: validation)")
    option("--quick", action="store_true", help=f"{QUICK_COUNT:,} random positions instead of {COUNT:,}")
    return parser.parse_args(args)


def _run(options: argparse.Namespace) -> int:
    """Run the comparison and print it; return 1 unless all checks held."""
    from exo_gravity.lab.comparison import CONFIGURED, LINK_ENDS, checks, evaluate, tables, write

    configured = configured_arm(options.params, options.side)
    output = Path(options.output)
    output.mkdir(parents=True, exist_ok=True)
    count = QUICK_COUNT if options.quick else COUNT
    ends = replace(configured, robot=with_cog_at_link_ends(configured.paper_arm))
    parts = evaluate(LINK_ENDS, ends, count), evaluate(CONFIGURED, configured, count)
    print(*tables(*parts), "", sep="\n")
    written = write(*parts, output)
    verdicts = list(checks(*parts))
    for held, sentence in verdicts:
        print(f"{'held' if held else 'FAILED':<7}{sentence}")
    print(f"Written: {', '.join(written)} in {output}")
    return int(not all(held for held, _ in verdicts))


main = command("validate", "report,validate", _arguments, _run)
