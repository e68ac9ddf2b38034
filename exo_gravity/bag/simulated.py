"""Simulated arms -> a rosbag2 recording with the same topics as one of `recorder`: for trials without ROS."""

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.bag import content
from exo_gravity.bag.content import COMMANDS, JOINT_STATE, PARAMETERS, SESSION, STATES, STEPS, STRING, Event
from exo_gravity.bag.joints import TYPES
from exo_gravity.bag.writer import BagWriter, Message, offered_qos
from exo_gravity.core.safety.drive import State
from exo_gravity.core.trial.recording import Recording
from exo_gravity.core.trial.session import Session


class _Simulated:
    """Messages of simulated arms. start: ns since 1970, of their time 0."""

    def __init__(self, start: int) -> None:
        self._start = start
        self._made: dict[str, Any] = TYPES.types
        self._messages: list[tuple[str, float, str, object]] = []  # topic, s, type, message

    def add_text(self, topic: str, now: float, text: str) -> None:
        """Add a text at `now` s."""
        self._messages.append((topic, now, STRING, self._made[STRING](text)))

    def add_status(self, now: float, level: int, name: str, text: str, **values: str) -> None:
        """Add the status of a node at `now` s."""
        made = self._made
        pairs = [made["diagnostic_msgs/msg/KeyValue"](*pair) for pair in values.items()]
        status = made["diagnostic_msgs/msg/DiagnosticStatus"](level, name, text, "", pairs)
        kind = content.READ[content.DIAGNOSTICS]
        self._messages.append((content.DIAGNOSTICS, now, kind, made[kind](self._header(now), [status])))

    def add_arm(self, arm: Recording) -> None:
        """Add the states of an arm and its bridge, the commands, and the steps of the script."""
        for begin, end in arm.carried or ():
            for now in (begin, end):
                self._add_state(arm, now, State.ACTIVE)
        self._add_state(arm, float(arm.time[-1]), State.DISABLED)
        for index, step in enumerate(arm.steps):
            text = json.dumps({"step": index, "action": step.action, "duration": step.end - step.start})
            self.add_text(f"/{arm.name}/{STEPS}", step.start, text)
        measured = (np.asarray(column, float) for column in (arm.position, arm.velocity, arm.effort, arm.command))
        last, none = float(arm.time[0]), np.empty(0)
        for now, position, velocity, effort, command in zip(arm.time.tolist(), *measured, strict=True):
            if now > last:  # the command in force answers the joint state before
                self._add_joints(arm, COMMANDS, last, none, none, none if np.isnan(command).any() else command)
            self._add_joints(arm, STATES, now, position, velocity, effort)
            last = now

    def topics(self) -> dict[str, str]:
        """Return the type of each topic."""
        return {topic: kind for topic, _, kind, _ in self._messages}

    def serialised(self) -> list[Message]:
        """Return all messages in the order of their times."""
        self._messages.sort(key=lambda message: message[1])
        serialise = TYPES.serialize_cdr
        return [(topic, self._at(now), bytes(serialise(message, kind))) for topic, now, kind, message in self._messages]

    def _add_state(self, arm: Recording, now: float, state: State) -> None:
        self.add_status(now, 0, f"{arm.name}/can_bridge", state.value, state=state.value)

    def _add_joints(self, arm: Recording, topic: str, now: float, *values: np.ndarray) -> None:
        message = self._made[JOINT_STATE](self._header(now), list(arm.joint_names), *values)
        self._messages.append((f"/{arm.name}/{topic}", now, JOINT_STATE, message))

    def _header(self, now: float) -> object:
        time_of = self._made["builtin_interfaces/msg/Time"](*divmod(self._at(now), 10**9))
        return self._made["std_msgs/msg/Header"](time_of, "")

    def _at(self, now: float) -> int:
        return self._start + round(now * 1e9)


def write_recordings(
    path: Path,
    recordings: Sequence[Recording],
    events: Iterable[Event],
    parameters: Mapping[str, str],
    session: Session,
) -> None:
    """Write simulated arms to a new recording `path`, as `recorder` writes real ones; time 0 is now.

    events: what went wrong. parameters: YAML text by node. Raises DataError if it cannot be written.
    """
    simulated = _Simulated(time.time_ns())
    for text in parameters.values():
        simulated.add_text(PARAMETERS, 0.0, text)
    simulated.add_text(SESSION, 0.0, json.dumps(asdict(session)))
    for now, text, _ in events:
        name, _, what = text.partition(": ")
        simulated.add_status(now, 1, name, what)
    for arm in recordings:
        simulated.add_arm(arm)
    writer = BagWriter(path)
    for topic, kind in simulated.topics().items():
        writer.add_topic(topic, kind, offered_qos(True, topic in (PARAMETERS, SESSION), 1))
    writer.write(simulated.serialised())
    writer.close()
    if writer.error:
        raise writer.error
