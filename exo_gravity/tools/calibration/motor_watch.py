"""The motors of a bus while a person moves the arm: how far each has turned, as a live table."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence

from rich.table import Table

from exo_gravity.core.motors.joint_motor import MAX_CAN_ID
from exo_gravity.core.motors.specs import MOTOR_ERRORS
from exo_gravity.hardware.can.bus_scan import Answer, BusScan

MAX_SILENCE = 0.15  # s: some replies in a row may be late on a busy computer


class Watch:
    """Polls the motors `can_ids`, and keeps how far each has turned since the start.

    joints: names by ID, as far as known. was_silent: IDs that did not answer for MAX_SILENCE.
    """

    def __init__(self, bus: BusScan, can_ids: Sequence[int], joints: dict[int, str]) -> None:
        self._bus = bus
        self._ids = can_ids
        self._joints = joints
        self._first: dict[int, float] = {}
        self._last: dict[int, Answer] = {}
        self.furthest: dict[int, float] = dict.fromkeys(can_ids, 0.0)  # rad, signed
        self.back: dict[int, float] = dict.fromkeys(can_ids, 0.0)  # rad, the largest turn the other way, 0 or more
        self.was_silent: set[int] = set()
        self._answered = dict.fromkeys(can_ids, time.monotonic())  # s, when each answered last

    def __call__(self) -> Table:
        """Poll once, and return the table of all motors."""
        answers = self._bus.poll(self._ids)
        now = time.monotonic()
        self._answered |= dict.fromkeys(answers, now)
        silent = {can_id for can_id, answered in self._answered.items() if now - answered > MAX_SILENCE}
        self.was_silent |= silent
        self._last |= answers
        for can_id, answer in answers.items():
            turn = answer.position - self._first.setdefault(can_id, answer.position)
            furthest = self.furthest[can_id]
            if abs(turn) > abs(furthest):
                if turn * furthest < 0.0:
                    self.back[can_id] = abs(furthest)
                self.furthest[can_id] = turn
            elif turn * furthest < 0.0:
                self.back[can_id] = max(self.back[can_id], abs(turn))
        turns = {can_id: answer.position - self._first[can_id] for can_id, answer in self._last.items()}
        return motor_table(self._last.values(), self._joints, turns, silent)


def motor_table(
    answers: Iterable[Answer],
    joints: dict[int, str] | None = None,
    turns: dict[int, float] | None = None,
    silent: Iterable[int] = (),
) -> Table:
    """Return the table of the motors that answer; turns: rad by ID, since the person was asked to move a joint."""
    columns = ("ID", "joint", "angle deg", "turned deg", "degC", "error", "reply", "reply ID", "wire format")
    table = Table(*columns, header_style="bold")
    for answer in sorted(answers):
        error = "-" if answer.error is None else MOTOR_ERRORS.get(answer.error, str(answer.error))
        table.add_row(
            str(answer.can_id),
            (joints or {}).get(answer.can_id, "?"),
            "silent" if answer.can_id in silent else f"{math.degrees(answer.position):.1f}",
            f"{math.degrees((turns or {}).get(answer.can_id, 0.0)):+.1f}",
            "-" if answer.temperature is None else str(answer.temperature),
            error,
            f"{answer.reply_length} bytes",
            hex(answer.reply_id) if answer.reply_id > MAX_CAN_ID else str(answer.reply_id),
            answer.wire_format,
        )
    return table
