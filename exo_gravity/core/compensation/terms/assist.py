# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The outer loop's input: efforts from the user's own node, added to gravity compensation only while they are sound.

    off        `max_effort` is 0
    waiting    no messages yet, or they stopped; no torque
    refused    the last ones were wrong; no torque until they have been sound for `recovery`
    assisting  the efforts are followed: clamped to `max_effort`, ramped in within `ramp`

An effort is valid for `periods` observed periods, so that a single late message costs nothing. How fast the torque
changes is limited for all of the compensator's torque together: docs/terms.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.compensation.terms.catalogue import TermParameters
from exo_gravity.core.numbers import JOINT_COUNT, Torque, clamp
from exo_gravity.core.params import owned
from exo_gravity.core.safety.limits import MAX_COMMAND
from exo_gravity.core.vocabulary import NO_REASON, AssistProblem, Status


@dataclass(frozen=True)
class AssistTuning:
    """How long an effort of the outer loop is valid, and how fast it acts."""

    slowest: float = 0.1  #: s between two messages
    min_valid: float = 0.05  #: s from its stamp for which an effort is valid at any rate
    periods: float = 1.5  #: observed periods for which it is valid
    smoothing: float = 0.2  #: share of a new interval in the observed period
    max_lead: float = 0.02  #: s that a stamp may be ahead
    ramp: float = 0.5  #: s from none to full
    recovery: float = 0.5  #: s without a wrong message, after which efforts are accepted again


ASSIST = AssistTuning()
NOTHING_YET = Status(AssistProblem.NO_MESSAGES, "no assist_efforts yet")


@dataclass(frozen=True)
class Assist(TermParameters):
    """Parameters of the group `assist`. Raises ParameterError."""

    max_effort: Sequence[float] = owned(
        (0.0,) * JOINT_COUNT, "largest torque from assist_efforts; 0: ignored", (0.0, 10.0), "Nm"
    )


class AssistInput:
    """Follows one stream of efforts. Every time is in s on the caller's monotonic clock."""

    def __init__(self, names: Sequence[str], assist: Assist | None = None) -> None:
        self.assist = assist or Assist()
        self._why = NOTHING_YET
        self._names = list(names)
        self._target: Torque = (0.0,) * len(self._names)  # the newest efforts
        self._begin = math.inf  # s, since when they are followed
        self._period = ASSIST.slowest
        self._stamp = self._arrival = -math.inf
        self._refused = -math.inf
        self._last = -math.inf  # the last call of `torque`

    @property
    def state(self) -> str:
        """'off', 'waiting', 'refused' or 'assisting', as of the last call of `torque`."""
        if not self.assist.on:
            return "off"
        if not self.reason:
            return "assisting"
        return "refused" if self._last - self._refused < ASSIST.recovery else "waiting"

    @property
    def reason(self) -> Status:
        """Why there is no full assistance."""
        return self._why if self.assist.on else Status(AssistProblem.OFF, "assist.max_effort is 0")

    @property
    def valid(self) -> float:
        """Time in s from its stamp for which an effort is valid, by the observed period."""
        return max(ASSIST.min_valid, ASSIST.periods * self._period)

    def receive(
        self, now: float, names: Sequence[str], efforts: Sequence[float], stamp: float, from_another: bool = False
    ) -> None:
        """Take a message that arrived at `now`: `efforts` in Nm of the joints `names`, computed at `stamp`.

        from_another: whether its publisher is another than that of the message before.
        """
        interval, self._arrival = now - self._arrival, now
        is_stream = interval < ASSIST.slowest * ASSIST.periods
        if not is_stream:
            self._begin = math.inf
        else:
            self._period += ASSIST.smoothing * (min(interval, ASSIST.slowest) - self._period)
        problem = self._problem(now, names, efforts, stamp, from_another and is_stream)
        if problem:
            self._refused, self._why = now, problem
            return
        self._stamp = stamp
        self._target = tuple(float(efforts[names.index(name)]) for name in self._names)

    def _problem(
        self, now: float, names: Sequence[str], efforts: Sequence[float], stamp: float, second: bool
    ) -> Status:
        """Return what is wrong with a message, without a measured value; false if nothing is."""
        if not len(names) == len(efforts) == len(self._names) or sorted(names) != sorted(self._names):
            unnamed = f"assist_efforts must name {', '.join(self._names)}, each once, with one effort each"
            return Status(AssistProblem.INVALID, unnamed)
        if not all(-MAX_COMMAND <= tau <= MAX_COMMAND for tau in efforts):
            return Status(AssistProblem.INVALID, f"assist_efforts must be numbers within {MAX_COMMAND:g} Nm")
        if second:
            return Status(AssistProblem.SECOND_PUBLISHER, "more than one publisher of assist_efforts")
        if not now - self.valid <= stamp <= now + ASSIST.max_lead:
            return Status(AssistProblem.LATE, "assist_efforts are late by their stamp, or their clock differs")
        return NO_REASON

    def torque(self, now: float) -> Torque:
        """Return the torque (n,) in Nm at `now`; call it in every cycle."""
        self._last = now
        self._begin = min(self._begin, now) if self._is_sound(now) else math.inf
        ramp = max(0.0, min(1.0, (now - self._begin) / ASSIST.ramp))
        return tuple([ramp * clamp(tau, most) for tau, most in zip(self._target, self.assist.max_effort, strict=True)])

    def _is_sound(self, now: float) -> bool:
        """Return whether the newest efforts are to be followed at `now`; note why not."""
        if now - self._refused < ASSIST.recovery:
            return False  # `reason` says what was wrong
        if now - self._stamp <= self.valid:
            self._why = NO_REASON
        else:
            is_new = self._stamp == -math.inf
            self._why = NOTHING_YET if is_new else Status(AssistProblem.STOPPED, "assist_efforts stopped")
        return not self.reason
