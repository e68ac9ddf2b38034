# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The fault matrix where can_bridge and compensator of an arm share a process: `run --one-process`."""

from __future__ import annotations

import signal
from collections.abc import Iterable
from dataclasses import replace

from .actions import send_signal
from .fault_case import PROCESS_REACTION, FaultCase

FREEZE = send_signal("compensator", signal.SIGSTOP)


def in_one_process(cases: Iterable[FaultCase]) -> list[FaultCase]:
    """Return the rows as they must go there.

    A compensator that dies, freezes or hangs takes its bridge with it, also for a moment: their watchdog lets the arm
    down, and the launcher ends. One that raises an exception lets the bridge do so.
    """
    return [_with_its_bridge(case) if case.name.startswith("compensator") else case for case in cases]


def _with_its_bridge(case: FaultCase) -> FaultCase:
    own = FaultCase("", case.inject)
    return replace(
        case,
        inject=FREEZE if "stopped" in case.name else case.inject,
        limit=PROCESS_REACTION,
        outcomes=("stopped",),
        clear=own.clear,
        afterwards=own.afterwards,
        check=own.check,
    )
