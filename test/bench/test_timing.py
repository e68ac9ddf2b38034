# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The loop timing that the benchmark reads from a bus, on frames with known delays."""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np
import pytest

from bench.timing import LoopTiming, analyse, split_cycles
from exo_gravity.core.motors.ak import pack_reply
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.frames import ENTER
from exo_gravity.core.motors.joint_motor import JointMotor

pytestmark = pytest.mark.thorough

MOTOR_SPECS = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
ARM_MOTORS = tuple(JointMotor(MOTORS[name], can_id) for can_id, name in enumerate(MOTOR_SPECS, 1))
PERIOD = 0.002  # s
REPLY_DELAY = 0.0003  # s from a command to its reply
START = 1_700_000_000.0  # s


def law(theta: Sequence[float]) -> tuple[float, ...]:
    return tuple(2.0 * angle for angle in theta)


def reply(motor: JointMotor, k: int) -> bytes:
    """Return a motor's reply in cycle `k`."""
    return pack_reply(motor.spec, motor.can_id, 0.1 + 0.01 * k + 0.1 * motor.can_id, 0.0, 0.0, 30, 0)


def loop_frames(
    count: int,
    depth: int = 1,
    missing: Container[int] = (),
    without_replies: Container[int] = (),
    late: Container[int] = (),
) -> dict[str, np.ndarray]:
    """Return the frames of a loop whose commands answer the replies of `depth` cycles before.

    The cycles `missing` are left out, `late` ones come 0.6 periods late.
    """
    rows = []
    for k in (k for k in range(count) if k not in missing):
        answered = [motor.sample(reply(motor, max(0, k - depth)), 0.0).position for motor in ARM_MOTORS]
        for joint, (motor, effort) in enumerate(zip(ARM_MOTORS, law(answered), strict=True)):
            time = START + (k + 0.6 * (k in late)) * PERIOD + joint * 20e-6
            rows.append((time, motor.can_id, motor.command(effort, 0.0)))
            if k not in without_replies:
                rows.append((time + REPLY_DELAY, motor.can_id, reply(motor, k)))
    return {
        "time": np.array([time for time, _, _ in rows]),
        "id": np.array([can_id for _, can_id, _ in rows]),
        "length": np.array([len(data) for _, _, data in rows]),
        "data": np.array([list(data) for _, _, data in rows], dtype=np.uint8),
    }


def timing_of(frames: dict[str, np.ndarray]) -> LoopTiming:
    return analyse(split_cycles(frames, ARM_MOTORS, START, START + 1e9), ARM_MOTORS, law, PERIOD)


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_latency_runs_from_each_motors_reply_to_the_first_command_computed_from_it(depth):
    timing = timing_of(loop_frames(200, depth))
    assert timing.latency == pytest.approx(depth * PERIOD - REPLY_DELAY, abs=1e-6)
    assert len(timing.latency) > 400
    assert (timing.missed, timing.late, timing.incomplete, timing.lost) == (0, 0, 0, 0)


@pytest.mark.parametrize(
    ("without", "counts", "longest"),
    [
        ({"missing": (50, 51)}, (199, 2, 1, 0), 3.0),
        ({"late": (50, 120)}, (199, 0, 2, 0), 1.6),
        ({"without_replies": (50,)}, (199, 0, 0, 1), 1.0),
    ],
    ids=["cycles that never came", "late ones, after which the loop has caught up", "without all replies"],
)
def test_what_went_wrong_is_counted(without, counts, longest):
    timing = timing_of(loop_frames(200, **without))
    assert (timing.cycles, timing.missed, timing.late, timing.incomplete) == counts
    assert timing.spacing.max() == pytest.approx(longest * PERIOD, abs=1e-6)


def test_an_answer_that_never_comes_is_lost_and_special_and_foreign_frames_are_ignored():
    frames = loop_frames(400, depth=60)  # the commands answer replies of more cycles before than `GIVE_UP`
    extra = {"time": [START + 0.01, START + 0.0301], "id": [1, 77], "length": [8, 8], "data": [list(ENTER), [0] * 8]}
    both = {name: np.concatenate([values, np.array(extra[name], values.dtype)]) for name, values in frames.items()}
    assert timing_of(both).lost == timing_of(frames).lost > 0 and len(timing_of(both).latency) == 0
