"""What the frames on a bus say of the loop: the time from a reply to the torque for it, spacing, and missed cycles.

Which command answers which reply is told by its content. The arm is led to and fro, so that its angles change by a few
position codes each cycle. From the four angles of a cycle follow, by the law under test, the four command frames that
answer it, bit for bit: the loop does nothing else to a torque once the arm is carried, within its limits, and the trunk
upright. An answer that equals one of the last cycles' tells nothing (the arm turned too little for another torque code)
and is left out. Every other is looked for in the bursts of commands that follow; where a newer answer overtook it, that
one counts. The time is taken for each motor, from its reply to its command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.motors import SPECIAL_FRAMES

SAME = 8  # cycles within which an answer must not have been given before
LONGEST = 0.1  # s after which an answer that never came is given up

Law = Callable[[Sequence[float]], Sequence[float]]


@dataclass(frozen=True)
class Loop:
    """What was seen of one arm. latency, spacing: s, of each answer and motor, and from each cycle to the next.

    cycles: how many there should have been. missed: how many of them never came. late: how many came half a period late
    or more; by the next one the loop may have caught up. incomplete: cycles in which not every motor replied before the
    next one. lost: answers that never came.
    """

    latency: np.ndarray
    spacing: np.ndarray
    cycles: int
    missed: int
    late: int
    incomplete: int
    lost: int


class _Cycle:
    """Commands and replies from one command to the first motor until the next; by joint: (time, bytes)."""

    def __init__(self):
        self.commands: dict[int, tuple[float, bytes]] = {}
        self.replies: dict[int, tuple[float, bytes]] = {}


def cycles_of(frames: dict[str, np.ndarray], motors: Sequence[JointMotor], begin: float, end: float) -> list[_Cycle]:
    """Return the cycles between two times (s)."""
    joint_of = {motor.can_id: joint for joint, motor in enumerate(motors)}
    inside = (frames["time"] >= begin) & (frames["time"] < end)
    order = np.flatnonzero(inside)[np.argsort(frames["time"][inside], kind="stable")]
    cycles: list[_Cycle] = []
    for i in order:
        joint = joint_of.get(int(frames["id"][i]))
        data = frames["data"][i, : frames["length"][i]].tobytes()
        if joint is None or data in SPECIAL_FRAMES:
            continue
        is_reply = data[0] == motors[joint].can_id
        if joint == 0 and not is_reply:
            cycles.append(_Cycle())
        if cycles:
            (cycles[-1].replies if is_reply else cycles[-1].commands)[joint] = float(frames["time"][i]), data
    return cycles[:-1]  # the last one may be cut off


def analyse(cycles: Sequence[_Cycle], motors: Sequence[JointMotor], law: Law, period: float) -> Loop:
    """Return what the cycles show, for a loop that should run every `period` s by `law`: (4,) rad -> (4,) Nm."""
    starts = np.array([cycle.commands[0][0] for cycle in cycles])
    spacing = np.diff(starts)
    cycles_due = round(float(starts[-1] - starts[0]) / period) + 1
    answers = [_answer(cycle, motors, law) for cycle in cycles]
    given = [
        tuple(data for _, data in (cycle.commands[joint] for joint in range(len(motors))))
        if len(cycle.commands) == len(motors)
        else None
        for cycle in cycles
    ]
    latency, lost = [], 0
    for k, answer in enumerate(answers):
        if k < SAME or answer is None or answer in answers[k - SAME : k] or starts[-1] - starts[k] < LONGEST:
            continue
        n = _first(k, answers, given, starts)
        if n is None:
            lost += 1
            continue
        latency += [cycles[n].commands[j][0] - cycles[k].replies[j][0] for j in range(len(motors))]
    return Loop(
        np.array(latency),
        spacing,
        cycles_due,
        max(0, cycles_due - len(cycles)),
        int(np.count_nonzero(spacing >= 1.5 * period)),
        sum(answer is None for answer in answers),
        lost,
    )


def _answer(cycle: _Cycle, motors: Sequence[JointMotor], law: Law) -> tuple[bytes, ...] | None:
    """Return the four commands that answer a cycle's replies, None where one is missing."""
    if len(cycle.replies) != len(motors):
        return None
    angles = [motor.joint_reply(cycle.replies[joint][1]).position for joint, motor in enumerate(motors)]
    return tuple(motor.command(torque, 0.0) for motor, torque in zip(motors, law(angles), strict=True))


def _first(k: int, answers: Sequence, given: Sequence, starts: np.ndarray) -> int | None:
    """Return the index of the first cycle whose commands answer cycle k or a later one."""
    wanted = set()
    for n in range(k + 1, len(given)):
        wanted.add(answers[n - 1])
        if given[n] is not None and given[n] in wanted:
            return n
        if starts[n] - starts[k] > LONGEST:
            return None
    return None


def percentile(values: np.ndarray, share: float) -> float:
    """Return the percentile, NaN of nothing."""
    return float(np.percentile(values, share)) if len(values) else math.nan
