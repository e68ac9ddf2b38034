"""What stands on top of a report: of whom and under what settings it was recorded, and the worst that happened."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from exo_gravity.bag.content import Bag, Event
from exo_gravity.core.compensation.guidance import CAUSE_TIME
from exo_gravity.core.compensation.settings import COMPENSATOR
from exo_gravity.core.trial.analysis import HoldCriteria, TrialAnalysis
from exo_gravity.core.trial.recording import Recording
from exo_gravity.core.trial.session import Session
from exo_gravity.tools.inputs.parameter_file import node_of, recorded_of
from exo_gravity.tools.reporting import html, table

EARLY = 0.2  # s; can_bridge publishes its state every 0.1 s, so a shorter gap to the script's end means nothing
NEAR = 1.0  # s between a let-down and the fault that caused it
LOAD = ("mode", "support", "wearer.", "payload.")  # beginnings of the parameters that change the load
MODES = {"one_g": "One-G", "zero_g": "Zero-G"}

Worst = tuple[bool, float, str]  # whether it is worse than a small drift; rad; a sentence


@dataclass(frozen=True)
class Conditions:
    """The compensator's settings in the recording of one arm: those at the start, {} if unknown, and their changes."""

    start: dict[str, Any]
    changes: tuple[tuple[float, str, Any], ...]  #: s, name, new value

    @classmethod
    def of(cls, bag: Bag, arm: str) -> "Conditions":
        """Return the conditions of the arm `arm`; a parameter that was not recorded has its default."""
        node = node_of(arm, "compensator")
        recorded = recorded_of(bag.parameters, node)
        start = {**{param.name: param.default for param in COMPENSATOR}, **recorded} if recorded else {}
        in_force, changes = dict(start), []
        for event in bag.events:
            of, name, value = event.setting or ("", "", None)
            if of == node and in_force.get(name) != value:  # what is set again to its value changes nothing
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
    def wearer(self) -> str:
        """The wearer whose arm Zero-G carries."""
        if any(self.start.get("wearer.mass", ())):
            return f"arm of {sum(self.start['wearer.mass']):.2f} kg"
        mass = self.start.get("wearer.body_mass", 0.0)
        return f"{mass:g} kg, {self.start['wearer.sex']}" if mass else "no data"


def columns(bag: Bag, conditions: Conditions, trial: str, arm: str) -> Callable[[float], dict[str, str]]:
    """Return a function from a time in s to the first columns of a row about the arm at that time."""

    def at(time: float) -> dict[str, str]:
        in_force = conditions.at(time)
        settings = {key: str(in_force.get(key, "")) for key in ("side", "mode", "support")}
        return {"trial": trial, "subject": bag.session.subject, "arm": arm, **settings, "version": bag.session.version}

    return at


def lines(conditions: Mapping[str, Conditions]) -> list[tuple[str, ...]]:
    """Return arm, mode, support and wearer of each arm, as text."""
    found: list[tuple[str, ...]] = []
    for arm, of_arm in conditions.items():
        mode = of_arm.history("mode", lambda mode: MODES.get(mode, mode))
        support = of_arm.history("support", lambda share: f"{100.0 * share:g} %")
        found.append((arm, mode, "none in One-G" if mode == "One-G" else support, of_arm.wearer))
    return found


def section(session: Session, conditions: Mapping[str, Conditions], criteria: HoldCriteria) -> Iterator[str]:
    """Yield the page's section on the conditions and the criteria."""
    given = {"Subject": session.subject, "Protocol": session.protocol, "Note": session.note}
    yield html.bullets("", [f"{name}: {text}" for name, text in given.items() if text])
    yield html.table(("Arm", "Mode", "Support", "Wearer"), [((), [line]) for line in lines(conditions)])
    recorder = f"Recorded by exo_gravity {session.version}." if session.version else ""
    yield html.paragraph(f"{criteria_text(criteria)} {recorder}")


def criteria_text(criteria: HoldCriteria) -> str:
    """Say what "it held" means."""
    stray, after_push, rate, offset = np.degrees(
        (criteria.max_stray, criteria.max_stray_after_push, 60.0 * criteria.max_rate, criteria.max_offset)
    )
    rated = f"no joint drifts more than {rate:g} degrees per minute, " if math.isfinite(rate) else ""
    return (
        f"Criteria: within any 10 s of a hold no joint moves more than {stray:g} degrees, {after_push:g} after a push; "
        f"{rated}at the end of a hold the arm is still, and within {offset:g} degrees of where it was let go."
    )


