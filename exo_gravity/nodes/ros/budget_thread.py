"""Torque budgets on a thread of their own, so that a control loop or a web server need not wait for them.

A budget takes about 0.2 s of arithmetic. The thread pauses after each millisecond: without pauses, at any priority, it
kept the control loop's threads from their processor for up to 0.1 s (measured, Linux 6.18, two busy cores).
"""

from __future__ import annotations

import os
import time
from concurrent.futures import Future, ThreadPoolExecutor

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.model.budget import BudgetRequest, JointBudget

PAUSE = 0.005  # s, about 500 times per budget
Result = tuple[JointBudget, ...] | ParameterError


class BudgetThread:
    """Computes one budget at a time. Call `update` regularly: while it computes, newer requests wait."""

    def __init__(self) -> None:
        #: the newest budget of the four joints, or why there is none; None before the first
        self.result: Result | None = None
        self._request: BudgetRequest | None = None
        self._job: Future[Result] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="budget")

    def update(self, request: BudgetRequest) -> bool:
        """Collect a finished budget, or start that of `request` if it is new. Never blocks.

        Returns whether `result` is new.
        """
        if self._job is None:
            if request != self._request:
                self._request, self._job = request, self._pool.submit(compute, request)
            return False
        if not self._job.done():
            return False
        self.result, self._job = self._job.result(), None
        return True

    def close(self) -> None:
        """Start no further budget."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def compute(request: BudgetRequest) -> Result:
    """Return the budget of `request`, or the error, with pauses and without real-time scheduling."""
    # A thread inherits its creator's policy, and thread_priority sets that of all threads: never SCHED_FIFO here.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    try:
        return request.joints(lambda: time.sleep(PAUSE))
    except ParameterError as error:
        return error
