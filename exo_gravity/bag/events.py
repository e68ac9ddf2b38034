"""The rare topics of a recording, decoded message by message: script steps, diagnostics and parameters.

Whether an arm was carried comes from the key `state` of its can_bridge on /diagnostics, never from the text.
"""

from __future__ import annotations

import json
from itertools import groupby
from typing import Any

from exo_gravity.bag.content import Event
from exo_gravity.bag.topics import DIAGNOSTICS, LOSSES, PARAMETER_EVENTS, STEPS, arm_of, leaf
from exo_gravity.core.errors import DataError
from exo_gravity.core.safety.drive import State
from exo_gravity.core.trial.recording import ScriptedStep, Span

CARRIED = (State.RAMPING_IN.value, State.ACTIVE.value)
STATE_GAP = 1.0  # s; can_bridge reports its state twice a second, except while it ends


class EventLog:
    """Collects script steps, faults, changed parameters, the parameters at the start, and what the recorder lost."""

    def __init__(self) -> None:
        self.parameters: dict[str, str] = {}
        self.losses = ""
        self._events: list[tuple[int, str]] = []
        self._steps: dict[str, list[tuple[int, str, float]]] = {}  # arm -> (stamp, action, duration)
        self._states: dict[str, list[tuple[int, str]]] = {}  # arm -> (stamp, state)
        self._last: dict[str, tuple[int, str]] = {}  # node -> level and text of its last status

    def add(self, topic: str, stamp: int, message: Any) -> None:
        """Add one decoded message that arrived at `stamp` ns. Raises DataError for an invalid step."""
        if leaf(topic) == STEPS:
            self._add_step(topic, stamp, message.data)
        elif topic == DIAGNOSTICS:
            for status in message.status:
                self._add_status(stamp, status)
        elif topic == PARAMETER_EVENTS:
            for parameter in message.changed_parameters:
                self._events.append((stamp, f"{message.node}: {parameter.name} = {_value(parameter.value)}"))
        elif topic == LOSSES:
            self.losses = message.data
        else:
            node, _, text = message.data.partition(":")
            self.parameters[node.strip()] = f"{node}:{text}"

    def _add_step(self, topic: str, stamp: int, text: str) -> None:
        try:
            step = json.loads(text)
            entry = stamp, str(step["action"]), float(step["duration"])
        except (ValueError, KeyError, TypeError):
            raise DataError(f"{topic}: invalid {STEPS} message") from None
        self._steps.setdefault(arm_of(topic), []).append(entry)

    def _add_status(self, stamp: int, status: Any) -> None:
        level = int(status.level)
        last = self._last.get(status.name, (0, ""))
        if level > 0 and (level, status.message) != last:
            self._events.append((stamp, f"{status.name}: {status.message}"))
        elif level == 0 and last[0] > 0:
            self._events.append((stamp, f"{status.name}: OK, {status.message}"))
        self._last[status.name] = (level, status.message)
        state = next((entry.value for entry in status.values if entry.key == "state"), "")
        if state:
            self._states.setdefault(arm_of(status.name), []).append((stamp, state))

    def events(self, start: int) -> tuple[Event, ...]:
        """Return faults, warnings and changed parameters in order; start: ns of time 0."""
        return tuple(Event((stamp - start) / 1e9, text) for stamp, text in sorted(self._events))

    def steps(self, arm: str, start: int) -> tuple[ScriptedStep, ...]:
        """Return the script steps of an arm; each ends when the next one begins, at the latest."""
        steps = [((stamp - start) / 1e9, action, duration) for stamp, action, duration in self._steps.get(arm, [])]
        ends = [*(begin for begin, _, _ in steps[1:]), float("inf")]
        return tuple(
            ScriptedStep(action, begin, min(begin + duration, end))
            for (begin, action, duration), end in zip(steps, ends, strict=False)
        )

    def carried(self, arm: str, start: int, end: float) -> tuple[Span, ...] | None:
        """Return when the arm was carried, by its reported states; None if no state of it was recorded.

        end: s, of the arm's recording. An arm that is carried in the last state before it counts as carried until then.
        """
        if arm not in self._states:
            return None
        states = self._in_order(arm, start)
        groups = [list(group) for carried, group in groupby(states, lambda state: state[1] in CARRIED) if carried]
        spans = [(group[0][0], group[-1][0]) for group in groups]
        time, last = states[-1]
        if last in CARRIED and 0.0 < end - time < STATE_GAP:
            spans[-1] = spans[-1][0], end
        return tuple(spans)

    def open_end(self, arm: str, start: int, end: float, is_cut: bool) -> str:
        """Return what the recording does not show of the arm's way down, as a sentence, or ''.

        end: s, of the arm's recording. is_cut: whether its file was cut short.
        """
        time, last = self._in_order(arm, start)[-1] if arm in self._states else (0.0, "")
        if end - time >= STATE_GAP and not is_cut:
            return ""  # the joint states go on: they show the way down
        if last in CARRIED:
            return f"{arm}: the recording ends while the arm is carried: it does not show how the arm was let down"
        if last == State.LETTING_DOWN.value:
            return f"{arm}: the recording ends before the arm was down"
        return ""

    def _in_order(self, arm: str, start: int) -> list[tuple[float, str]]:
        return sorted(((stamp - start) / 1e9, state) for stamp, state in self._states[arm])


def _value(value: Any) -> object:
    """Return the Python value of a rcl_interfaces/ParameterValue."""
    fields = ("", "bool", "integer", "double", "string", "byte_array", "bool_array", "integer_array", "double_array")
    if not 0 < value.type < len(fields):
        return list(value.string_array_value) if value.type == len(fields) else "not set"
    found = getattr(value, f"{fields[value.type]}_value")
    return found.tolist() if hasattr(found, "tolist") else found
