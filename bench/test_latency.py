"""What the benchmark reads from a bus, against frames that were made with known delays."""

import numpy as np
import pytest

from bench.latency import analyse, cycles_of
from exo_gravity.core.joint_motor import JointMotor
from exo_gravity.core.motors import ENTER, MOTORS, pack_reply

MOTOR_SPECS = ("AK60-6", "AK80-9", "AK60-6", "AK60-6")
MOTORS_OF_ARM = tuple(JointMotor(MOTORS[name], can_id) for can_id, name in enumerate(MOTOR_SPECS, 1))
PERIOD = 0.002
REPLY = 0.0003  # s from a command to its reply
START = 1_700_000_000.0


def law(theta):
    return tuple(2.0 * angle for angle in theta)


def angles(k):
    return tuple(0.2 + 0.01 * k + 0.1 * joint for joint in range(4))


def read(angle, motor):
    """The angle that the loop sees of a true one: in position codes."""
    return motor.joint_reply(pack_reply(motor.spec, motor.can_id, angle, 0.0, 0.0, 30, 0)).position


def frames(count, depth=1, without=(), silent=(), late=()):
    """A loop whose commands answer the replies of `depth` cycles before.

    Cycles `without` commands, `silent` ones without replies, `late` ones by 0.6 of a period.
    """
    rows = []
    for k in (k for k in range(count) if k not in without):
        for joint, motor in enumerate(MOTORS_OF_ARM):
            at = START + (k + 0.6 * (k in late)) * PERIOD + joint * 20e-6
            seen = [read(angle, m) for angle, m in zip(angles(max(0, k - depth)), MOTORS_OF_ARM, strict=True)]
            rows.append((at, motor.can_id, motor.command(law(seen)[joint], 0.0)))
            if k not in silent:
                rows.append(
                    (at + REPLY, motor.can_id, pack_reply(motor.spec, joint + 1, angles(k)[joint], 0, 0, 30, 0))
                )
    return {
        "time": np.array([time for time, _, _ in rows]),
        "id": np.array([can_id for _, can_id, _ in rows]),
        "length": np.array([len(data) for _, _, data in rows]),
        "data": np.array([list(data) for _, _, data in rows], dtype=np.uint8),
    }


def seen(recorded):
    return analyse(cycles_of(recorded, MOTORS_OF_ARM, START, START + 1e9), MOTORS_OF_ARM, law, PERIOD)


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_the_latency_is_from_each_motors_reply_to_the_first_command_computed_from_it(depth):
    loop = seen(frames(200, depth))
    assert loop.latency == pytest.approx(depth * PERIOD - REPLY, abs=1e-6)
    assert len(loop.latency) > 400
    assert (loop.missed, loop.late, loop.incomplete, loop.lost) == (0, 0, 0, 0)


def test_a_period_without_commands_is_missed_and_shows_in_the_spacing():
    loop = seen(frames(200, without=(50, 51)))
    assert (loop.cycles, loop.missed, loop.late) == (199, 2, 1)
    assert loop.spacing.max() == pytest.approx(3 * PERIOD, abs=1e-6)


def test_a_cycle_that_came_late_is_not_missed_once_the_loop_has_caught_up():
    loop = seen(frames(200, late=(50, 120)))
    assert (loop.cycles, loop.missed, loop.late) == (199, 0, 2)


def test_a_cycle_without_all_replies_is_incomplete():
    assert seen(frames(200, silent=(50,))).incomplete == 1


def test_an_answer_that_never_came_is_lost():
    # The commands answer what was 60 cycles before: more than the 0.1 s after which an answer is given up.
    loop = seen(frames(400, depth=60))
    assert loop.lost > 0 and len(loop.latency) == 0


def test_an_arm_at_rest_shows_no_latency_because_its_answers_are_all_the_same():
    recorded = frames(1)
    still = {name: np.concatenate([values] * 100) for name, values in recorded.items()}
    still["time"] = np.concatenate([recorded["time"] + k * PERIOD for k in range(100)])
    loop = seen(still)
    assert len(loop.latency) == 0


def test_special_frames_and_frames_of_others_are_passed_over():
    recorded = frames(100)
    extra = {"time": [START + 0.01, START + 0.0301], "id": [1, 77], "length": [8, 8], "data": [list(ENTER), [0] * 8]}
    both = {name: np.concatenate([values, np.array(extra[name], values.dtype)]) for name, values in recorded.items()}
    assert seen(both).latency == pytest.approx(seen(recorded).latency)
