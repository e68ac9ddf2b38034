"""Rows of the fault matrix in which the supply of all motors is switched: they stay off until the arm is enabled."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np

from ..support.launched_nodes import Parameters
from .actions import in_turn, pause, simulator
from .fault_case import ALL_JOINTS, Action, FaultCase
from .rig import Rig
from .rigs import SignCheckRig, V3Rig

CUT = simulator(fault__unplugged=[True] * 4)
RELEASE = simulator(fault__unplugged=[False] * 4)
OBSERVED = 3.0  # s after the release


def clear(rig: Rig) -> None:
    """Clear the fault while the supply is off: the motors may still be letting down, as far as the bridge knows."""
    rig.probe.wait_until(lambda: rig.probe.state == "fault", 10.0)
    assert rig.probe.trigger("clear_fault").success


def stays_off(records: np.ndarray) -> str:
    """Return what is wrong if a motor is on later than the cut."""
    since = records["time"] - records["time"][0]
    on = records["on"][since > 0.1].any(axis=0)
    return f"motor {int(np.argmax(on)) + 1} was on after the cut" if on.any() else ""


def carries_again(rig: Rig) -> None:
    """Check that clear and enable, after the release, carry the arm again."""
    rig.probe.get_carried()
    start = time.time()
    rig.probe.wait_until(lambda: time.time() > start + 1.0)
    assert rig.probe.state == "active", f"enabled again, the arm is {rig.probe.state}"


def supply_case(name: str, inject: Action, rig: type[Rig]) -> FaultCase:
    """A row whose arm falls, because it has no power, and whose motors must then be off for good."""
    return FaultCase(
        name,
        in_turn(inject, RELEASE, pause(OBSERVED)),
        rig,
        clear=RELEASE,
        unpowered=ALL_JOINTS,
        steps_from=0.1,
        check=stays_off,
        afterwards=carries_again,
    )


class ShortEnableRig(SignCheckRig):
    """An enable expires after 2 s."""

    bridge: ClassVar[Parameters] = {"sign_check_torque": 1.5, "enable_timeout": 2.0}


def expired(rig: Rig) -> None:
    """Check that the bridge says why the enable was refused."""
    refusal = rig.probe.diagnostic("can_bridge", "refusal") or ""
    assert refusal.startswith("not enabled within 2 s"), f"refusal: {refusal}"


# fmt: off
SUPPLY = (
    FaultCase("enabled, and the supply cut for 4 s while checking", in_turn(CUT, pause(4.0), RELEASE, pause(OBSERVED)),
        ShortEnableRig, stage="checking", clear=RELEASE, afterwards=expired, outcomes=("disabled",)),
    supply_case("supply cut for 2 s", in_turn(CUT, pause(2.0)), Rig),
    supply_case("supply cut for 30 s, cleared meanwhile", in_turn(CUT, pause(15.0), clear, pause(15.0)), Rig),
    supply_case("V3 boards: supply cut for 2 s", in_turn(CUT, pause(2.0)), V3Rig),
    supply_case("V3 boards: supply cut for 30 s, cleared meanwhile", in_turn(CUT, pause(15.0), clear, pause(15.0)),
        V3Rig),
    supply_case("V3 boards: supply cut for 3 s, motor 2 back 6 s before the others",
        in_turn(CUT, pause(3.0), simulator(fault__unplugged=[True, False, True, True]), pause(6.0)), V3Rig),
)
# fmt: on
