# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""How old the motors' replies are: each belongs to a command, and a queue on the way shows as commands under way.

A reply does not say which command it answers, but a V1 or V2 board answers each command once, and in order. So the
oldest command without a reply is the one that the next reply answers, if no frame was lost. Frames are lost, which
looks just like a queue that grows: before a frame leaves this computer, in the adapter, or before a reply is read. A
pause tells them apart: a motor that is sent nothing still replies to all that is queued, and to nothing that was lost.

    oldest command without a reply older than `longest`    the motor is sent nothing until it is known why:
        no reply for `quiet`                                    those commands were lost, and are forgotten
        replies, which show a queue as long as `longest`        twice within `again`: the replies are `late`, a fault
        replies at once                                         the device stood still: no queue, and nothing is wrong
        a cycle that begins `late`                              nothing is known of that time: the motor is asked again

While replies are late, a motor is sent a command only if no more are under way than `longest` holds: a queue that our
own commands fill gets no longer.
"""

import math
from collections import deque
from dataclasses import dataclass

from exo_gravity.core.safety.limits import EQUIPMENT


@dataclass(frozen=True)
class ReplyAge:
    """When replies are too old."""

    longest: float = 2.0 * EQUIPMENT.late  #: s; a pause as long must not silence a motor (`reply_timeout`)
    fewest: int = 3  #: commands under way: at a low rate one or two may be longer than `longest`
    quiet: float = 1.25 * EQUIPMENT.timer  #: s without a reply that show that none is under way
    looks: int = 3  #: cycles of it at least
    late: float = 0.75 * EQUIPMENT.late  #: s; a pause and a computer that is late would make a motor silent
    #: s beyond a period that pass between two looks at most: where more have, this process or the whole computer stood
    #: still, and the replies that wait are no older than others
    look: float = 0.005
    #: least spread of a queue's replies, as a share of their commands'. A line that is slower than the commands, or as
    #: fast, spreads replies like them; a device that stood still answers all at once
    spread: float = 0.5
    again: float = 0.5  #: s within which a second such pause must follow: a device that stood still once is no queue
    most: int = 256  #: commands that are remembered


AGE = ReplyAge()


class Requests:
    """The commands to one motor, and their replies. Times are in s; ages are in s for which this process ran.

    last: when the motor was last sent a frame; -inf for never.
    late: how old its replies are at least, in s, if that is too old; else 0.
    """

    def __init__(self) -> None:
        self.last = -math.inf
        self.late = 0.0
        self._ran, self._seen = 0.0, math.inf  # s for which this process has run, and when it last looked
        self._open: deque[float] = deque(maxlen=AGE.most)  # when each command without a reply was sent
        self._sent: list[float] = []  # of a pause: `_open` when it began; empty without a pause
        self._replies: list[float] = []  # when they arrived in the pause
        self._suspected = -math.inf  # when replies last showed a long queue
        self._looks = 0  # cycles without a command since the last reply
        self._replied = -math.inf  # when the last reply arrived
        self._asked_in_vain = 0  # commands since the last reply
        self._due = math.inf  # when the next cycle was to begin, at the latest
        self._period = 0.0  # s

    def may_send(self, now: float, period: float) -> bool:
        """Return whether the motor is to be sent a command in this cycle, which lasts `period` s."""
        is_late = now - self._due >= AGE.late
        self._due, self._period = now + period, period
        now = self._run(now)
        is_quiet = now - self._replied >= AGE.quiet
        is_short = len(self._open) < AGE.fewest or now - self._open[0] <= AGE.longest
        if self._sent or (self.late and not is_short):
            self._looks += 1
            if self._sent and is_late:
                self._sent = []
                return True
            if self._looks >= AGE.looks and is_quiet:
                self._open.clear()
                self._sent, self.late = [], 0.0
                return True
            return False
        if is_short:
            return True
        if is_late or self._asked_in_vain or is_quiet:
            return True  # nothing is known, or it does not reply: a pause would only make it silent for longer
        self._sent, self._replies, self._looks = list(self._open), [], 0
        return False

    def sent(self, now: float, frames: int) -> None:
        """Note frames that the motor answers."""
        self.last = now
        now = self._run(now)
        self._open.extend([now] * frames)
        self._asked_in_vain += frames

    def replied(self, now: float) -> float:
        """Note a reply; return when the motor was last asked, or `now` if it never was: the reading is no newer."""
        asked = now if self.last == -math.inf else self.last
        now = self._run(now)
        self._replied, self._looks, self._asked_in_vain = now, 0, 0
        if self._open:
            self._open.popleft()
        if not self._open:
            self.late = 0.0
        if self._sent:
            self._replies.append(now)
            sent = self._sent[-len(self._replies) :]  # so many at least were under way when the pause began
            age = self._replies[0] - sent[0]
            is_spread = now - self._replies[0] >= AGE.spread * (sent[-1] - sent[0])
            if len(sent) >= AGE.fewest and age > AGE.longest and is_spread:
                self.late = age if now - self._suspected <= AGE.again else 0.0
                self._suspected, self._sent = now, []
        return asked

    def _run(self, now: float) -> float:
        """Return the time in s for which this process has run until `now`."""
        self._ran += min(self._period + AGE.look, max(0.0, now - self._seen))
        self._seen = now
        return self._ran
