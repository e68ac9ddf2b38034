# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""doctor --params FILE: whether this computer is fit to carry the arms of a parameter file.

It reads the file as its nodes do, opens each CAN interface that the file names unless a bridge holds it, reads the
computer's settings, and measures for ten seconds how late a thread like the control loop's wakes up. Each line has what
it looked at, what it found and what is wanted; below it stands the command that fixes it.

Exit code 0: fine. 1: warnings. 2: no one may wear an arm that this computer controls; also wrong use or wrong file.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from exo_gravity import require_ros
from exo_gravity.lab.inputs.parameter_file import load, packaged_config
from exo_gravity.tools.cli import exit_code, extras, non_negative


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="doctor", description="Whether this computer is fit to carry an arm.")
    parser.add_argument("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged sim.yaml)")
    parser.add_argument(
        "--seconds", type=non_negative, default=10.0, metavar="S",
        help="for which wake-ups are measured (%(default)s)",
    )  # fmt: skip
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None, root: Path = Path("/")) -> int:
    """Run the command line; return the exit code. root: the folder that has /proc and /sys."""
    options = _arguments(args)
    require_ros("doctor")
    return exit_code("doctor", "report", lambda: _run(options, root))


def _run(options: argparse.Namespace, root: Path) -> int:
    """Examine the computer, and print each finding and the verdict; return the exit code."""
    from rich.console import Console

    with extras("doctor", "ros"):
        from exo_gravity.lab.computer import Level, examine, show
    findings = examine(load(options.params or packaged_config("sim.yaml")), options.seconds, root)
    show(findings, Console(highlight=False))
    warnings, faults, unknown = (
        sum(row.level is level for row in findings) for level in (Level.WARNING, Level.FAULT, Level.UNKNOWN)
    )
    if faults:
        print(f"No one may wear an arm that this computer controls. Faults: {faults}, warnings: {warnings}")
        return 2
    tried = f"Nothing is wrong in what could be tried; unknown: {unknown}" if unknown else "Fine"
    print(f"Warnings: {warnings}" if warnings else tried)
    return int(warnings > 0)
