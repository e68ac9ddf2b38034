# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a row of the fault matrix is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from exo_gravity.sim.judge import MAX_DAMPING, MAX_ENERGY, MAX_SPEED

from .rig import Rig

REACTION = 0.10  # s from a fault until damping acts on every motor,
PROCESS_REACTION = 0.15  # or where another process must first notice that one has died or frozen
RECOVERY = 6.0  # s in which the launcher brings down an arm that has lost its bridge and its watchdog

Action = Callable[[Any], object]  # on a rig of the case's type
Check = Callable[[np.ndarray], str]  # of the truth records since the fault: returns what is wrong, or ''
ALL_JOINTS = (0, 1, 2, 3)  # of the paper's arm


@dataclass(frozen=True)
class FaultCase:
    """One fault. inject(rig) causes it, and may return the time (wall clock, s) at which it began.

    clear(rig) ends the fault where the rig is used again.
    afterwards(rig) checks, once the arm is down, what happens next: it raises AssertionError.
    stage: the bridge's state in which the fault occurs, or "started".
    limit: s until the arm must be let down, None where it may stay carried, because the fault is refused or ignored.
    outcomes: the allowed results, fault codes or states; () for any.
    unreached: joints (0..) whose motors no frame can reach.
    unpowered: joints that fall, because a motor has no power, so that nothing can brake them.
    steps_from: s after the fault from which on torque steps count, where the fault itself is a step.
    speed_limit, driven_limit: rad/s of any joint.
    energy_limit: J of any motor in one stretch.
    damping_limit: of any motor's damping by itself, as a multiple of its rated torque.
    check: of the arm's true motion.
    ends_rig: whether the rig is spent although its nodes run on.
    """

    name: str
    inject: Action
    rig: type[Rig] = Rig
    limit: float | None = REACTION
    stage: str = "active"
    clear: Action = lambda rig: None
    afterwards: Action = lambda rig: None
    outcomes: tuple[str, ...] = ()
    unreached: tuple[int, ...] = ()
    unpowered: tuple[int, ...] = ()
    steps_from: float = 0.0
    speed_limit: float = MAX_SPEED
    driven_limit: float = MAX_SPEED
    energy_limit: float = MAX_ENERGY
    damping_limit: float = MAX_DAMPING
    check: Check = lambda records: ""
    ends_rig: bool = False

    @property
    def must_stay_off(self) -> bool:
        """Whether the fault occurs before the motors are switched on."""
        return self.stage == "checking"
