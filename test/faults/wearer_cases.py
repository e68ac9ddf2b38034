"""Rows of the fault matrix in which the wearer acts: he is neither fought nor thrown when the arm is let down."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

from .actions import send_signal
from .fault_case import PROCESS_REACTION, FaultCase
from .rig import Rig
from .rigs import TwoLaunchersRig

MOVED = 0.6  # rad/s that the motors may cause
POSE = [0.0, 0.9, 0.3, 0.6]  # rad
HORIZONTAL = [0.0, 1.5, 0.3, 0.6]

Steps = list[dict[str, Any]]


class WornRig(TwoLaunchersRig):
    """An arm half raised, which the wearer can move in both directions."""

    pose = POSE


class RaisedRig(WornRig):
    """An arm raised to the horizontal: a hand has a long way to press it down."""

    pose = HORIZONTAL


def pushes(*torques: list[float]) -> Steps:
    """Push for a quarter of a second with each of these torques (4,) Nm: two opposite ones shake at 2 Hz."""
    return [{"push": torque, "over": 0.25} for torque in torques]


LIFT: Steps = [{"move": [0.0, 1.5, 0.3, 1.2], "over": 1.6}]
PUSH_DOWN: Steps = [{"move": [0.0, 0.3, 0.1, 0.3], "over": 1.0}]
PRESS_DOWN: Steps = [{"move": [0.0, 0.4, 0.2, 0.4], "over": 1.6}]
HOLD: Steps = [{"move": POSE, "over": 5.0}]
SHAKE = pushes(*[[0.0, 2.0, 0.8, 0.3], [0.0, -2.0, -0.8, -0.3]] * 10)
THROW = pushes([0.0, 2.5, 0.0, 0.2])
REACH: Steps = [{"move": pose, "over": 0.8} for pose in ([0.3, 1.2, 0.8, 1.2], POSE) * 4]


def begin(rig: Rig, steps: Steps) -> None:
    """Let the wearer do these steps from now on."""
    script = rig.write_script(f"wearer_{time.monotonic_ns()}", steps)
    result = rig.probe.set_parameters("simulator", trial=str(script))
    assert result.successful, result.reason


def while_wearer(does: str, steps: Steps, after: float, rig: type[Rig] = WornRig, **options: Any) -> FaultCase:
    """The compensator freezes `after` s after the wearer began his `steps`, with which he goes on."""

    def inject(rig: Rig) -> float:
        begin(rig, steps)
        time.sleep(after)
        start = time.time()
        os.kill(rig.pid("compensator"), signal.SIGSTOP)
        return start

    return FaultCase(
        f"compensator frozen while the wearer {does}",
        inject,
        rig,
        limit=PROCESS_REACTION,
        clear=send_signal("compensator", signal.SIGCONT),
        outcomes=("command_stale",),
        driven_limit=MOVED,
        **options,
    )


ACTIVE_WEARER = (
    while_wearer("lifts", LIFT, 0.4),
    while_wearer("pushes down", PUSH_DOWN, 0.2),
    while_wearer("holds still", HOLD, 0.5),
    while_wearer("shakes the arm at 2 Hz", SHAKE, 1.0),
    while_wearer("reaches on and on", REACH, 1.0),
    while_wearer("throws the arm", THROW, 0.2),
    while_wearer("presses it down from the horizontal", PRESS_DOWN, 0.1, RaisedRig),
)
