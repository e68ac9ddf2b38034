# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Support that adapts: what the node `wearer` asks for beyond the parameter `support`, for as long as it renews it.

The path of the torque does not depend on who asks: a request is bounded, late ones are refused, and one that is not
renewed expires. Then, and while two senders contradict each other, the support returns to the parameter's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from exo_gravity.core.safety.guidance import GUIDANCE
from exo_gravity.core.vocabulary import NO_REASON, Status, SupportRequested

TOPIC, NAME = "support_request", "support"  # of the message, and of its one entry


@dataclass(frozen=True)
class RequestTuning:
    """When a request counts, and how often it may change the support."""

    expires: float = 2.0  #: s from its stamp: ten renewals, so that a busy computer costs nothing
    max_age: float = 0.5  #: s by its stamp on arrival: older, and it answers an arm that has moved since
    max_lead: float = 0.05  #: s that a stamp may be ahead: the clocks of two computers differ by ms
    distrust: float = 2.0  #: s without a second sender, after which requests count again
    least_change: float = 0.005  #: of the wearer's arm: less is not felt
    pause: float = 2.0 * GUIDANCE.time  #: s between two changes: one guided change ends before the next


REQUEST = RequestTuning()


class SupportRequest:
    """The newest request of one arm. Every time is in s on the caller's monotonic clock."""

    def __init__(self, tuning: RequestTuning = REQUEST) -> None:
        self._tuning = tuning
        self._support = 0.0
        self._stamp = self._contradicted = self._changed = -math.inf
        self._refusal, self._refused = NO_REASON, -math.inf

    def receive(
        self, now: float, names: Sequence[str], values: Sequence[float], stamp: float, from_another: bool = False
    ) -> None:
        """Take a message that arrived at `now` and was sent at `stamp`.

        values: the share 0..1 of the wearer's arm under the one name 'support'.
        from_another: whether it comes from another sender than the message before.
        """
        if from_another:
            self._contradicted = now
        if problem := self._problem(now, names, values, stamp):
            self._refusal, self._refused = problem, now
        else:
            self._support, self._stamp = float(values[0]), stamp

    def fresh(self, now: float) -> float | None:
        """Return the share that is requested at `now`, None without a request, or while two senders contradict."""
        is_trusted = now - self._contradicted > self._tuning.distrust
        return self._support if is_trusted and now - self._stamp <= self._tuning.expires else None

    def support(self, now: float, set_support: float, present: float) -> float:
        """Return the share to carry from `now` on: `present`, unless it is to change.

        set_support: the parameter, the least share.
        present: the share that is carried.
        """
        asked = self.fresh(now)
        if asked is None:
            return set_support  # at once: this is a guided change of load like any other
        wanted = max(set_support, asked)
        if now - self._changed < self._tuning.pause or abs(wanted - present) < self._tuning.least_change:
            return max(set_support, present)
        self._changed = now
        return wanted

    def report(self, now: float) -> Status:
        """Return what is asked for, or what was wrong with a message of the last seconds, without its value."""
        if now - self._contradicted <= self._tuning.distrust:
            return Status(SupportRequested.SECOND_PUBLISHER, f"refused: more than one publisher of {TOPIC}")
        if now - self._refused <= self._tuning.expires:
            return Status(self._refusal.code, f"refused: {self._refusal}")
        asked = self.fresh(now)
        if asked is None:
            return Status(SupportRequested.NONE, "none")
        return Status(SupportRequested.FRESH, f"{100.0 * asked:.0f} %")

    def _problem(self, now: float, names: Sequence[str], values: Sequence[float], stamp: float) -> Status:
        """Return what is wrong with a message, false if nothing is."""
        if list(names) != [NAME] or len(values) != 1:
            return Status(SupportRequested.INVALID, f"{TOPIC} must have the one name {NAME} with one position")
        if not 0.0 <= values[0] <= 1.0:
            return Status(SupportRequested.INVALID, f"{TOPIC} must be a number from 0 to 1")
        if not now - self._tuning.max_age <= stamp <= now + self._tuning.max_lead:
            return Status(SupportRequested.LATE, f"{TOPIC} is late by its stamp, or its clock differs")
        return NO_REASON
