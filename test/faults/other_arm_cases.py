# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix with arms that are not the paper's: each kind of cause once, on the files in config.

The elbow has one strong motor with a high gear. The seven joints have Damiao motors on CAN FD: those let go by
themselves when they report an error, or hear nothing for the time-out in their register. Their joint then falls.
"""

from __future__ import annotations

import math
import signal
from pathlib import Path
from typing import Any

import yaml

from ..support import CONFIG
from ..support.launched_nodes import SIMULATED
from .actions import (
    CONNECT,
    CUT,
    CUT_OFF,
    END_SILENCE,
    ERROR,
    FOREIGN,
    JUMP,
    NO_ERROR,
    RELEASE,
    SILENCE,
    commanding,
    enable,
    foreign_frames,
    in_turn,
    pause,
    refused_on_the_wrong_angle,
    send_signal,
)
from .bus_cases import OBSERVED, carries_again, stays_off
from .fault_case import PROCESS_REACTION, FaultCase
from .rig import Rig
from .rigs import TwoLaunchersRig, variant
from .wearer_cases import take_and_drop

KILL, STOP, CONTINUE = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT
LET_GO = 0.35  # s, just after the time-out of the Damiao motors
OFF = ("disabled", "stopped", "inactive")
ELBOW: dict[str, Any] = {"base": "elbow.yaml", "pose": (1.3,), "struck": 0}
SEVEN: dict[str, Any] = {
    "base": "seven_joints.yaml",
    "pose": (0.3, 1.1, 0.0, 0.4, 0.1, 0.1, -0.1),
    "struck": 1,
}
LOAD_LOST = 2.9  # rad/s


class SevenJointsRig(Rig):
    """The seven joints on a trunk with an IMU, at 100 Hz: with `imu` and `simulator` they fill two cores."""

    rate = 100.0
    pose, struck = SEVEN["pose"], SEVEN["struck"]

    def __init__(self, folder: Path, shipped_timeouts: bool = True) -> None:
        content, papers = (yaml.safe_load((CONFIG / base).read_text()) for base in (SEVEN["base"], "sim.yaml"))
        given = papers["/right/simulator"]["ros__parameters"]
        content["/imu"] = papers["/imu"]
        content["/right/simulator"]["ros__parameters"].update(imu=given["imu"], trunk=given["trunk"])
        content["/right/compensator"]["ros__parameters"].update(SIMULATED["compensator"], use_imu=True)
        self.base = str(folder / "seven_joints.yaml")
        Path(self.base).write_text(yaml.safe_dump(content))
        super().__init__(folder, shipped_timeouts)


def rows(name: str, arm: dict[str, Any], lets_go: bool) -> tuple[FaultCase, ...]:
    """Return the rows of an arm. arm: attributes of its rigs. lets_go: whether its motors have a time-out."""
    rig, two_launchers = variant(Rig, **arm), variant(TwoLaunchersRig, **arm)
    joints, struck = tuple(range(len(arm["pose"]))), (arm["struck"],)
    falls: dict[str, Any] = {"unpowered": joints, "damping_limit": math.inf} if lets_go else {}
    # fmt: off
    return (
        FaultCase(f"{name}: arm disabled", enable(False), rig, outcomes=OFF),
        FaultCase(f"{name}: a motor cut off from the bus", CUT_OFF, rig, clear=CONNECT, unreached=struck,
            steps_from=math.inf, outcomes=("motor_silent",), **falls),
        FaultCase(f"{name}: a motor reports an error", ERROR, rig, clear=NO_ERROR, afterwards=carries_again,
            outcomes=("motor_error",), steps_from=0.05 if lets_go else 0.0, **falls),
        FaultCase(f"{name}: bus silent for 3 s", in_turn(SILENCE, pause(3.0), END_SILENCE), rig, unreached=joints,
            steps_from=LET_GO if lets_go else 0.0, outcomes=("motor_silent",), **falls),
        FaultCase(f"{name}: supply cut for 2 s", in_turn(CUT, pause(2.0), RELEASE, pause(OBSERVED)), rig, clear=RELEASE,
            unpowered=joints, steps_from=0.1, check=stays_off, afterwards=carries_again),
        FaultCase(f"{name}: foreign 6 Nm to a motor, 500 a second for 2 s",
            foreign_frames(commanding(FOREIGN), 500.0, 2.0), rig, steps_from=2.1, outcomes=("foreign_command",),
            energy_limit=2.0),
        FaultCase(f"{name}: a joint jumps by a motor turn, then clear and enable", JUMP, rig,
            afterwards=refused_on_the_wrong_angle, outcomes=("position_jump", "over_speed")),
        FaultCase(f"{name}: can_bridge killed", send_signal("can_bridge", KILL), rig, PROCESS_REACTION),
        FaultCase(f"{name}: compensator frozen, the rest runs on", send_signal("compensator", STOP), two_launchers,
            clear=send_signal("compensator", CONTINUE), outcomes=("command_stale",)),
        FaultCase(f"{name}: compensator killed, the rest runs on", send_signal("compensator", KILL), two_launchers,
            ends_rig=True, outcomes=("command_stale",)),
    )
    # fmt: on


# fmt: off
OTHER_ARMS = (
    *rows("elbow, AK80-64", ELBOW, lets_go=False),
    # The rotor slows the empty arm so much that its loss is not detected: the brake alone holds it.
    FaultCase("elbow, AK80-64: a load of 2 kg is dropped", take_and_drop, variant(Rig, **ELBOW), limit=None,
        outcomes=("active",), speed_limit=LOAD_LOST, ends_rig=True),
    *rows("seven Damiao joints", SEVEN, lets_go=True),
    FaultCase("seven Damiao joints: imu frozen", send_signal("imu", STOP), SevenJointsRig, PROCESS_REACTION,
        clear=send_signal("imu", CONTINUE)),
)
# fmt: on
