# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What keeps the boards of an arm's motors from serving it, as far as their frames show it.

A board that is set up otherwise than its parameters say is silent, or reports too seldom: without its own sentence, a
start would wait for "no reply". Boards that can be asked for their settings are asked, while their motors are off: a
start waits until each setting is known to be as the parameters say. A motor whose temperature has another offset than
we assume heats unseen.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.frames import ELSEWHERE, MALFORMED, Frame
from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE, JointMotor, JointSample


@dataclass(frozen=True)
class BoardCheck:
    """When a board counts as set up otherwise than its parameters say."""

    silence: float = 1.2  #: s without a status frame; a V3 board sends one at least each second
    recent: float = 1.0  #: s for which a malformed frame counts as the reason for a missing reply
    window: float = 0.5  #: s over which status frames are counted, so that a start knows before its calm second is over
    share: float = 0.9  #: of the control rate that status frames must reach: the rest is jitter of that count
    #: s after which a board is asked for a setting again, and s for which its answer counts; a start takes 1 s at
    #: least: a board that has restarted, or was written to by a tool, is found out before
    ask_again: float = 0.5
    valid: float = 1.0
    restart: float = 2.0  #: s without a reply after which a motor may have been switched off and on
    coldest: int = 5  #: degC that a motor in a room reads at least when it is switched on,
    hottest: int = 60  #: and at most; one that is warmer may have worked before, unless the others are cold


CHECK = BoardCheck()


class Boards:
    """Follows the frames of an arm's motors.

    motors: (n,) of the arm, in the order in which `take` and `heard` number them.
    """

    def __init__(self, motors: Sequence[JointMotor]) -> None:
        self._motors = tuple(motors)
        self._replied = [-math.inf] * len(motors)  # s of the last reply or status frame
        self._first: list[int | None] = [None] * len(motors)  # degC when switched on
        self._since = [-math.inf] * len(motors)  # s, the begin of the count
        self._count = [0] * len(motors)
        self._rate = [math.inf] * len(motors)  # Hz of status frames, as counted last
        self._heard = [(-math.inf, "")] * len(motors)  # s, and what the motor sent that was no reply
        # What each board has told of its settings, and when, by number.
        self._settings: list[dict[int, tuple[float, float]]] = [{} for _ in motors]
        self._asked = [0] * len(motors)  # questions so far
        self._started = math.inf  # s

    def take(self, joint: int, sample: JointSample) -> None:
        """Take a reply or status frame of the motor of `joint`."""
        now = sample.time
        if now - self._replied[joint] > CHECK.restart:
            self._first[joint], self._since[joint], self._count[joint] = sample.temperature, now, 0
        else:
            self._count[joint] += 1
        self._replied[joint] = now
        if (elapsed := now - self._since[joint]) >= CHECK.window:
            self._rate[joint], self._since[joint], self._count[joint] = self._count[joint] / elapsed, now, 0

    def question(self, joint: int, now: float) -> tuple[Frame, ...]:
        """Return what the board of `joint` is to be asked at `now` s; nothing if it has just told all its settings."""
        due = [
            setting
            for setting in self._motors[joint].settings
            if now - self._told(joint, setting.number)[1] >= CHECK.ask_again
        ]
        if not due:
            return ()
        self._asked[joint] += 1
        return (due[self._asked[joint] % len(due)].question,)

    def told(self, joint: int, data: bytes, now: float) -> None:
        """Take the answer of the board of `joint`, at `now` s."""
        number, value = self._motors[joint].wire_format.unpack_setting(data)
        self._settings[joint][number] = value, now

    def _told(self, joint: int, number: int) -> tuple[float, float]:
        """Return the value of a setting, and when the board told it: -inf for never."""
        return self._settings[joint].get(number, (math.nan, -math.inf))

    def heard(self, joint: int, kind: str, frame: Frame, now: float) -> None:
        """Take a frame of the motor of `joint` that is not its reply: MALFORMED, SERVO or ELSEWHERE, at `now` s."""
        motor, (frame_id, data) = self._motors[joint], frame
        if kind == MALFORMED:
            *most, last = map(str, motor.wire_format.reply_lengths)
            lengths = f"{', '.join(most)} or {last}" if most else last
            what = f"sent {len(data)} bytes [{data.hex(' ')}] as its reply: must be {lengths} bytes"
        elif kind == ELSEWHERE:
            what = f"replies with the ID {frame_id}: set master_id = {frame_id}, or {motor.reply_id} on the motor"
        else:
            what = (
                "does not reply, but sends status frames: set it to MIT mode if it is a V1 or V2 board in servo mode; "
                "set wire_format = mit_v3 if it is a V3 board"
            )
        self._heard[joint] = now, f"motor {motor.can_id} {what}"

    def setup_error(self, now: float, rate: float) -> str:
        """Return which board is not set up as it must be for a start, and how, at `now` s; '' if none shows it.

        rate: Hz of the control loop, each cycle of which waits for a status frame of a V3 board.
        """
        self._started = min(self._started, now)
        for joint, motor in enumerate(self._motors):
            heard, sentence = self._heard[joint]
            if heard > self._replied[joint] and now - heard < CHECK.recent:
                return sentence
            if now - self._replied[joint] < CHECK.recent and (wrong := self._wrong_setting(joint, now)):
                return wrong
            if motor.wire_format.replies:
                continue
            if now - max(self._started, self._replied[joint]) > CHECK.silence:
                return (
                    f"motor {motor.can_id} sends no status frame: switch its supply on, and set its board to report "
                    f"{MAX_STATUS_RATE:g} times a second, not only when asked (query-reply mode)"
                )
            if self._rate[joint] < CHECK.share * rate:
                return (
                    f"motor {motor.can_id} sends {self._rate[joint]:.0f} status frames a second, rate = {rate:g} needs "
                    f"at least that many: set {MAX_STATUS_RATE:g} on its board"
                )
        return ""

    def _wrong_setting(self, joint: int, now: float) -> str:
        """Return which setting of a board is not as it must be, or not known at `now` s; '' for none."""
        motor = self._motors[joint]
        for setting in motor.settings:
            value, told = self._told(joint, setting.number)
            if now - told > CHECK.valid:
                return f"motor {motor.can_id} to tell its {setting.name}"
            if not setting.low <= value <= setting.high:
                name, right = f"{setting.name} (register {setting.number})", 0.5 * (setting.low + setting.high)
                known = f", or {setting.parameter} {setting.unit * value:g} in the file" if setting.parameter else ""
                return f"motor {motor.can_id} to be set right: its {name} is {value:g}, must be {right:g}{known}"
        return ""

    @property
    def odd_temperature(self) -> str:
        """Which motor read another temperature than that of a room when it was switched on, '' for none.

        One AK60-6 V1.1 was reported to send degC without the offset of 40: it reads -15 in a room, and 40 at 80.
        """
        read = [(motor.can_id, degrees) for motor, degrees in zip(self._motors, self._first, strict=True)]
        known = [(can_id, degrees) for can_id, degrees in read if degrees is not None]
        odd = [(can_id, degrees) for can_id, degrees in known if not CHECK.coldest <= degrees <= CHECK.hottest]
        for can_id, degrees in odd:
            if degrees < CHECK.coldest or len(odd) == 1 < len(known):
                others = sorted(other for own, other in known if own != can_id)
                rest = f", the others {others[0]} to {others[-1]}" if others else ""
                return (
                    f"motor {can_id} read {degrees} degC when it was switched on{rest}: a cold motor must read room "
                    "temperature; its firmware may send it with another offset than 40, and would overheat unseen"
                )
        return ""
