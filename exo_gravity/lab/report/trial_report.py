# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The report of a recorded trial: analysis and verdict of each arm, printed, and written as CSV, figures and a page."""

import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from html import escape
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape as marked

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Bag, Event
from exo_gravity.lab.report import html, table, wearer_share
from exo_gravity.lab.report.verdict import EARLY, Conditions, Report
from exo_gravity.lab.source import STATEMENTS
from exo_gravity.lab.trial.analysis import MIN_HOLD, HoldCriteria
from exo_gravity.lab.trial.analysis import analyse as analyse_arm

MAX_EVENTS = 200
# On each figure, unless the arm is known to be real.
STAMPS = {Source.SIMULATED: "SIMULATED", Source.UNKNOWN: "source unknown", Source.REAL: ""}
WRITTEN = (".csv", ".png", ".html", ".pdf", ".svg")
CAPTIONS = {
    "overview": "Positions, velocities and torques over time. Holds are shaded and numbered; dashes show the command.",
    "drift": "Deviation of each joint from the start of each hold, and the drift of each hold with its uncertainty.",
    "wearer": "The wearer's torque at each joint, and their share of the torque that carries their arm, each with its "
    "95 % band. A band that reaches zero: not distinguishable from zero. See docs/wearer_torque.md.",
}


def analyse(bag: Bag, criteria: HoldCriteria | None = None, min_hold: float = MIN_HOLD, trouble: str = "") -> Report:
    """Return the report of a recording: holds of at least `min_hold` s, judged by `criteria`.

    trouble: why the trial ended early, or ''.
    """
    arms = tuple((recording, analyse_arm(recording, min_hold)) for recording in bag.recordings)
    settings = {recording.name: Conditions.of(bag, recording.name) for recording in bag.recordings}
    wearers, notes = {}, [*bag.notes, *_reservations(bag)]
    for recording in bag.recordings:
        try:
            if part := wearer_share.of_arm(bag, recording):
                wearers[recording.name] = part
        except (DataError, ParameterError) as error:
            notes.append(f"{recording.name}: the wearer's torque is not known: {error}")
    return Report(bag, criteria or HoldCriteria(), arms, settings, wearers, tuple(notes), trouble)


def _reservations(bag: Bag) -> Iterator[str]:
    """Yield what is missing, and what the report does instead."""
    unscripted = [recording.name for recording in bag.recordings if not recording.steps]
    if unscripted:
        yield f"{', '.join(unscripted)}: the recording has no trial script: every still phase is taken for a hold"
    unknown = [recording.name for recording in bag.recordings if recording.carried is None]
    if unknown:
        names = ", ".join(unknown)
        yield f"{names}: the recording does not show when the arm was carried: its way down may be taken for a slip"
    for recording in bag.recordings:
        if recording.steps and recording.carried and recording.steps[-1].end > recording.carried[-1][1] + EARLY:
            end = recording.carried[-1][1]
            what = "the recording ends" if end >= float(recording.time[-1]) else "let down"
            yield f"{recording.name}: {what} at {end:.1f} s, before the script ended: only the time before is judged"


def write(
    report: Report, folder: str | Path, formats: Iterable[str] = (), with_time_series: bool = False
) -> list[Path]:
    """Write holds.csv, motions.csv, a PNG of each figure and report.html into `folder`; return the files.

    formats: 'pdf' or 'svg', of each figure beside its PNG.

    Raises DataError if the folder can't be written.
    """
    from exo_gravity.lab.report import figures  # not for the rows of many recordings: half of a process's start

    folder = Path(folder)
    sections: list[str] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for kind in table.KINDS:
            table.write_csv(folder, kind, report.arms, report.row_head)
        if with_time_series:
            table.write_time_series(folder / "time_series.csv", report.bag.columns())
        for recording, analysis in report.arms:
            source = report.bag.source(recording.name)
            drawn = {"overview": figures.overview(recording, analysis)}
            if any(figures.strayed(analysis)):
                drawn["drift"] = figures.drift(recording, analysis, report.criteria)
            if part := report.wearers.get(recording.name):
                drawn["wearer"] = figures.wearer(recording, part)
            pictures = []
            for name, figure in drawn.items():
                html.stamp(figure, STAMPS[source])
                png = html.png_of(figure)
                path = folder / f"{recording.name.replace('/', '_')}_{name}.png"
                path.write_bytes(png)
                for suffix in formats:
                    html.save_vector(figure, path.with_suffix(f".{suffix}"))
                pictures.append(html.picture(png, CAPTIONS[name]))
            if text := figures.stayed_text(recording, analysis):
                pictures.append(html.bullets("", [text]))
            if part:
                shares = wearer_share.sentence(part, source), wearer_share.joint_sentence(part, recording.joint_names)
                pictures.append(html.bullets("Wearer", shares))
            sections += table.arm_section(recording, analysis, pictures)
        (folder / "report.html").write_text(_page(report, sections), encoding="utf-8")
    except OSError as error:
        raise DataError(f"{folder}: cannot write the report there ({error.strerror})") from None
    return sorted(path for path in folder.iterdir() if path.suffix in WRITTEN)