def worst(
    bag: Bag,
    arms: Iterable[tuple[Recording, TrialAnalysis]],
    conditions: Mapping[str, Conditions],
    criteria: HoldCriteria,
) -> tuple[str, bool]:
    """Return the worst event as a sentence, and whether it is worse than a small drift; ('', False) for none."""
    found = [
        event
        for recording, analysis in arms
        for event in (
            *_falls(bag.events, conditions[recording.name], recording, analysis, criteria),
            *_strays(recording, analysis, criteria),
        )
    ]
    bad, _, text = max(found, default=(False, 0.0, ""))
    return text, bad


def _falls(
    events: Iterable[Event],
    conditions: Conditions,
    recording: Recording,
    analysis: TrialAnalysis,
    criteria: HoldCriteria,
) -> Iterator[Worst]:
    """Yield each let-down that was not planned, and each motion that no step of the script explains."""
    time = recording.time
    spans, planned = recording.carried or (), recording.steps[-1].end - EARLY if recording.steps else time[-1] - EARLY
    for n, (_, end) in enumerate(spans):
        fault = fault_near(events, recording.name, end)
        again = spans[n + 1][0] if n + 1 < len(spans) else float(time[-1])
        within = (time >= end) & (time <= again)
        is_planned = end >= planned or (not recording.steps and n + 1 == len(spans))
        if end < time[-1] - EARLY and (fault or not is_planned):
            moved = recording.position[within] - recording.position[within][0]
            peak, speed = np.abs(moved).max(axis=0), np.abs(recording.velocity[within]).max(axis=0)
            what = f"let down at {end:.1f} s{f' ({fault})' if fault else ''}{conditions.change_before(end)}: "
            yield _event(recording, what, peak, speed, True)
    for motion in analysis.motions:
        change = conditions.change_before(motion.start)
        if motion.kind == "slip" or (motion.kind in ("push", "move") and not recording.steps and change):
            bad = bool(np.max(np.abs(motion.peak)) > criteria.max_stray)
            what = f"{'slipped' if recording.steps else 'moved'} at {motion.start:.1f} s{change}: "
            yield _event(recording, what, np.abs(motion.peak), motion.speed, bad)
    for release in analysis.releases:
        offset = np.abs(release.offset)
        if not release.still or (release.after != "push" and offset.max() > criteria.max_offset):
            how = "did not stay where it was let go" if release.still else "was still moving at the end of a hold"
            change = conditions.change_before(release.start)
            yield _event(recording, f"{how}, {release.start:.1f}-{release.end:.1f} s{change}: ", offset, None, True)


def _strays(recording: Recording, analysis: TrialAnalysis, criteria: HoldCriteria) -> Iterator[Worst]:
    for number, hold in enumerate(analysis.holds, 1):
        most = criteria.max_stray_after_push if hold.after == "push" else criteria.max_stray
        if hold.stray.max() > table.UNMOVED:
            bad = bool(hold.stray.max() > most)
            yield _event(recording, f"within 10 s of hold {number}, ", hold.stray, None, bad)
        else:
            code = math.degrees(np.max(hold.drift_rate_uncertainty) * hold.duration)
            size = f" ({code:.3f} degrees)" if math.isfinite(code) else ""
            yield False, 0.0, f"{recording.name}: no joint moved by one position code{size} in a hold"


def _event(recording: Recording, what: str, angle: np.ndarray, speed: np.ndarray | None, bad: bool) -> Worst:
    joint = int(np.argmax(angle))
    fast = "" if speed is None else f", at up to {table.shown(math.degrees(speed[joint]), 0)} deg/s"
    moved = f"{table.joint_labels(recording)[joint]} moved {table.shown(math.degrees(angle[joint]), 2)} degrees{fast}"
    return bad, float(angle[joint]), f"{recording.name}: {what}{moved}"


def fault_near(events: Iterable[Event], arm: str, time: float) -> str:
    """Return the fault that the arm's bridge reported at about `time` s, without its state, or ''."""
    reported = re.compile(rf"{re.escape(arm)}(?:/can_bridge)?: (?:letting down|fault): (.*)")
    found = (reported.match(event.text) for event in events if abs(event.time - time) <= NEAR)
    return next((match[1] for match in found if match), "")


def after_start(bag: Bag) -> list[Event]:
    """Return markers and events in order, of those before an arm was carried only the last of each node."""
    begins = [recording.carried[0][0] for recording in bag.recordings if recording.carried]
    began = min(begins, default=-math.inf)
    last = {event.text.partition(":")[0]: event for event in bag.events if event.time < began and not event.setting}
    kept = [event for event in last.values() if ": OK, " not in event.text]
    changed = [event for event in bag.events if event.time >= began or event.setting]
    markers = [Event(event.time, f"marker: {event.text}") for event in bag.markers]
    return sorted((*kept, *changed, *markers), key=lambda event: event.time)
