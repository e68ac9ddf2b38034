# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The report of a recorded trial: analysis and verdict of each arm, printed, and written as CSV, figures and a page.

The verdict says whether each arm held, and leads with the worst that happened, under the settings in force.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from html import escape
from itertools import chain, compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape as marked

from exo_gravity.core.compensation.load_change import CAUSE_TIME
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.safety.command import FaultCode
from exo_gravity.core.safety.limits import limits_of
from exo_gravity.core.vocabulary import NONE, Source
from exo_gravity.lab.bag.content import BRIDGE, Bag, Event
from exo_gravity.lab.inputs.arms import recorded_of
from exo_gravity.lab.inputs.parameter_file import node_of
from exo_gravity.lab.observer import WearerPart, wearer_of, wearer_sentences
from exo_gravity.lab.report import html, table
from exo_gravity.lab.trial.analysis import MIN_HOLD, MOVED, HoldCriteria, Recording, TrialAnalysis
from exo_gravity.lab.trial.analysis import analyse as analyse_arm
from exo_gravity.lab.vocabulary import STATEMENTS, of_all

if TYPE_CHECKING:
    from exo_gravity.lab.report.figures import Part

EARLY = 0.2  # s; can_bridge publishes its state every 0.1 s, so a shorter gap to the script's end means nothing
NEAR = 1.0  # s between a let-down and the fault that caused it
ANY = -1.0  # rad: whatever the arm moved, it is too much
CARRIED = ("wearer.", "payload.")  # beginnings of the parameters of what an arm may carry
LOAD = ("mode", "support", *CARRIED)  # and of those that change the load
MODES = {"one_g": "One-G", "zero_g": "Zero-G"}
TIMESTAMP = re.compile(r"_\d{8}_\d{6}$")  # which `trial` adds to the script's name

MAX_EVENTS = 200
# On each figure, unless the arm is known to be real.
STAMPS = {Source.SIMULATED: "SIMULATED", Source.UNKNOWN: "source unknown", Source.REAL: ""}
CAPTIONS = {
    "overview": "Positions, velocities and torques over time. Holds are shaded and numbered; thin lines "
    "show the command, dotted ones the limits.",
    "drift": "Deviation of each joint from the start of each hold, and the drift of each hold with its uncertainty.",
    "wearer": "The wearer's torque at each joint, and their share of the torque that carries their arm, each with its "
    "95 % band. A band that reaches zero: not distinguishable from zero. See docs/wearer_torque.md.",
}

SCREEN = html.Print()
Found = tuple[bool, float, str]  # whether it is worse than a small drift; rad; a clause


@dataclass(frozen=True)
class Conditions:
    """The compensator's settings in the recording of one arm: those at the start, {} if unknown, and their changes."""

    start: dict[str, Any]
    changes: tuple[tuple[float, str, Any], ...]  #: s, name, new value

    @classmethod
    def of(cls, bag: Bag, arm: str) -> "Conditions":
        """Return the conditions of the arm `arm`."""
        start = recorded_of(bag.parameters, arm, "compensator")
        in_force, changes = dict(start), []
        for event in bag.events:
            of, name, value = event.setting or ("", "", None)
            if of == node_of(arm, "compensator") and in_force.get(name) != value:  # set again to its value: no change
                in_force[name] = value
                changes.append((event.time, name, value))
        return cls(start, tuple(changes))

    def at(self, time: float) -> dict[str, Any]:
        """Return the settings in force at `time` s."""
        return self.start | {name: value for at, name, value in self.changes if at <= time}

    def change_before(self, time: float) -> str:
        """Return the change of load that may have caused a motion at `time` s, as a clause, or ''."""
        near = [change for change in self.changes if 0.0 <= time + NEAR - change[0] <= CAUSE_TIME + NEAR]
        return next((f" after {name} = {value}" for _, name, value in near[::-1] if name.startswith(LOAD)), "")

    def history(self, name: str, shown: Callable[[Any], str]) -> str:
        """Return the values of a setting, each with the time from which it was in force; a dash if it is unknown."""
        values = [shown(self.start[name])] if name in self.start else ["–"]
        values += [f"{shown(value)} from {time:.1f} s" for time, changed, value in self.changes if changed == name]
        return ", ".join(values if len(values) < 6 else [values[0], f"{len(values) - 2} changes", values[-1]])

    @property
    def in_words(self) -> tuple[str, str, str]:
        """Mode, support, and the wearer whose arm Zero-G carries."""
        mode = self.history("mode", lambda mode: MODES.get(mode, mode))
        support = self.history("support", lambda share: f"{100.0 * share:g} %")
        body = self.history("wearer.body_mass", lambda mass: f"{mass:g} kg" if mass else "no data")
        last = self.at(math.inf)
        wearer = f"{body}, {last['wearer.sex']}" if last.get("wearer.body_mass") else body
        if any(last.get("wearer.mass", ())):
            wearer = self.history("wearer.mass", lambda mass: f"arm of {sum(mass):.2f} kg")
        return mode, "none in One-G" if mode == "One-G" else support, wearer


