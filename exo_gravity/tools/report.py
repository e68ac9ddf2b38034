# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""report BAG: what a recorded trial showed, as a table, CSV files, figures and one HTML page.

Several recordings, or a folder of them, become one table and page, a row for each trial, the statistics of each
condition, and cohort.csv, a row for each joint. They are read by a process for each core or, with --scheduler, by the
workers of a Dask cluster.

Exit code 0: the arms held. 1: one drifted more than allowed, or was never held. 2: wrong
use, or part of a recording could not be read; the rest is reported first.
"""

import argparse
import math
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from glob import glob
from pathlib import Path

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Bag, name_of
from exo_gravity.lab.report import html, video
from exo_gravity.lab.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.lab.vocabulary import of_all
from exo_gravity.tools.cli import command, extras, non_negative, positive


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="report", description="Report a recorded trial: holds, drift, pushes.")
    option = parser.add_argument
    option(
        "bag", nargs="+",
        help="rosbag2 folder, or an .mcap or .db3 file, complete or cut short; or several; or a folder of recordings",
    )  # fmt: skip
    option("--output", metavar="DIR", help="folder for the report (default: BAG_report next to the first recording)")
    option("--csv", action="store_true", help="also write the time series, time_series.csv, a row per sample and joint")
    option("--parquet", action="store_true", help="the same table as time_series.parquet")
    option(
        "--lerobot", type=positive, metavar="RATE",
        help="also write a LeRobot dataset (v3.0), an episode per recording, of this many frames per s",
    )  # fmt: skip
    option(
        "--by", nargs="+", choices=("protocol", "mode", "support"), metavar="KEY",
        help="what makes a condition of a study: protocol, mode, support (all)",
    )  # fmt: skip
    option(
        "--decimate", type=positive, default=1, metavar="N",
        help="keep one of N samples of each arm: less memory, a coarser report (%(default)s)",
    )  # fmt: skip
    option(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster whose workers read the recordings, tcp://HOST:8786"
    )
    option(
        "--figures", action="append", choices=("pdf", "svg"), default=[],
        help="also write each figure in this format; twice for both",
    )  # fmt: skip
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
    if (options.width or options.font) and not options.figures:
        parser.error("--width and --font are those of --figures")
    return options


def _run(options: argparse.Namespace) -> int:
    from rich.console import Console

    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.report import cohort, trial_report
    from exo_gravity.lab.report.figures import Part

    criteria = HoldCriteria(
        max_stray=math.radians(options.max_drift),
        max_stray_after_push=math.radians(options.max_drift_after_push),
        max_rate=math.radians(options.max_rate) / 60.0,
    )
    given = {name: value for name in ("width", "font") if (value := getattr(options, name))}
    on_paper = html.Print(options.figures, **given)
    (path, *more), screen = options.bag, Console(stderr=True)
    folder = path.resolve().with_name(f"{name_of(path.resolve())}_report")
    if more or options.scheduler or (path.is_dir() and cohort.recordings_below(path) not in ([], [path])):
        return _run_cohort(options, criteria, on_paper, Path(options.output or folder))
    clip = video.requested(options.video, options.video_speed)
    with screen.status(f"reading {path.name}"):
        bag = read_bag(path, options.decimate)
    report = trial_report.analyse(bag, criteria, options.min_hold)
    output, part = Path(options.output or folder), Part(options.joints, options.start, options.end)
    written = sorted([*_export(options, output, lambda: [bag]), *trial_report.write(report, output, on_paper, part)])
    if clip:
        clip(bag, screen)
    trial_report.print_report(report)
    print(f"Written: {', '.join(path.name for path in written)} in {output}")
    return report.exit_code


def _export(options: argparse.Namespace, output: Path, bags: Callable[[], Iterable[Bag]]) -> list[Path]:
    """Write what other programs read; return the tables. bags: returns the recordings, one at a time in memory."""
    tables = [output / f"time_series.{kind}" for kind in ("csv", "parquet") if getattr(options, kind)]
    if not (tables or options.lerobot):
        return []
    from exo_gravity.lab.report.export import write_lerobot, write_time_series

    output.mkdir(parents=True, exist_ok=True)
    for path in tables:
        write_time_series(path, bags())
    if options.lerobot:
        write_lerobot(output / "lerobot", bags(), options.lerobot)
    return tables


def _run_cohort(options: argparse.Namespace, criteria: HoldCriteria, on_paper: html.Print, output: Path) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from exo_gravity.lab.bag.reader import read_bag
    from exo_gravity.lab.bag.storage import check_name
    from exo_gravity.lab.parallel import in_processes, on_cluster
    from exo_gravity.lab.report import cohort, study
    from exo_gravity.lab.report.table import write_rows
    from exo_gravity.lab.report.trial_report import STAMPS

    found = [one for path in options.bag for one in (path.is_dir() and cohort.recordings_below(path)) or [path]]
    recordings = [*{one.resolve(): one for one in found}.values()]  # one that is named twice is one trial
    of_one = {"--video": options.video, "--joints": options.joints, "--from": options.start}
    given = [name for name, value in {**of_one, "--to": math.isfinite(options.end)}.items() if value]
    if given:
        raise ParameterError("recordings", len(recordings), f"one for {', '.join(given)}, which show a part of a trial")
    keys = options.by or study.KEYS
    for recording in recordings:
        check_name(recording)
    output.mkdir(parents=True, exist_ok=True)
    work = partial(cohort.summary, criteria=criteria, min_hold=options.min_hold, every=options.decimate)
    run = partial(on_cluster, options.scheduler) if options.scheduler else in_processes
    screen = Console(stderr=True)
    columns = BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("left")
    with (
        extras("report", "report"),
        Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as progress,
    ):
        task = progress.add_task("", total=len(recordings))
        rows = cohort.summaries(recordings, work, run, lambda: progress.advance(task))
    trials = study.trials_of(rows)
    conditions, compared = [*study.statistics(trials, keys)], [*study.differences(trials, keys)]
    for table, content in (("cohort", rows), ("statistics", conditions), ("differences", compared)):
        write_rows(output / f"{table}.csv", content)
    tables = study.tables_of(trials, conditions, compared)
    readable = [*{row["recording"]: None for row in rows if row["verdict"]}]
    _export(options, output, lambda: (read_bag(recording, options.decimate) for recording in readable))
    source = of_all(Source(row["source"]) for row in trials if row["verdict"])
    figure = study.figure(trials, keys)
    png = html.saved(figure, output / "cohort.png", STAMPS[source], on_paper) if figure else b""
    name = name_of(options.bag[0].resolve()) if len(options.bag) == 1 else f"{len(recordings)} recordings"
    (output / "cohort.html").write_text(study.page(trials, name, tables, png), encoding="utf-8")
    console = Console(highlight=False, width=None if Console().is_terminal else 200)
    study.print_trials(trials, tables, console)
    console.print(study.summary_of(trials), soft_wrap=True)
    console.print(f"Written: cohort.html, its figure and tables in {output}", markup=False, soft_wrap=True)
    return 2 if study.problems_of(trials) else int(not all(row["held"] for row in trials))


main = command("report", "report", _arguments, _run)
