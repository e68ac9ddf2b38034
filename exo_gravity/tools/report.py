# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""report BAG: what a recorded trial showed, as a table, CSV files, figures and one HTML page.

Several recordings, or a folder of them, become one table and page, a row for each trial, and cohort.csv, a row for each
joint; without --csv, --figures and --video. They are read by a process for each core or, with --scheduler, by the
workers of a Dask cluster.

With --repair it instead writes a complete copy of a recording that was cut short, for `ros2 bag` and other tools.

Exit code 0: the arms held, or the recording is complete. 1: one drifted more than allowed, or was never held. 2: wrong
use, or part of a recording could not be read; the rest is reported first.
"""

import argparse
import math
import os
from collections.abc import Sequence
from functools import partial
from glob import glob
from pathlib import Path

from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.report import video
from exo_gravity.lab.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.tools.cli import exit_code, extras, non_negative, positive


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="report", description="Report a recorded trial: holds, drift, pushes.")
    option = parser.add_argument
    bag = "rosbag2 folder, or an .mcap or .db3 file, complete or cut short; or several; or a folder of recordings"
    option("bag", nargs="+", help=bag)
    option(
        "--repair", action="store_true", help="write a complete copy, BAG_repaired, of a recording cut short; no report"
    )
    option("--output", metavar="DIR", help="folder for the report (default: BAG_report next to the first recording)")
    option("--csv", action="store_true", help="also write the time series, time_series.csv, a row per sample and joint")
    every = "keep one of N samples of each arm: less memory, a coarser report (%(default)s)"
    option("--decimate", type=positive, default=1, metavar="N", help=every)
    option(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster whose workers read the recordings, tcp://HOST:8786"
    )
    formats = "also write each figure in this format; twice for both"
    option("--figures", action="append", choices=("pdf", "svg"), default=[], help=formats)
    option("--width", type=non_negative, metavar="MM", help="of these, as printed: 85 is one column (170)")
    option("--font", metavar="NAME", help="of these, in 8 pt (DejaVu Sans)")
    option("--joints", type=positive, nargs="+", default=[], metavar="N", help="joints of the overview (all)")
    option("--from", dest="start", type=non_negative, default=0.0, metavar="S", help="begin of the overview")
    option("--to", dest="end", type=non_negative, default=math.inf, metavar="S", help="end of the overview")
    for name, default, unit, description in (
        ("--max-drift", 0.5, "DEG", "drift allowed within any 10 s of a hold (%(default)s)"),
        ("--max-drift-after-push", 2.0, "DEG", "the same for a hold after a push (%(default)s)"),
        ("--max-rate", math.inf, "DEG/MIN", "drift rate allowed over a whole hold (no limit)"),
        ("--min-hold", MIN_HOLD, "S", "shortest still phase that is a hold (%(default)s)"),
    ):
        option(name, type=non_negative, default=default, metavar=unit, help=description)
    video.add_arguments(parser)
    options = parser.parse_args(args)
    # A name that exists is no pattern: `run[1]` is not `run1`.
    texts = [[text] if os.path.lexists(text) else sorted(glob(text)) or [text] for text in options.bag]
    options.bag = [Path(text) for found in texts for text in found]
    if options.repair and len(options.bag) > 1:
        parser.error("--repair takes one recording")
    if (options.width or options.font) and not options.figures:
        parser.error("--width and --font are those of --figures")
    return options


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    return exit_code("report", "report", lambda: (_repair if options.repair else _run)(options))


def _repair(options: argparse.Namespace) -> int:
    from exo_gravity.lab.bag.writer import is_complete, repair

    (path,) = options.bag
    if is_complete(path):
        print(f"{path} is complete: nothing to repair")
        return 0
    folder, count = repair(path)
    print(f"Written: {folder}, complete, with {count} messages")
    return 0


def _run(options: argparse.Namespace) -> int:
    from rich.console import Console

    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import cohort, trial_report
    from exo_gravity.lab.report.figures import Part
    from exo_gravity.lab.report.html import Print

    criteria = HoldCriteria(
        max_stray=math.radians(options.max_drift),
        max_stray_after_push=math.radians(options.max_drift_after_push),
        max_rate=math.radians(options.max_rate) / 60.0,
    )
    (path, *more), screen = options.bag, Console(stderr=True)
    beside = path.resolve().with_name(f"{path.resolve().stem}_report")
    if more or options.scheduler or (path.is_dir() and cohort.recordings_below(path) not in ([], [path])):
        return _run_cohort(options, criteria, Path(options.output or beside))
    clip = video.requested(options.video, options.video_speed)
    with screen.status(f"reading {path.name}"):
        bag = read_bag(path, options.decimate)
    report = trial_report.analyse(bag, criteria, options.min_hold)
    look = {"width": options.width, "font": options.font}
    on_paper = Print(options.figures, **{name: value for name, value in look.items() if value})
    part = Part(options.joints, options.start, options.end)
    written = trial_report.write(report, options.output or beside, on_paper, part, options.csv)
    if clip:
        clip.write(bag, screen)
    trial_report.print_report(report)
    print(f"Written: {', '.join(path.name for path in written)} in {written[0].parent}")
    return report.exit_code


def _run_cohort(options: argparse.Namespace, criteria: HoldCriteria, output: Path) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from exo_gravity.lab.bag.storage import check_name
    from exo_gravity.lab.parallel import in_processes, on_cluster
    from exo_gravity.lab.report import cohort, overview
    from exo_gravity.lab.report.table import write_rows

    found = [one for path in options.bag for one in (path.is_dir() and cohort.recordings_below(path)) or [path]]
    recordings = [*{one.resolve(): one for one in found}.values()]  # one that is named twice is one trial
    of_one = options.csv, options.figures, options.video, options.joints, options.start, math.isfinite(options.end)
    if any(of_one):
        expected = "reported one by one, without --scheduler, for --csv, --figures, --video and a part of the overview"
        raise ParameterError("recordings", len(recordings), expected)
    for recording in recordings:
        check_name(recording)
    output.mkdir(parents=True, exist_ok=True)
    judging = cohort.Judging(criteria, options.min_hold, options.decimate)
    cache = cohort.Cache(output / "cohort_cache.jsonl", judging)
    run = partial(on_cluster, options.scheduler) if options.scheduler else in_processes
    screen = Console(stderr=True)
    columns = BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("left")
    with (
        extras("report", "report"),
        Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as progress,
    ):
        task = progress.add_task("", total=len(recordings))
        rows, known = cohort.summaries(recordings, judging, cache, run, lambda: progress.advance(task))
    write_rows(output / "cohort.csv", rows)
    trials = overview.trials_of(rows)
    name = options.bag[0].resolve().stem if len(options.bag) == 1 else f"{len(recordings)} recordings"
    (output / "cohort.html").write_text(overview.page(trials, name), encoding="utf-8")
    console = Console(highlight=False, width=None if Console().is_terminal else 200)
    overview.print_trials(trials, console)
    console.print(f"{overview.summary_of(trials)}; {known} recordings had not changed", soft_wrap=True)
    console.print(f"Written: cohort.csv and cohort.html in {output}", markup=False, soft_wrap=True)
    if overview.problems_of(trials):
        return 2
    return int(not all(row["held"] for row in trials))