@dataclass(frozen=True)
class Report:
    """A recording, the analysis of each arm, and the verdict."""

    bag: Bag
    criteria: HoldCriteria
    arms: tuple[tuple[Recording, TrialAnalysis], ...]
    settings: dict[str, Conditions]  #: by the arm's name
    wearers: dict[str, WearerPart]  #: by the arm's name, where what the wearer did is known
    notes: tuple[str, ...]  #: what limits the trust in the verdict
    trouble: str = ""  #: why the trial ended before its script, or ''

    @cached_property
    def failures(self) -> list[str]:
        """One clause for each way in which an arm did not hold."""
        return [clause for arm in self.arms for is_bad, _, clause in _judged(self, *arm) if is_bad]

    @property
    def exit_code(self) -> int:
        """0: held. 1: did not hold. 2: some of the recording could not be read."""
        return 2 if self.bag.problems else int(bool(self.failures))

    @cached_property
    def verdict(self) -> tuple[str, bool]:
        """The first sentences of the report, and whether they are good news: a bad event comes first."""
        found = chain.from_iterable((*_judged(self, *arm), *_happened(self, *arm)) for arm in self.arms)
        bad, moved, event = max(found)
        held = "It held, as far as it was recorded." if self.bag.is_partial else "It held."
        if self.failures:
            held = f"It did not hold.{f' The trial ended early: {self.trouble}.' if self.trouble else ''}"
        elif self.bag.problems:
            held = "It held, as far as the recording could be read."
        elif self.trouble:
            held = f"It held until the trial ended early: {self.trouble}."
        first = f"{event[:1].upper()}{event[1:]}."
        if bad:
            return f"{first} {held if self.failures else held.replace('It ', 'Otherwise it ', 1)}", False
        return f"{held} {f'Worst: {event}.' if moved else first}", True

    @property
    def title(self) -> str:
        """Name of the trial, arms and date: 'demo, right arm, 2026-03-14'."""
        name = TIMESTAMP.sub("", self.bag.trial)
        sides = " and ".join(recording.name for recording in self.bag.recordings)
        arms = sides if sides == "arm" else f"{sides} arm{'s' if len(self.bag.recordings) > 1 else ''}"
        return f"{name.replace('_', ' ')}, {arms}, {self.start:%Y-%m-%d}"

    @property
    def start(self) -> datetime:
        """Start of the recording, local time."""
        return datetime.fromtimestamp(self.bag.start / 1e9, timezone.utc).astimezone()

    def row_head(self, arm: str, time: float) -> dict[str, str]:
        """Return the first columns of a row of the CSV files, about `arm` at `time` s."""
        in_force = self.settings[arm].at(time)
        if in_force.get("mode") == "one_g":  # it does not use the support
            in_force.pop("support", None)
        settings = {key: str(in_force.get(key, "")) for key in ("side", "mode", "support")}
        session, source = self.bag.session, self.bag.source(arm).value
        of_whom = {"trial": self.bag.trial, "subject": session.subject, "arm": arm, "source": source}
        return {**of_whom, **settings, "version": session.version}


