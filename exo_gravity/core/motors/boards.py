"""What keeps the boards of an arm's motors from serving it, as far as their frames show it.

A board that is set up otherwise than its parameters say is silent, or reports too seldom: without its own sentence, a
start would wait for "no reply". A motor whose temperature has another offset than we assume heats unseen.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.motors.joint_motor import MAX_STATUS_RATE, JointMotor, JointSample
from exo_gravity.core.motors.wire_formats import MALFORMED


@dataclass(frozen=True)
class BoardCheck:
    """When a board counts as set up otherwise than its parameters say."""

    silence: float = 1.2  #: s without a status frame; a V3 board sends one at least each second
    recent: float = 1.0  #: s for which a malformed frame counts as the reason for a missing reply
    window: float = 0.5  #: s over which status frames are counted, so that a start knows before its calm second is over
    share: float = 0.9  #: of the control rate that status frames must reach: the rest is jitter of that count
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

    def heard(self, joint: int, kind: str, data: bytes, now: float) -> None:
        """Take a frame of the motor of `joint` that is not its reply: MALFORMED or SERVO, at `now` s."""
        motor = self._motors[joint]
        if kind == MALFORMED:
            *most, last = map(str, motor.wire_format.reply_lengths)
            lengths = f"{', '.join(most)} or {last}" if most else last
            what = f"sent {len(data)} bytes [{data.hex(' ')}] as its reply: must be {lengths} bytes"
        else:
            what = (
                "does not reply, but sends status frames: set it to MIT mode if it is a V1 or V2 board in servo mode; "
                "set wire_format = mit_v3 if it is a V3 board"
            )
        self._heard[joint] = now, f"motor {motor.can_id} {what}"

    def hindrance(self, now: float, rate: float) -> str:
        """Return which board is not set up as it must be for a start, and how, at `now` s; '' if none shows it.

        rate: Hz of the control loop, each cycle of which waits for a status frame of a V3 board.
        """
        self._started = min(self._started, now)
        for joint, motor in enumerate(self._motors):
            heard, sentence = self._heard[joint]
            if heard > self._replied[joint] and now - heard < CHECK.recent:
                return sentence
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
