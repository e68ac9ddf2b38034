# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The verdict of a report: under what settings each arm was recorded, whether it held, and the worst that happened."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from typing import Any

import numpy as np

from exo_gravity.core.compensation.guidance import CAUSE_TIME
from exo_gravity.core.safety.drive import FaultCode
from exo_gravity.core.vocabulary import NONE, Source
from exo_gravity.lab.bag.content import BRIDGE, Bag
from exo_gravity.lab.inputs.arms import recorded_of
from exo_gravity.lab.inputs.parameter_file import node_of
from exo_gravity.lab.report import table
from exo_gravity.lab.report.wearer_share import WearerPart
from exo_gravity.lab.source import of_all
from exo_gravity.lab.trial.analysis import Hold, HoldCriteria, TrialAnalysis, failures
from exo_gravity.lab.trial.recording import Recording

EARLY = 0.2  # s; can_bridge publishes its state every 0.1 s, so a shorter gap to the script's end means nothing
NEAR = 1.0  # s between a let-down and the fault that caused it
LOAD = ("mode", "support", "wearer.", "payload.")  # beginnings of the parameters that change the load
MODES = {"one_g": "One-G", "zero_g": "Zero-G"}
TIMESTAMP = re.compile(r"_\d{8}_\d{6}$")  # which `trial` adds to the script's name

Worst = tuple[bool, float, str]  # whether it is worse than a small drift; rad; a sentence


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
        mass, body_mass = sum(self.start.get("wearer.mass", ())), self.start.get("wearer.body_mass", 0.0)
        body = f"{body_mass:g} kg, {self.start['wearer.sex']}" if body_mass else "no data"
        wearer = f"arm of {mass:.2f} kg" if mass else body
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
        """One sentence for each way in which an arm did not hold."""
        return [sentence for arm in self.arms for sentence in failures(*arm, self.criteria)]

    @property
    def exit_code(self) -> int:
        """0: held. 1: did not hold. 2: some of the recording could not be read."""
        return 2 if self.bag.problems else int(bool(self.failures))

    @property
    def held(self) -> str:
        """The verdict on arms that held, which covers no more than was recorded."""
        if self.bag.problems:
            return "It held, as far as the recording could be read."
        if self.trouble:
            return f"It held until the trial ended early: {self.trouble}."
        return "It held, as far as it was recorded." if self.bag.is_partial else "It held."

    @cached_property
    def verdict(self) -> tuple[str, bool]:
        """The first sentences of the report, and whether they are good news: a bad event comes first."""
        events = [event for arm in self.arms for event in (*_falls(self, *arm), *_strays(self, *arm))]
        bad, moved, event = max(events, default=(False, 0.0, ""))
        early = f" The trial ended early: {self.trouble}." if self.trouble else ""
        held = f"It did not hold.{early}" if self.failures else self.held
        otherwise = held if self.failures else f"Otherwise it {held.removeprefix('It ')}"
        first = f"{event[:1].upper()}{event[1:]}."
        if bad:
            text = f"{first} {otherwise}"
        elif event:
            text = f"{held} Worst: {event}." if moved else f"{held} {first}"
        else:
            text = held
        return text, not (bad or self.failures)

    @property
    def source(self) -> Source:
        """Where the numbers of all arms together come from."""
        return of_all(self.bag.source(recording.name) for recording in self.bag.recordings)

    @property
    def trial(self) -> str:
        """The name of the trial's folder: `trial` records into NAME_DATE_TIME/bag."""
        path = self.bag.path.resolve()
        return path.parent.name if path.stem == "bag" else path.stem

    @property
    def title(self) -> str:
        """Name of the trial, arms and date: 'demo, right arm, 2026-03-14'."""
        name = TIMESTAMP.sub("", self.trial)
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
        of_whom = {"trial": self.trial, "subject": session.subject, "arm": arm, "source": source}
        return {**of_whom, **settings, "version": session.version}


def _falls(report: Report, recording: Recording, analysis: TrialAnalysis) -> Iterator[Worst]:
    """Yield each let-down that was not planned, and each motion that no step of the script explains."""
    conditions, steps, time = report.settings[recording.name], recording.steps, recording.time
    spans, planned = recording.carried or (), (steps[-1].end if steps else time[-1]) - EARLY
    for (_, end), (again, _) in zip(spans, (*spans[1:], (time[-1], 0.0)), strict=False):
        fault = _fault_near(report.bag, recording.name, end)
        is_planned = end >= planned or (not steps and end == spans[-1][1])
        if end < time[-1] - EARLY and (fault or not is_planned):
            within = (time >= end) & (time <= again)
            moved = recording.position[within] - recording.position[within][0]
            peak, speed = np.abs(moved).max(axis=0), np.abs(recording.velocity[within]).max(axis=0)
            what = f"let down at {end:.1f} s{f' ({fault})' if fault else ''}{conditions.change_before(end)}: "
            yield _event(recording, what, peak, True, speed)
    for motion in analysis.motions:
        change = conditions.change_before(motion.start)
        if motion.kind == "slip" or (motion.kind in ("push", "move") and not steps and change):
            bad = bool(np.max(np.abs(motion.peak)) > report.criteria.max_stray)
            what = f"{'slipped' if steps else 'moved'} at {motion.start:.1f} s{change}: "
            yield _event(recording, what, np.abs(motion.peak), bad, motion.speed)
    for release in analysis.releases:
        if not (release.still and report.criteria.stayed(release)):
            how = "did not stay where it was let go" if release.still else "was still moving at the end of a hold"
            what = f"{how}, {release.start:.1f}-{release.end:.1f} s{conditions.change_before(release.start)}: "
            yield _event(recording, what, np.abs(release.offset), True)


def _strays(report: Report, recording: Recording, analysis: TrialAnalysis) -> Iterator[Worst]:
    for number, hold in enumerate(analysis.holds, 1):
        if hold.stray.max() > table.UNMOVED:
            bad = bool(hold.stray.max() > report.criteria.stray_allowed(hold))
            yield _event(recording, f"within 10 s of hold {number}, ", hold.stray, bad)
        else:
            yield False, 0.0, f"{recording.name}: {unmoved(hold)}"


def unmoved(hold: Hold) -> str:
    """Say that no joint moved in a hold, and below what angle a motion would not show: one position code."""
    code = math.degrees(np.max(hold.drift_rate_uncertainty) * hold.duration)
    return "no measurable movement" + (f" (below {code:.3f} degrees)" if math.isfinite(code) else "")


def _event(recording: Recording, what: str, angle: np.ndarray, bad: bool, speed: np.ndarray | None = None) -> Worst:
    joint = int(np.argmax(angle))
    fast = "" if speed is None else f", at up to {table.shown(math.degrees(speed[joint]), 0)} deg/s"
    moved = f"{table.joint_labels(recording)[joint]} moved {table.shown(math.degrees(angle[joint]), 2)} degrees{fast}"
    return bad, float(angle[joint]), f"{recording.name}: {what}{moved}"


def _fault_near(bag: Bag, arm: str, time: float) -> str:
    """Return code and text of the fault that the arm's bridge reported at about `time` s, or ''."""
    bridge = node_of(arm, BRIDGE).lstrip("/")
    near = (event.status for event in bag.events if event.status and abs(event.time - time) <= NEAR)
    fault = next((status for status in near if status.node == bridge and status.fault != NONE), None)
    if fault is None:
        return ""
    meanings = {code.value: code.meaning for code in FaultCode}  # for recordings without the fault's text
    return f"{fault.fault}: {fault.fault_text or meanings.get(fault.fault, 'a fault')}"