def _judged(report: Report, recording: Recording, analysis: TrialAnalysis) -> Iterator[Found]:
    """Yield what decides whether the arm held, which it did unless something is bad: holds, slips and releases."""
    criteria, cause = report.criteria, report.settings[recording.name].change_before
    if not analysis.holds:
        never = "carried" if recording.carried == () else "still for long enough to count as a hold"
        yield True, 0.0, f"{recording.name}: the arm was never {never}"
    for number, hold in enumerate(analysis.holds, 1):
        if hold.stray.max() > table.UNMOVED:
            yield _found(recording, f"within 10 s of hold {number}, ", hold.stray, criteria.stray_allowed(hold))
        else:
            yield False, 0.0, f"{recording.name}: {table.unmoved(hold)}"
        if hold.duration >= criteria.rated_from and np.abs(hold.drift_rate).max() > criteria.max_rate:
            what, rate = f"by its drift in hold {number}, ", 60.0 * np.abs(hold.drift_rate)
            yield _found(recording, what, rate, 60.0 * criteria.max_rate, unit="degrees per minute")
    for motion in analysis.motions:
        if motion.kind in MOVED:
            what = f"{MOVED[motion.kind]} at {motion.start:.1f} s{cause(motion.start)}: "
            yield _found(recording, what, np.abs(motion.peak), criteria.max_stray, motion.speed)
    for release in analysis.releases:
        if not (release.still and criteria.stayed(release)):
            how = "did not stay where it was let go" if release.still else "was still moving at the end of a hold"
            what = f"{how}, {release.start:.1f}-{release.end:.1f} s{cause(release.start)}: "
            yield _found(recording, what, np.abs(release.offset), criteria.max_offset if release.still else ANY)


def _happened(report: Report, recording: Recording, analysis: TrialAnalysis) -> Iterator[Found]:
    """Yield each let-down that was not planned, and what moved after a change of load, without a script."""
    cause, steps, time = report.settings[recording.name].change_before, recording.steps, recording.time
    spans, planned = recording.carried or (), (steps[-1].end if steps else time[-1]) - EARLY
    for (_, end), (again, _) in zip(spans, (*spans[1:], (time[-1], 0.0)), strict=False):
        fault = _fault_near(report.bag, recording.name, end)
        is_planned = end >= planned or (not steps and end == spans[-1][1])
        if end < time[-1] - EARLY and (fault or not is_planned):
            first, beyond = np.searchsorted(time, (end, again), "right")
            within = slice(max(0, first - 1), beyond + 1)  # nothing may have been recorded in between
            moved = recording.position[within] - recording.position[within.start]
            peak, speed = np.abs(moved).max(axis=0), np.abs(recording.velocity[within]).max(axis=0)
            what = f"let down at {end:.1f} s{f' ({fault})' if fault else ''}{cause(end)}: "
            yield _found(recording, what, peak, ANY, speed)
    for motion in analysis.motions:
        if motion.kind in ("push", "move") and not steps and (change := cause(motion.start)):
            what = f"moved at {motion.start:.1f} s{change}: "
            yield _found(recording, what, np.abs(motion.peak), report.criteria.max_stray, motion.speed)


def _found(
    recording: Recording,
    what: str,
    angle: np.ndarray,
    most: float,
    speed: np.ndarray | None = None,
    unit: str = "degrees",
) -> Found:
    """Return what happened, with the joint that moved most. most: rad that are allowed."""
    joint = int(np.argmax(angle))
    fast = "" if speed is None else f", at up to {table.shown(math.degrees(speed[joint]), 0)} deg/s"
    limit = f", more than {table.shown(math.degrees(most), 2)}" if angle[joint] > most > ANY else ""
    moved = f"{table.joint_labels(recording)[joint]} moved {table.shown(math.degrees(angle[joint]), 2)} {unit}"
    return bool(angle[joint] > most), float(angle[joint]), f"{recording.name}: {what}{moved}{limit}{fast}"


