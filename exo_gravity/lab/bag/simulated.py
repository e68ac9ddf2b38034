# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated arms -> a rosbag2 recording with the same topics as one of `recorder`: for trials without ROS."""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.safety.drive import State
from exo_gravity.core.vocabulary import TEXT, Source
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.content import JOINT_STATE, STRING, Event, NodeStatus
from exo_gravity.lab.bag.layout import TYPES
from exo_gravity.lab.bag.writer import BagWriter, Message, offered_qos
from exo_gravity.lab.trial.recording import Recording
from exo_gravity.lab.trial.session import Session

STATUS = content.READ[content.DIAGNOSTICS]
Unsent = tuple[str, float, str, tuple[Any, ...]]  # topic, s, type, and the message's fields after its header, if any


def write_recordings(
    path: Path, arms: Sequence[Recording], events: Iterable[Event], parameters: Mapping[str, str], session: Session
) -> None:
    """Write simulated arms to a new recording `path`, as `recorder` writes real ones; time 0 is now.

    events: what went wrong.
    parameters: YAML text by node.

    Raises DataError if it cannot be written.
    """
    start = time.time_ns()
    messages: list[Unsent] = [
        *((content.PARAMETERS, 0.0, STRING, (text,)) for text in parameters.values()),
        (content.SESSION, 0.0, STRING, (json.dumps(asdict(session)),)),
        *(_of_event(event.time, event.status) for event in events if event.status),
        *(message for arm in arms for message in _of_arm(arm)),
    ]
    messages.sort(key=lambda message: message[1])
    writer = BagWriter(path)
    for topic, kind in {topic: kind for topic, _, kind, _ in messages}.items():
        writer.add_topic(topic, kind, offered_qos(True, topic in (content.PARAMETERS, content.SESSION), 1))
    writer.write([_serialised(start, *message) for message in messages])
    writer.close()
    if writer.error:
        raise writer.error


def _of_arm(arm: Recording) -> Iterator[Unsent]:
    """Yield the states of an arm and its bridge, the commands, and the steps of the script."""
    carried = [(now, State.ACTIVE) for span in arm.carried or () for now in span]
    for now, state in (*carried, (float(arm.time[-1]), State.DISABLED)):
        yield _status(now, 0, f"{arm.name}/can_bridge", state.value, state=state.value, source=Source.SIMULATED.value)
    for index, step in enumerate(arm.steps):
        text = json.dumps({"step": index, "action": step.action, "duration": step.end - step.start})
        yield f"/{arm.name}/{content.STEPS}", step.start, STRING, (text,)
    names, none, last = list(arm.joint_names), np.empty(0), float(arm.time[0])
    measured = (np.asarray(column, float) for column in (arm.position, arm.velocity, arm.effort, arm.command))
    for now, position, velocity, effort, command in zip(arm.time.tolist(), *measured, strict=True):
        if now > last:  # the command in force answers the joint state before
            wanted = none if np.isnan(command).any() else command
            yield f"/{arm.name}/{content.COMMANDS}", last, JOINT_STATE, (names, none, none, wanted)
        yield f"/{arm.name}/{content.STATES}", now, JOINT_STATE, (names, position, velocity, effort)
        last = now


def _of_event(now: float, status: NodeStatus) -> Unsent:
    """Return the message of a status, as a node sends it."""
    fault = {"fault": status.fault, f"fault{TEXT}": status.fault_text}
    return _status(now, status.level, status.node, status.message, **fault)


def _status(now: float, level: int, name: str, text: str, **values: str) -> Unsent:
    """Return the status of a node at `now` s."""
    pairs = [TYPES.types["diagnostic_msgs/msg/KeyValue"](*pair) for pair in values.items()]
    status = TYPES.types["diagnostic_msgs/msg/DiagnosticStatus"](level, name, text, "", pairs)
    return content.DIAGNOSTICS, now, STATUS, ([status],)


def _serialised(start: int, topic: str, now: float, kind: str, fields: tuple[Any, ...]) -> Message:
    """Return a message of `now` s with its header. start: ns since 1970, of time 0."""
    made: dict[str, Any] = TYPES.types
    at = start + round(now * 1e9)
    if kind != STRING:
        stamp = made["builtin_interfaces/msg/Time"](*divmod(at, 10**9))
        fields = (made["std_msgs/msg/Header"](stamp, ""), *fields)
    return topic, at, bytes(TYPES.serialize_cdr(made[kind](*fields), kind))
