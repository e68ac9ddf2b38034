# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix with a wearer: who acts while the arm is let down, or for whom the load is changed.

A wearer who acts is neither fought nor thrown. One who is passive is moved slowly by a change of load.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from exo_gravity.sim.judge import USUAL, resolution

from .actions import Steps, compensator, in_turn, pause, send_signal, wearer
from .fault_case import PROCESS_REACTION, FaultCase
from .rig import Rig
from .rigs import LoadedRig, RaisedRig, V3WearerRig, WearerRig, WornRig

MOVED = 0.6  # rad/s that the motors may cause
GUIDED_SPEED = 0.6  # rad/s
MOTION = 8.0  # s until an arm that became heavy hangs
DROPPED, TAKEN = 2.0, 7.0  # kg, and s in which the motors take them
DROP_SPEED = 4.8  # rad/s, below which no joint is a fault


def pushes(*torques: list[float]) -> Steps:
    """Push for a quarter of a second with each of these torques (4,) Nm: two opposite ones shake at 2 Hz."""
    return [{"push": torque, "over": 0.25} for torque in torques]


LIFT: Steps = [{"move": [0.0, 1.5, 0.3, 1.2], "over": 1.6}]
PUSH_DOWN: Steps = [{"move": [0.0, 0.3, 0.1, 0.3], "over": 1.0}]
PRESS_DOWN: Steps = [{"move": [0.0, 0.4, 0.2, 0.4], "over": 1.6}]
HOLD: Steps = [{"move": list(WornRig.pose), "over": 5.0}]
SHAKE = pushes(*[[0.0, 2.0, 0.8, 0.3], [0.0, -2.0, -0.8, -0.3]] * 10)
THROW = pushes([0.0, 2.5, 0.0, 0.2])
REACH: Steps = [{"move": pose, "over": 0.8} for pose in ([0.3, 1.2, 0.8, 1.2], list(WornRig.pose)) * 4]


def within_max_effort(records: np.ndarray) -> str:
    """Return which joint was held with more than the rated torque, by default `max_effort`, damping apart; or ''."""
    effort = np.abs(records["torque"] + records["damping"] * records["velocity"]).max(axis=0)
    beyond = np.flatnonzero(effort > np.array([motor.rated_torque for motor in USUAL]) + resolution())
    return ", ".join(f"motor {joint + 1} holds with {effort[joint]:.1f} Nm" for joint in beyond)


def while_wearer(does: str, steps: Steps, after: float, rig: type[Rig] = WornRig, **options: Any) -> FaultCase:
    """The compensator freezes `after` s after the wearer began `steps`, and goes on with them."""

    def inject(rig: Rig) -> float:
        wearer(rig, steps)
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
        check=within_max_effort,
        **options,
    )


def await_load(rig: Rig) -> None:
    """Wait until the load has changed: an arm that still sinks takes longer, and no hand may move it meanwhile."""
    rig.probe.wait_until(lambda: rig.probe.diagnostic("compensator", "changing load") == "none")


def load_case(name: str, change: Mapping[str, Any], back: Mapping[str, Any], rig: type[Rig] = WearerRig) -> FaultCase:
    return FaultCase(
        name,
        in_turn(compensator(change), pause(MOTION)),
        rig,
        limit=None,
        outcomes=("active",),
        clear=in_turn(compensator(back), pause(3.0), await_load),
        speed_limit=GUIDED_SPEED,
    )


def take_and_drop(rig: Rig) -> float:
    """Take 2 kg into the hand, have them carried, let go of them; return when."""
    wearer(rig, [{"load": DROPPED, "over": 0.1}, {"move": list(rig.pose), "over": TAKEN}, {"hold": 60.0}])
    compensator({"payload.mass": DROPPED})(rig)
    time.sleep(TAKEN + 2.0)
    start = time.time()
    wearer(rig, [{"load": 0.0, "over": 60.0}])
    time.sleep(MOTION)
    return start


def load_is_withdrawn(rig: Rig) -> None:
    """Check that the compensator has noticed that the hand is empty."""
    assert rig.probe.diagnostic("compensator", "payload mass (kg)") == "0.000"


ZERO_G, ONE_G = {"mode": "zero_g"}, {"mode": "one_g"}
HEAVIER, RIGHT = {"wearer.body_mass": 100.0}, {"wearer.body_mass": 75.0}
WEAK, RATED = {"max_effort": [0.5] * 4}, {"max_effort": [3.0, 9.0, 3.0, 3.0]}
SPRING = {"spring.stiffness": [4.0, 14.0, 7.0, 3.8], "spring.pose": [0.0, 0.0, -0.3, 1.3]}
NO_SPRING = {"spring.stiffness": [0.0] * 4}
# fmt: off
LOAD_CHANGES = (
    load_case("Zero-G to One-G, 75 kg", ONE_G, ZERO_G),
    load_case("body mass 75 to 100", HEAVIER, RIGHT),
    load_case("max_effort 9 to 0.5 Nm, Zero-G, 75 kg", WEAK, RATED),
    load_case("a spring of 14 Nm/rad, Zero-G, 75 kg", SPRING, NO_SPRING),
    load_case("support 1 to 0, 75 kg", {"support": 0.0}, {"support": 1.0}),
    load_case("V3 boards: Zero-G to One-G, 75 kg", ONE_G, ZERO_G, V3WearerRig),
    FaultCase("a load of 2 kg is dropped, Zero-G, 75 kg", take_and_drop, LoadedRig, limit=None, outcomes=("active",),
              speed_limit=DROP_SPEED, afterwards=load_is_withdrawn),
)
ACTIVE_WEARER = (
    while_wearer("lifts", LIFT, 0.4),
    while_wearer("pushes down", PUSH_DOWN, 0.2),
    while_wearer("holds still", HOLD, 0.5),
    while_wearer("shakes the arm at 2 Hz", SHAKE, 1.0),
    while_wearer("reaches on and on", REACH, 1.0),
    # The thrown arm coasts upwards, and what carries it does the work of its weight on the way: 0.25 to 0.35 J.
    while_wearer("throws the arm", THROW, 0.2, energy_limit=0.5),
    while_wearer("presses it down from the horizontal", PRESS_DOWN, 0.1, RaisedRig),
)
# fmt: on
