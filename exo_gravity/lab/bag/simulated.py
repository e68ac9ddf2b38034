# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated arms -> a rosbag2 recording with the same topics as one of `recorder`: for trials without ROS."""

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from exo_gravity.core.arm.interface import STANDARD_GRAVITY
from exo_gravity.core.arm.tilt import pitch_roll
from exo_gravity.core.safety.command import State
from exo_gravity.core.vocabulary import TEXT, Source
from exo_gravity.lab.bag import content
from exo_gravity.lab.bag.content import JOINT_STATE, STRING, Event
from exo_gravity.lab.bag.layout import TYPES
from exo_gravity.lab.bag.writer import BagWriter, Message, offered_qos
from exo_gravity.lab.trial.recording import Recording
from exo_gravity.lab.trial.session import Session
from exo_gravity.sim.virtual_arm import TrunkReading

STATUS = content.READ[content.DIAGNOSTICS]
Unsent = tuple[str, float, str, tuple[Any, ...]]  # topic, s, type, and the message's fields after its header, if any


def write_recordings(
    path: Path,
    arms: Sequence[Recording],
    events: Iterable[Event],
    parameters: Mapping[str, str],
    session: Session,
    trunk: Iterable[tuple[float, TrunkReading]] = (),
) -> None:
    """Write simulated arms to a new recording `path`, as `recorder` writes real ones; time 0 is now.

    events: what went wrong.
    parameters: YAML text by node.
    trunk: what its IMU reads, each with its time in s.

    Raises DataError if it cannot be written.
    """
    start = time.time_ns()
    messages: list[Unsent] = [
        *((content.PARAMETERS, 0.0, STRING, (text,)) for text in parameters.values()),
        (content.SESSION, 0.0, STRING, (json.dumps(asdict(session)),)),
        *(
            _status(event.time, s.level, s.node, s.message, **{"fault": s.fault, f"fault{TEXT}": s.fault_text})
            for event in events
            if (s := event.status)
        ),
        *(message for arm in arms for message in _of_arm(arm)),
        *(message for now, reading in trunk for message in _of_trunk(now, reading)),
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


def _of_trunk(now: float, reading: TrunkReading) -> Iterator[Unsent]:
    """Yield what the node `imu` publishes of a reading: tilt and, in the trunk's axes, what its sensor measures."""
    made: dict[str, Any] = TYPES.types
    vector, none = made["geometry_msgs/msg/Vector3"], np.zeros(9)
    pitch, roll = pitch_roll(reading.gravity)
    felt = reading.specific_force or [-STANDARD_GRAVITY * x for x in reading.gravity]
    turning, at_rest = vector(*map(float, reading.angular_velocity)), made["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    yield content.TILT_TOPIC, now, content.TILT_TYPE, (vector(roll, pitch, 0.0),)
    yield content.IMU, now, content.READ[content.IMU], (at_rest, none, turning, none, vector(*felt), none)


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
