# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the fault matrix about buses, boards and the supply.

Who owns a bus: other sessions, silent motors handed over, a closed terminal. V3 boards reply to nothing, send their
state by themselves, and have no ENTER. Motors on two buses: 1 and 2 on the first, 3 and 4 on the second. Where the
supply of all motors is switched, they stay off until the arm is enabled.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import time

from exo_gravity.core.motors.ak import MIT_V3
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.descent import DESCENT

from ..support.launched_nodes import SECOND_GROUP
from ..support.ros_probe import Timeout
from .actions import (
    CUT,
    END_SILENCE,
    FOREIGN,
    RELEASE,
    SILENCE,
    foreign_frames,
    has_refused,
    in_turn,
    pause,
    run_bridge,
    second_bridge,
    send_signal,
    signal_bridge_and_watchdog,
    simulator,
)
from .fault_case import ALL_JOINTS, PROCESS_REACTION, RECOVERY, Action, FaultCase
from .rig import Rig
from .rigs import HandedOverRig, LauncherRig, TwoBusRig, TwoBusV3Rig, V3Rig
from .virtual_cases import stays_off

# s after which a watchdog has faded the torque of motors that do not reply, and hands the bus over
GIVEN_UP = DESCENT.blind_hold + DESCENT.blind_fade_time + 1.0
START_LIMIT = 20.0  # s for the next bridge to start and to take the bus over, or to be refused
OBSERVED = 3.0  # s after the release
DEAD = simulator(fault__cut_off=[False, False, True, True])
ALIVE = simulator(fault__cut_off=[False] * 4)
FAR = (2, 3)
V3_MOTOR_2 = JointMotor(MIT_V3.ranged(MOTORS["AK80-9"]), 2, direction=-1, wire_format=MIT_V3)
KILL, HANG_UP = signal.SIGKILL, signal.SIGHUP


def start_in_another_session(rig: Rig) -> None:
    """Start a bridge as another user of the bus: it shares no folder with the first one."""
    folder = rig.folder / "another_session"
    folder.mkdir(exist_ok=True)
    names = ("XDG_RUNTIME_DIR", "HOME", "TMPDIR", "XDG_CACHE_HOME")
    rig.second_bridge = run_bridge(rig, "/second", environment=dict.fromkeys(names, str(folder)))


def start_with_silent_motors(rig: HandedOverRig) -> None:
    """Leave the watchdog alone with motors that do not reply; they reply again once the next bridge has the bus."""
    SILENCE(rig)
    bridge = rig.pid("can_bridge")
    rig.launcher.kill()
    os.kill(bridge, signal.SIGKILL)
    time.sleep(GIVEN_UP)
    with rig.log_of_next.open("w") as log:
        rig.next_bridge = second_bridge(rig, "/right", stdout=log, stderr=subprocess.STDOUT)
    with contextlib.suppress(Timeout):  # then it was refused
        rig.probe.wait_until(lambda: "letting the arm down" in rig.log_of_next.read_text(), START_LIMIT)
    END_SILENCE(rig)


def next_bridge_let_it_down(rig: HandedOverRig) -> None:
    log = rig.log_of_next.read_text()
    assert "the arm is down, its motors are off" in log, f"the next bridge did not let the arm down: {log[-300:]}"


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


def start_on_the_second_bus(rig: Rig) -> None:
    """Start a bridge whose motors are all on the second bus."""
    port = rig.nodes[0].bus["port"] + 1
    options = {"port": port, "hop_limit": 0}
    bus = {"interface": "udp_multicast", "channel": SECOND_GROUP, "options": options}
    rig.second_bridge = run_bridge(rig, "/second", changes={"can": bus})


# fmt: off
OWNERSHIP = (
    FaultCase("can_bridge of another session on the bus", start_in_another_session, limit=None, outcomes=("active",),
        afterwards=has_refused),
    # Motors that were cut off for so long drop, under full damping, what has faded meanwhile: no frame tells before.
    FaultCase("motors silent for long, then the next can_bridge", start_with_silent_motors, HandedOverRig, limit=None,
        unreached=ALL_JOINTS, steps_from=math.inf, afterwards=next_bridge_let_it_down, ends_rig=True),
    FaultCase("can_bridge: SIGHUP", send_signal("can_bridge", HANG_UP), limit=PROCESS_REACTION),
    FaultCase("launcher's terminal closed", lambda rig: rig.launcher.send_signal(HANG_UP), LauncherRig,
        PROCESS_REACTION),
)
V3_BOARDS = (
    FaultCase("V3 boards: foreign 6 Nm to motor 2, 500 a second for 2 s",
        foreign_frames(lambda rig: (V3_MOTOR_2.command_id, V3_MOTOR_2.command(FOREIGN, 0.0)), 500.0, 2.0), V3Rig,
        steps_from=2.1, outcomes=("foreign_command",), energy_limit=2.0),
    FaultCase("V3 boards: can_bridge killed", send_signal("can_bridge", KILL), V3Rig, PROCESS_REACTION),
)
TWO_BUSES = (
    FaultCase("two buses: the second dead until the arm is given up", DEAD, TwoBusRig, clear=ALIVE, unreached=FAR,
        outcomes=("motor_silent",)),
    FaultCase("two buses: can_bridge killed", send_signal("can_bridge", KILL), TwoBusRig, PROCESS_REACTION),
    FaultCase("two buses: can_bridge and watchdog killed", signal_bridge_and_watchdog(KILL), TwoBusRig,
        RECOVERY),
    FaultCase("two buses: another can_bridge on the second", start_on_the_second_bus, TwoBusRig, None,
        outcomes=("active",), afterwards=has_refused),
    supply_case("two buses: supply cut for 2 s", in_turn(CUT, pause(2.0)), TwoBusRig),
    FaultCase("two buses, V3 boards: the second dead for 3 s", in_turn(DEAD, pause(3.0), ALIVE), TwoBusV3Rig,
        unreached=FAR, outcomes=("motor_silent",)),
    FaultCase("two buses, V3 boards: can_bridge killed", send_signal("can_bridge", KILL), TwoBusV3Rig,
        PROCESS_REACTION),
)
# fmt: on
