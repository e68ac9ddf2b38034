"""report BAG: what a recorded trial showed, as a table, CSV files, figures and one HTML page.

Exit code 0: the arm held. 1: it drifted more than allowed, or was never held. 2: wrong use, or something in the
recording could not be read; what could be is reported first.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from io import BytesIO
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from exo_gravity.bag.reader import Bag, read_bag
from exo_gravity.core.errors import DataError
from exo_gravity.core.recording import Recording
from exo_gravity.core.trial_analysis import MIN_HOLD, TrialAnalysis
from exo_gravity.core.trial_analysis import analyse as analyse_arm
from exo_gravity.core.verdict import HoldCriteria, failures
from exo_gravity.tools.reporting import figures, page, table

DPI = 150
MAX_EVENTS = 200
EARLY = (
    0.2  # s before the end of the last step that say that the trial was not done; a bridge speaks ten times a second
)


@dataclass(frozen=True)
class Report:
    """A recording and what each of its arms showed.

    failures: in which ways it did not hold, sentences, none if it held. notes: what a reader must know to trust it.
    """

    bag: Bag
    limits: HoldCriteria
    arms: tuple[tuple[Recording, TrialAnalysis], ...]
    failures: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """0 held, 1 did not hold, 2 something could not be read."""
        return 2 if self.bag.problems else int(bool(self.failures))


def analyse(bag: Bag, limits: HoldCriteria | None = None, min_hold: float = MIN_HOLD) -> Report:
    """Return the report of a recording: holds of at least `min_hold` s, judged by `limits`."""
    limits = limits or HoldCriteria()
    arms = tuple((recording, analyse_arm(recording, min_hold)) for recording in bag.recordings)
    found = tuple(sentence for recording, trial in arms for sentence in failures(recording, trial, limits))
    return Report(bag, limits, arms, found, (*bag.notes, *_how_judged(bag)))


def _how_judged(bag: Bag) -> Iterator[str]:
    """Yield what a reader must know of how the arms were judged."""
    unscripted = [recording.name for recording in bag.recordings if not recording.steps]
    if unscripted:
        yield f"{', '.join(unscripted)}: nobody recorded what the wearer was told: what was still counts as a hold"
    unknown = [recording.name for recording in bag.recordings if recording.carried is None]
    if unknown:
        yield f"{', '.join(unknown)}: nothing tells when the arm was carried: its way down may be taken for a slip"
    for recording in bag.recordings:
        if recording.steps and recording.carried and recording.steps[-1].end > recording.carried[-1][1] + EARLY:
            down = f"let down at {recording.carried[-1][1]:.1f} s, before the trial was done"
            yield f"{recording.name}: the arm was {down}: what came before is judged"


def write(report: Report, folder: str | Path) -> list[Path]:
    """Write holds.csv, motions.csv, a PNG of each figure and report.html into `folder`; return what was written.

    Raises DataError where that fails.
    """
    folder = Path(folder)
    pages = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for kind, rows in (("holds", table.hold_rows), ("motions", table.motion_rows)):
            table.write_csv(folder / f"{kind}.csv", (row for arm in report.arms for row in rows(*arm)))
        for recording, trial in report.arms:
            pages.append(_arm_section(report, recording, trial, folder))
        (folder / "report.html").write_text(_page(report, pages), encoding="utf-8")
    except OSError as error:
        raise DataError(f"{folder}: the report can't be written there ({error.strerror})") from None
    return sorted(path for path in folder.iterdir() if path.suffix in (".csv", ".png", ".html"))


def print_report(report: Report, console: Console | None = None) -> None:
    """Print the tables, what is missing and the verdict."""
    console = console or _console()
    for recording, trial in report.arms:
        table.print_tables(console, recording, trial)
    for note in report.notes:
        console.print(f"[yellow]Note:[/] {escape(note)}.")
    for problem in report.bag.problems:
        console.print(f"[red]Not reported:[/] {escape(problem)}.")
    for sentence in report.failures:
        console.print(f"[red]{escape(sentence)}.[/]")
    held = "It held, as far as it could be read." if report.bag.problems else "It held."
    console.print("[red bold]It did not hold.[/]" if report.failures else f"[green bold]{held}[/]")


def _arm_section(report: Report, recording: Recording, trial: TrialAnalysis, folder: Path) -> str:
    drawn = {"overview": figures.overview(recording, trial)}
    captions = {
        "overview": "Positions, velocities and torques over time; holds are shaded and numbered, dashes are commanded.",
        "drift": "How far each joint went from where a hold began, and the drift of every hold with its uncertainty.",
    }
    if trial.holds:
        drawn["drift"] = figures.drift(recording, trial, report.limits)
    pictures = []
    for kind, figure in drawn.items():
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI)
        (folder / f"{recording.name.replace('/', '_')}_{kind}.png").write_bytes(buffer.getvalue())
        pictures.append(page.figure_html(buffer.getvalue(), captions[kind]))
    return page.arm_html(recording, trial, pictures)


def _page(report: Report, sections: Sequence[str]) -> str:
    bag = report.bag
    began = datetime.fromtimestamp(bag.start / 1e9, timezone.utc).astimezone()
    length = max((float(recording.time[-1]) for recording in bag.recordings), default=0.0)
    events = [f"{table.shown(event.time, 1)} s  {event.text}" for event in bag.events]
    more = [f"and {len(events) - MAX_EVENTS} more"] if len(events) > MAX_EVENTS else []
    ending = (
        page.list_html("Notes", [*bag.problems, *report.notes])
        + page.list_html("Faults and changed parameters", events[:MAX_EVENTS] + more)
        + page.parameters_html(bag.parameters)
    )
    when = f"{began:%Y-%m-%d %H:%M:%S}, {length:.0f} s, {bag.path}"
    return page.page_html(bag.path.stem, when, report.failures, sections, ending)


def _console() -> Console:
    console = Console(highlight=False)
    # Where nobody looks at a terminal (a log, a pipe), tables must not be folded to 80 columns.
    return console if console.is_terminal else Console(highlight=False, width=140)


def _read(path: str) -> Bag:
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"reading {Path(path).name}", total=None)
        return read_bag(path, lambda done, size: progress.update(task, completed=done, total=size))


def at_least_0(text: str) -> float:
    """Return the number that an argument of the command line spells; what is none is argparse's to refuse."""
    value = float(text)
    if not value >= 0.0:  # NaN fails this too, and would make every comparison with it fail in silence
        raise ValueError(text)
    return value


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="report", description="Report a recorded trial: holds, drift, pushes.")
    parser.add_argument("bag", help="a folder of rosbag2, or an .mcap or .db3 file; one cut short will do")
    parser.add_argument(
        "--output", metavar="DIR", help="folder for the report (default: BAG_report beside the recording)"
    )

    def limit(name: str, default: float, unit: str, help: str) -> None:
        parser.add_argument(name, type=at_least_0, default=default, metavar=unit, help=help)

    limit("--max-drift", 0.5, "DEG", "allowed within any 10 s of a hold (%(default)s)")
    limit("--max-drift-after-push", 2.0, "DEG", "the same after a push (%(default)s)")
    limit("--max-rate", math.inf, "DEG/MIN", "allowed over a whole hold (no limit)")
    limit("--min-hold", MIN_HOLD, "S", "shortest hold (%(default)s)")
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(args)
    limits = HoldCriteria(
        max_stray=math.radians(options.max_drift),
        max_stray_after_push=math.radians(options.max_drift_after_push),
        max_rate=math.radians(options.max_rate) / 60.0,
    )
    console = _console()
    try:
        report = analyse(_read(options.bag), limits, options.min_hold)
        path = Path(options.bag).resolve()
        written = write(report, options.output or path.with_name(f"{path.stem}_report"))
    except (DataError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"report: {error}", markup=False, soft_wrap=True)
        return 2
    print_report(report, console)
    console.print(f"Written: {', '.join(path.name for path in written)} in {written[0].parent}", soft_wrap=True)
    return report.exit_code
