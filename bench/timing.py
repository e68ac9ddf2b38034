# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The timing of a loop from the frames on its bus: latency from reply to torque, cycle spacing, missed cycles.

The content of a command shows which replies it answers. The arm moves to and fro, so that its angles change by a few
position codes each cycle. The angles of a cycle determine, by the law under test, the torques that answer it, and with
the damping of a command its frame, bit for bit: while the arm is carried within its limits on an upright trunk, the
loop changes no torque.
An answer that equals one of the last cycles' is left out: the arm turned too little to distinguish them. Every other
answer is searched in the later cycles; where a newer answer overtook it, that one counts. The latency of each motor
runs from its reply to its command.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from exo_gravity.core.motors.frames import is_special
from exo_gravity.core.motors.joint_motor import JointMotor

DISTINCT = 8  # cycles before, from whose answers an answer must differ
GIVE_UP = 0.1  # s after which an answer is treated as lost

Law = Callable[[Sequence[float]], Sequence[float]]
Answer = tuple[bytes, ...]  # the command frames to all motors
Commands = Callable[[Sequence[float]], Answer]  # damping of each joint in Nm s/rad -> the commands with it


@dataclass(frozen=True)
class LoopTiming:
    """The timing of one arm's loop.

    latency: s, of each answer and motor. spacing: s, between the starts of consecutive cycles. cycles: the number that
    was due. missed: cycles that never came. late: cycles that came half a period late or more; the loop may have caught
    up by the next one. incomplete: cycles without a reply from every motor. lost: answers that never came.
    """

    latency: np.ndarray
    spacing: np.ndarray
    cycles: int
    missed: int
    late: int
    incomplete: int
    lost: int


@dataclass(frozen=True)
class Cycle:
    """Commands and replies from one command to the first motor until the next; by joint: (time, bytes)."""

    commands: dict[int, tuple[float, bytes]] = field(default_factory=dict)
    replies: dict[int, tuple[float, bytes]] = field(default_factory=dict)


def split_cycles(frames: dict[str, np.ndarray], motors: Sequence[JointMotor], begin: float, end: float) -> list[Cycle]:
    """Return the cycles between two times (s)."""
    commanded = {motor.command_id: joint for joint, motor in enumerate(motors)}
    replying = {motor.reply_id: joint for joint, motor in enumerate(motors)}
    inside = (frames["time"] >= begin) & (frames["time"] < end)
    order = np.flatnonzero(inside)[np.argsort(frames["time"][inside], kind="stable")]
    cycles: list[Cycle] = []
    for i in order:
        own = int(frames["id"][i])
        joint = commanded.get(own, replying.get(own))
        data = frames["data"][i, : frames["length"][i]].tobytes()
        if joint is None or is_special(data):
            continue
        # An AK motor has one ID for both, and begins a reply with it.
        is_reply = own in replying and (own not in commanded or data[0] == own)
        if joint == 0 and not is_reply:
            cycles.append(Cycle())
        if cycles:
            (cycles[-1].replies if is_reply else cycles[-1].commands)[joint] = float(frames["time"][i]), data
    return cycles[:-1]  # the last one may be cut off


def analyse(cycles: Sequence[Cycle], motors: Sequence[JointMotor], law: Law, period: float) -> LoopTiming:
    """Return the timing of a loop that should run every `period` s and apply `law`: (n,) rad -> (n,) Nm."""
    starts = np.array([cycle.commands[0][0] for cycle in cycles])
    spacing = np.diff(starts)
    cycles_due = round(float(starts[-1] - starts[0]) / period) + 1
    expected = [_expected_commands(cycle, motors, law) for cycle in cycles]
    answers = [commands and commands([0.0] * len(motors)) for commands in expected]
    sent = [_sent_answer(cycle, len(motors)) for cycle in cycles]
    latency: list[float] = []
    lost = 0
    for k, answer in enumerate(answers):
        if k < DISTINCT or answer is None or answer in answers[k - DISTINCT : k] or starts[-1] - starts[k] < GIVE_UP:
            continue
        n = _first_answer(k, expected, sent, motors, starts)
        if n is None:
            lost += 1
        else:
            latency += [cycles[n].commands[j][0] - cycles[k].replies[j][0] for j in range(len(motors))]
    return LoopTiming(
        np.array(latency),
        spacing,
        cycles_due,
        max(0, cycles_due - len(cycles)),
        int(np.count_nonzero(spacing >= 1.5 * period)),
        sum(answer is None for answer in answers),
        lost,
    )


def _expected_commands(cycle: Cycle, motors: Sequence[JointMotor], law: Law) -> Commands | None:
    """Return the commands that answer a cycle's replies, as a function of their damping; None if a reply is missing."""
    if len(cycle.replies) != len(motors):
        return None
    torques = law([motor.sample(cycle.replies[joint][1], 0.0).position for joint, motor in enumerate(motors)])
    return lambda damping: tuple(
        motor.command(torque, kd) for motor, torque, kd in zip(motors, torques, damping, strict=True)
    )


def _sent_answer(cycle: Cycle, motor_count: int) -> Answer | None:
    """Return a cycle's commands, None if one is missing."""
    is_complete = len(cycle.commands) == motor_count
    return tuple(cycle.commands[joint][1] for joint in range(motor_count)) if is_complete else None


def _first_answer(
    k: int,
    expected: Sequence[Commands | None],
    sent: Sequence[Answer | None],
    motors: Sequence[JointMotor],
    starts: np.ndarray,
) -> int | None:
    """Return the index of the first cycle whose commands answer cycle k or a later one."""
    for n in range(k + 1, len(sent)):
        if (answer := sent[n]) is not None:
            damping = [
                motor.wire_format.unpack_command(motor.spec, data).kd * motor.scale_at(None)
                for motor, data in zip(motors, answer, strict=True)
            ]
            if any(commands and commands(damping) == answer for commands in expected[k:n]):
                return n
        if starts[n] - starts[k] > GIVE_UP:
            return None
    return None


def percentile(values: np.ndarray, share: float) -> float:
    """Return the percentile, NaN of an empty array."""
    return float(np.percentile(values, share)) if len(values) else math.nan
