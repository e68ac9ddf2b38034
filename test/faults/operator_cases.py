"""Rows of the fault matrix in which an operator changes the load of an arm that a passive wearer hangs in."""

from __future__ import annotations

import time
from typing import Any, ClassVar

from sensor_msgs.msg import JointState

from ..support.launched_nodes import Parameters
from .actions import in_turn, pause
from .command_cases import change_message
from .fault_case import Action, FaultCase
from .rig import Rig
from .rigs import CommandedRig, V3Rig, WearerRig
from .wearer_cases import begin

GUIDED_SPEED = 0.6  # rad/s
MOTION = 8.0  # s until an arm that became heavy hangs
PEAK = [9.0, 18.0, 9.0, 9.0]  # Nm
DROPPED, TAKEN = 2.0, 7.0  # kg, and s in which the motors take them
DROP_SPEED = 4.8  # rad/s, below which no joint is a fault
SPRING = {"spring.stiffness": [4.0, 14.0, 7.0, 3.8], "spring.pose": [0.0, 0.0, -0.3, 1.3]}
NO_SPRING = {"spring.stiffness": [0.0] * 4}


class V3WearerRig(WearerRig):
    """The same wearer in an arm with V3 boards."""

    bridge: ClassVar[Parameters] = V3Rig.bridge
    simulator: ClassVar[Parameters] = {**WearerRig.simulator, **V3Rig.simulator}


def compensator(values: dict[str, Any]) -> Action:
    """Set parameters of the compensator together."""

    def inject(rig: Rig) -> None:
        named = {name.replace(".", "__"): value for name, value in values.items()}
        result = rig.probe.set_parameters("compensator", atomically=True, **named)
        assert result.successful, result.reason

    return inject


def await_load(rig: Rig) -> None:
    """Wait until the load has changed: an arm that still sinks takes longer, and no hand may move it meanwhile."""
    rig.probe.wait_until(lambda: rig.probe.diagnostic("compensator", "changing load") == "none")


def load_case(name: str, change: dict[str, Any], back: dict[str, Any], rig: type[Rig] = WearerRig) -> FaultCase:
    return FaultCase(
        name,
        in_turn(compensator(change), pause(MOTION)),
        rig,
        limit=None,
        outcomes=("active",),
        clear=in_turn(compensator(back), pause(3.0), await_load),
        speed_limit=GUIDED_SPEED,
    )


def _ask_for_speed(message: JointState) -> None:
    message.velocity = [0.5] * 4


class LoadedRig(WearerRig):
    """The same wearer with a load in his hand, for which the motors use their peak torque."""

    bridge: ClassVar[Parameters] = {"max_effort": PEAK}
    compensator: ClassVar[Parameters] = {**WearerRig.compensator, "max_effort": PEAK}


def take_and_drop(rig: Rig) -> float:
    """Take 2 kg into the hand, have them carried, let go of them; return when."""
    begin(rig, [{"load": DROPPED, "over": 0.1}, {"move": list(rig.pose), "over": TAKEN}, {"hold": 60.0}])
    compensator({"payload.mass": DROPPED})(rig)
    time.sleep(TAKEN + 2.0)
    start = time.time()
    begin(rig, [{"load": 0.0, "over": 60.0}])
    time.sleep(MOTION)
    rig.probe.wait_until(lambda: rig.probe.diagnostic("compensator", "payload mass (kg)") == "0.000")
    return start


ZERO_G, ONE_G = {"mode": "zero_g"}, {"mode": "one_g"}
HEAVIER, RIGHT = {"wearer.body_mass": 100.0}, {"wearer.body_mass": 75.0}
WEAK, RATED = {"max_effort": [0.5] * 4}, {"max_effort": [3.0, 9.0, 3.0, 3.0]}
# fmt: off
OPERATOR = (
    load_case("Zero-G to One-G, 75 kg", ONE_G, ZERO_G),
    load_case("body mass 75 to 100", HEAVIER, RIGHT),
    load_case("max_effort 9 to 0.5 Nm, Zero-G, 75 kg", WEAK, RATED),
    load_case("a spring of 14 Nm/rad, Zero-G, 75 kg", SPRING, NO_SPRING),
    load_case("support 1 to 0, 75 kg", {"support": 0.0}, {"support": 1.0}),
    load_case("V3 boards: Zero-G to One-G, 75 kg", ONE_G, ZERO_G, V3WearerRig),
    FaultCase("a load of 2 kg is dropped, Zero-G, 75 kg", take_and_drop, LoadedRig, limit=None, outcomes=("active",),
              speed_limit=DROP_SPEED),
    FaultCase(
        "efforts with a velocity", change_message(_ask_for_speed), CommandedRig, outcomes=("command_impossible",)
    ),
)
# fmt: on
