"""Rows of the fault matrix with the motors on two buses, 1 and 2 on the first, 3 and 4 on the second."""

from __future__ import annotations

import signal

from ..support.launched_nodes import SECOND_GROUP
from .actions import has_refused, in_turn, pause, run_bridge, send_signal, signal_bridge_and_watchdog, simulator
from .fault_case import PROCESS_REACTION, FaultCase
from .rig import Rig
from .rigs import TwoBusRig, TwoBusV3Rig
from .supply_cases import CUT, supply_case

DEAD = simulator(fault__cut_off=[False, False, True, True])
ALIVE = simulator(fault__cut_off=[False] * 4)
RECOVERY = 6.0  # s in which the launcher brings down an arm that has lost its bridge and its watchdog
FAR = (2, 3)


def start_on_the_second_bus(rig: Rig) -> None:
    """Start a bridge whose motors are all on the second bus."""
    port = rig.nodes[0].bus["port"] + 1
    options = {"port": port, "hop_limit": 0}
    bus = {"interface": "udp_multicast", "channel": SECOND_GROUP, "options": options}
    rig.second_bridge = run_bridge(rig, "/second", changes={"can": bus})


# fmt: off
TWO_BUSES = (
    FaultCase("two buses: the second dead until the arm is given up", DEAD, TwoBusRig, clear=ALIVE, unreached=FAR,
        outcomes=("motor_silent",)),
    FaultCase("two buses: can_bridge killed", send_signal("can_bridge", signal.SIGKILL), TwoBusRig, PROCESS_REACTION),
    FaultCase("two buses: can_bridge and watchdog killed", signal_bridge_and_watchdog(signal.SIGKILL), TwoBusRig,
        RECOVERY),
    FaultCase("two buses: another can_bridge on the second", start_on_the_second_bus, TwoBusRig, None,
        outcomes=("active",), afterwards=has_refused),
    supply_case("two buses: supply cut for 2 s", in_turn(CUT, pause(2.0)), TwoBusRig),
    FaultCase("two buses, V3 boards: the second dead for 3 s", in_turn(DEAD, pause(3.0), ALIVE), TwoBusV3Rig,
        unreached=FAR, outcomes=("motor_silent",)),
    FaultCase("two buses, V3 boards: can_bridge killed", send_signal("can_bridge", signal.SIGKILL), TwoBusV3Rig,
        PROCESS_REACTION),
)
# fmt: on