def write_empty(folder: Path, name: str, trouble: str) -> None:
    """Write the report of a trial that ended before anything was recorded."""
    sentence = html.verdict(f"Nothing was recorded: {trouble}.", good=False)
    page = html.document(name, f"{datetime.now():%Y-%m-%d %H:%M:%S}", [sentence])
    (folder / "report.html").write_text(page, encoding="utf-8")


def print_report(report: Report, console: Console | None = None) -> None:
    """Print the tables, the notes and the verdict; in a log or a pipe, wide enough for the tables."""
    console = console or Console(highlight=False, width=None if Console().is_terminal else 140)
    for recording, analysis in report.arms:
        table.print_tables(console, recording, analysis)
        if part := report.wearers.get(recording.name):
            console.print(marked(wearer_share.sentence(part, report.bag.source(recording.name))))
            console.print(marked(wearer_share.joint_sentence(part, recording.joint_names)))
    for note in report.notes:
        console.print(f"[yellow]Note:[/] {marked(note)}.")
    for problem in report.bag.problems:
        console.print(f"[red]Not reported:[/] {marked(problem)}.")
    for sentence in report.failures:
        console.print(f"[red]{marked(sentence)}.[/]")
    for arm, settings in report.settings.items():
        mode, support, wearer = settings.in_words
        source = report.bag.source(arm).value
        console.print(f"{marked(arm)}: {mode}, support {support}, wearer: {wearer}, source: {source}")
    text, good = report.verdict
    console.print(f"[{'green' if good else 'red'} bold]{marked(text)}[/]")


def _page(report: Report, sections: Sequence[str]) -> str:
    bag = report.bag
    length = max(float(recording.time[-1]) for recording in bag.recordings)
    events = [f"{table.shown(event.time, 1)} s  {event.text}" for event in _after_start(bag)]
    more = [f"and {len(events) - MAX_EVENTS} more"] if len(events) > MAX_EVENTS else []
    parameters = "\n".join(bag.parameters[node].rstrip() for node in sorted(bag.parameters))
    ending = [
        f"<footer><p>{' '.join(f'<b>{term}</b> {meaning}' for term, meaning in table.TERMS.items())}</p></footer>",
        html.bullets("Notes", [*bag.problems, *report.notes]),
        html.bullets("Markers, faults and changed parameters", events[:MAX_EVENTS] + more),
    ]
    if parameters:
        ending.append(f"<details><summary>Parameters at the start</summary><pre>{escape(parameters)}</pre></details>")
    text, good = report.verdict
    head = [html.source(STATEMENTS[report.source]), html.verdict(text, report.failures, good), *_conditions(report)]
    when = f"{report.start:%Y-%m-%d %H:%M:%S}, {length:.0f} s, {'/'.join(bag.path.parts[-2:])}"
    return html.document(report.title, when, [*head, *sections, *ending])


def _conditions(report: Report) -> Iterator[str]:
    """Yield the page's section on the conditions and the criteria."""
    session = report.bag.session
    given = {"Subject": session.subject, "Protocol": session.protocol, "Note": session.note}
    yield html.bullets("", [f"{name}: {text}" for name, text in given.items() if text])
    lines = [(arm, report.bag.source(arm).value, *words.in_words) for arm, words in report.settings.items()]
    yield html.table(("Arm", "Source", "Mode", "Support", "Wearer"), [((), [line]) for line in lines])
    recorder = f"Recorded by exo_gravity {session.version}." if session.version else ""
    yield f"<p>{escape(f'{_criteria_text(report.criteria)} {recorder}')}</p>"


def _criteria_text(criteria: HoldCriteria) -> str:
    """Say what "it held" means."""
    stray, after_push, rate, offset = np.degrees(
        (criteria.max_stray, criteria.max_stray_after_push, 60.0 * criteria.max_rate, criteria.max_offset)
    )
    rated = f"no joint drifts more than {rate:g} degrees per minute, " if math.isfinite(rate) else ""
    return (
        f"Criteria: within any 10 s of a hold no joint moves more than {stray:g} degrees, {after_push:g} after a push; "
        f"{rated}at the end of a hold the arm is still, and within {offset:g} degrees of where it was let go."
    )


def _after_start(bag: Bag) -> list[Event]:
    """Return markers and events in order, of those before an arm was carried only the last of each node."""
    began = min((recording.carried[0][0] for recording in bag.recordings if recording.carried), default=-math.inf)
    last = {event.status.node: event for event in bag.events if event.status and event.time < began}
    kept = [event for event in last.values() if event.status and event.status.level]
    changed = [event for event in bag.events if event.time >= began or event.setting]
    markers = [Event(event.time, f"marker: {event.text}") for event in bag.markers]
    return sorted((*kept, *changed, *markers), key=lambda event: event.time)