def _fault_near(bag: Bag, arm: str, time: float) -> str:
    """Return code and text of the fault that the arm's bridge reported at about `time` s, or ''."""
    bridge = node_of(arm, BRIDGE).lstrip("/")
    near = (event.status for event in bag.events if event.status and abs(event.time - time) <= NEAR)
    fault = next((status for status in near if status.node == bridge and status.fault != NONE), None)
    if fault is None:
        return ""
    meaning = next((code.meaning for code in FaultCode if code == fault.fault), "a fault")
    return f"{fault.fault}: {fault.fault_text or meaning}"  # some recordings lack the fault's text


def analyse(bag: Bag, criteria: HoldCriteria | None = None, min_hold: float = MIN_HOLD, trouble: str = "") -> Report:
    """Return the report of a recording: holds of at least `min_hold` s, judged by `criteria`.

    trouble: why the trial ended early, or ''.
    """
    arms = tuple((recording, analyse_arm(recording, min_hold)) for recording in bag.recordings)
    settings = {recording.name: Conditions.of(bag, recording.name) for recording in bag.recordings}
    wearers, notes = {}, [*bag.notes, *_reservations(bag)]
    for recording in bag.recordings:
        try:
            if part := wearer_of(bag, recording):
                for time, changed, _ in settings[recording.name].changes:
                    if changed.startswith(CARRIED):  # the model is that of the start
                        raise DataError(f"{changed} was changed at {time:.1f} s")
                wearers[recording.name] = part
        except (DataError, ParameterError) as error:
            notes.append(f"{recording.name}: the wearer's torque is not known: {error}")
    return Report(bag, criteria or HoldCriteria(), arms, settings, wearers, tuple(notes), trouble)


def _reservations(bag: Bag) -> Iterator[str]:
    """Yield what is missing, and what the report does instead."""
    for recording in bag.recordings:
        name = recording.name
        if not recording.steps:
            yield f"{name}: no step of a script was recorded: every still phase is taken for a hold"
        if recording.carried is None:
            yield f"{name}: the recording does not show when the arm was carried: its way down may be taken for a slip"
        moved = np.ptp(recording.position, axis=0) > table.UNMOVED
        if not moved.all():
            still = ", ".join(compress(table.joint_labels(recording), ~moved))
            yield f"{name}: {still} read one position throughout, so what drift would show is not known"
        if recording.steps and recording.carried and recording.steps[-1].end > recording.carried[-1][1] + EARLY:
            end = recording.carried[-1][1]
            what = "the recording ends" if end >= float(recording.time[-1]) else "let down"
            yield f"{name}: {what} at {end:.1f} s, before the script ended: only the time before is judged"


