"""report BAG: what a recorded trial showed, as a table, CSV files, figures and one HTML page.

With --repair it instead writes a complete copy of a recording that was cut short, for `ros2 bag` and other tools.

Exit code 0: the arm held, or the recording is complete. 1: it drifted more than allowed, or was never held. 2: wrong
use, or part of the recording could not be read; the rest is reported first.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from exo_gravity.lab.report import video
from exo_gravity.lab.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.tools.cli import exit_code, non_negative


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="report", description="Report a recorded trial: holds, drift, pushes.")
    option = parser.add_argument
    option("bag", help="rosbag2 folder, or an .mcap or .db3 file, complete or cut short")
    option(
        "--repair", action="store_true", help="write a complete copy, BAG_repaired, of a recording cut short; no report"
    )
    option("--output", metavar="DIR", help="folder for the report (default: BAG_report next to the recording)")
    option("--csv", action="store_true", help="also write the time series, time_series.csv, a row per sample and joint")
    formats = "also write each figure in this format; twice for both"
    option("--figures", action="append", choices=("pdf", "svg"), default=[], help=formats)
    for name, default, unit, description in (
        ("--max-drift", 0.5, "DEG", "drift allowed within any 10 s of a hold (%(default)s)"),
        ("--max-drift-after-push", 2.0, "DEG", "the same for a hold after a push (%(default)s)"),
        ("--max-rate", math.inf, "DEG/MIN", "drift rate allowed over a whole hold (no limit)"),
        ("--min-hold", MIN_HOLD, "S", "shortest still phase that is a hold (%(default)s)"),
    ):
        option(name, type=non_negative, default=default, metavar=unit, help=description)
    video.add_arguments(parser)
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    return exit_code("report", "report", lambda: (_repair if options.repair else _run)(options))


def _repair(options: argparse.Namespace) -> int:
    from exo_gravity.lab.bag.writer import is_complete, repair

    path = Path(options.bag)
    if is_complete(path):
        print(f"{path} is complete: nothing to repair")
        return 0
    folder, count = repair(path)
    print(f"Written: {folder}, complete, with {count} messages")
    return 0


def _run(options: argparse.Namespace) -> int:
    from rich.console import Console

    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import trial_report

    criteria = HoldCriteria(
        max_stray=math.radians(options.max_drift),
        max_stray_after_push=math.radians(options.max_drift_after_push),
        max_rate=math.radians(options.max_rate) / 60.0,
    )
    path, screen = Path(options.bag), Console(stderr=True)
    clip = video.requested(options.video, options.video_speed)
    with screen.status(f"reading {path.name}"):
        bag = read_bag(path)
    report = trial_report.analyse(bag, criteria, options.min_hold)
    beside = path.resolve().with_name(f"{path.resolve().stem}_report")
    written = trial_report.write(report, options.output or beside, options.figures, options.csv)
    if clip:
        video.write(bag, clip, screen)
    trial_report.print_report(report)
    print(f"Written: {', '.join(path.name for path in written)} in {written[0].parent}")
    return report.exit_code