def write(
    report: Report,
    folder: str | Path,
    on_paper: html.Print = SCREEN,
    part: "Part | None" = None,
) -> list[Path]:
    """Write holds.csv, motions.csv, a PNG of each figure, report.html and report.json into `folder`; return the files.

    on_paper: how each figure is written beside its PNG. part: what the overview shows.

    Raises DataError if the folder can't be written, ParameterError if a recording has no such part.
    """
    from exo_gravity.lab.report import figures  # not for the rows of many recordings: half of a process's start

    folder = Path(folder)
    sections, written = list[str](), [folder / "report.html", folder / "report.json"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for kind in table.KINDS:
            written += table.write_csv(folder, kind, report.arms, report.row_head)
        for recording, analysis in report.arms:
            source = report.bag.source(recording.name)
            limits = None
            with suppress(DataError, ParameterError):  # they may not be such that this version permits
                if values := recorded_of(report.bag.parameters, recording.name, BRIDGE):
                    limits = limits_of(values)
            drawn = {"overview": figures.overview(recording, analysis, part, limits)}
            if any(figures.strayed(analysis)):
                drawn["drift"] = figures.drift(recording, analysis, report.criteria)
            if shared := report.wearers.get(recording.name):
                drawn["wearer"] = figures.wearer(recording, shared)
            pictures, stem = [], recording.name.replace("/", "_")
            for name, caption in CAPTIONS.items():
                path = folder / f"{stem}_{name}.png"
                path.unlink(missing_ok=True)  # of an earlier report
                if name in drawn:
                    written += [path, *(path.with_suffix(f".{suffix}") for suffix in on_paper.formats)]
                    png = html.saved(drawn[name], path, STAMPS[source], on_paper)
                    pictures.append(html.picture(png, caption))
            if text := figures.stayed_text(recording, analysis):
                pictures.append(html.bullets("", [text]))
            if shared:
                said = wearer_sentences(shared, source, recording.joint_names)
                pictures.append(html.bullets("Wearer", said))
            sections += table.arm_section(recording, analysis, pictures)
        (folder / "report.html").write_text(_page(report, sections), encoding="utf-8")
        seconds = max(float(recording.time[-1]) for recording in report.bag.recordings)
        told = {"verdict": report.verdict[0], "protocol": report.bag.session.protocol, "seconds": seconds}
        (folder / "report.json").write_text(json.dumps(told), encoding="utf-8")
    except OSError as error:
        raise DataError(f"{folder}: cannot write the report there ({error.strerror})") from None
    return sorted(written)


def print_report(report: Report, console: Console | None = None) -> None:
    """Print the tables, the notes and the verdict; in a log or a pipe, wide enough for the tables."""
    console = console or Console(highlight=False, width=None if Console().is_terminal else 140)
    for recording, analysis in report.arms:
        table.print_tables(console, recording, analysis)
        if part := report.wearers.get(recording.name):
            for sentence in wearer_sentences(part, report.bag.source(recording.name), recording.joint_names):
                console.print(marked(sentence))
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
    head = [
        f'<p class="source">{STATEMENTS[of_all(bag.source(recording.name) for recording in bag.recordings)]}</p>',
        html.verdict(text, report.failures, good),
        *_conditions(report),
    ]
    when = f"{report.start:%Y-%m-%d %H:%M:%S}, {length:.0f} s, {'/'.join(bag.path.parts[-2:])}"
    return html.document(report.title, when, [*head, *sections, *ending])


def _conditions(report: Report) -> Iterator[str]:
    """Yield the page's section on the conditions and the criteria."""
    session = report.bag.session
    given = {"Subject": session.subject, "Protocol": session.protocol, "Note": session.note}
    yield html.bullets("", [f"{name}: {text}" for name, text in given.items() if text])
    lines = [(arm, report.bag.source(arm).value, *words.in_words) for arm, words in report.settings.items()]
    yield html.table(("Arm", "Source", "Mode", "Support", "Wearer"), [((), [line]) for line in lines])
    criteria = report.criteria
    stray, after_push, rate, offset = np.degrees(
        (criteria.max_stray, criteria.max_stray_after_push, 60.0 * criteria.max_rate, criteria.max_offset)
    )
    rated = f"no joint drifts more than {rate:g} degrees per minute, " if math.isfinite(rate) else ""
    held = (
        f"Criteria: within any 10 s of a hold no joint moves more than {stray:g} degrees, {after_push:g} after a push; "
        f"{rated}at the end of a hold the arm is still, and within {offset:g} degrees of where it was let go."
    )
    recorder = f"Recorded by exo_gravity {session.version}." if session.version else ""
    yield f"<p>{escape(f'{held} {recorder}')}</p>"


def _after_start(bag: Bag) -> list[Event]:
    """Return markers and events in order, of those before an arm was carried only the last of each node."""
    began = min((recording.carried[0][0] for recording in bag.recordings if recording.carried), default=-math.inf)
    last = {event.status.node: event for event in bag.events if event.status and event.time < began}
    kept = [event for event in last.values() if event.status and event.status.level]
    changed = [event for event in bag.events if event.time >= began or event.setting]
    markers = [Event(event.time, f"marker: {event.text}") for event in bag.markers]
    return sorted((*kept, *changed, *markers), key=lambda event: event.time)
