# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the fault matrix whose subject is a process, a signal, a lock, DDS or a watchdog: with real processes."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import time

from geometry_msgs.msg import Vector3Stamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import Imu, JointState

from exo_gravity.core.motors.ak import MIT_V3
from exo_gravity.core.motors.families import MOTORS
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.safety.descent import DESCENT

from ..support.ros_probe import Timeout
from .actions import (
    END_SILENCE,
    SILENCE,
    foreign_frames,
    has_refused,
    kill_bridge_with_frozen_watchdog,
    overload_processors,
    pause,
    publish,
    random_frames,
    run_bridge,
    second_bridge,
    send_signal,
    signal_bridge_and_watchdog,
    signal_watchdog,
    start_second_bridge,
    states_at,
    tilt,
    trunk_imu,
)
from .fault_case import ALL_JOINTS, PROCESS_REACTION, RECOVERY, Action, FaultCase, in_turn
from .rig import Rig
from .rigs import (
    BothArmsRig,
    ExternalClockRig,
    HandedOverRig,
    LauncherRig,
    SevenRig,
    SignCheckRig,
    TwoBusRig,
    TwoLaunchersRig,
    V3Rig,
)
from .virtual_cases import FOREIGN

STATES, EFFORTS, TILT, TRUNK_IMU = "/right/joint_states", "/right/effort_commands", "/imu/pitch_yaw", "/imu/data"
HELD = ("active",)
KILL, STOP, CONTINUE, HANG_UP = signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGHUP
# s after which a watchdog has faded the torque of motors that do not reply, and hands the bus over
GIVEN_UP = DESCENT.blind_hold + DESCENT.blind_fade_time + 1.0
START_LIMIT = 20.0  # s for the next bridge to start and to take the bus over, or to be refused
OBSERVED = 4.0  # s
V3_MOTOR_2 = JointMotor(MIT_V3.ranged(MOTORS["AK80-9"]), 2, direction=-1, wire_format=MIT_V3)
KILL_BRIDGE = send_signal("can_bridge", KILL)


def set_clock(seconds: float) -> Action:
    """Set the clock of bridge and compensator by `seconds`."""
    return lambda rig: setattr(rig, "clock_offset", seconds)


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


def activate_while_deactivating(rig: Rig) -> float:
    """Deactivate the bridge, and activate it meanwhile without waiting for either answer."""
    start = time.time()
    client = rig.probe.node.create_client(ChangeState, "/right/can_bridge/change_state")
    rig.probe.wait_until(client.service_is_ready)
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        client.call_async(ChangeState.Request(transition=Transition(id=transition)))
        time.sleep(0.3)
    rig.probe.wait_until(rig.truth.motors_are_off)
    time.sleep(OBSERVED)
    return start


# fmt: off
BUS = (
    FaultCase("second can_bridge on the bus", start_second_bridge("/second"), limit=None, outcomes=HELD,
        afterwards=has_refused),
    FaultCase("can_bridge of another session on the bus", start_in_another_session, limit=None, outcomes=HELD,
        afterwards=has_refused),
    FaultCase("30,000 random frames", random_frames(30_000, (0, *range(5, 2048))), limit=None),  # 1-4: the motors
    FaultCase("V3 boards: foreign 6 Nm to motor 2, 500 a second for 2 s",
        foreign_frames(lambda rig: (V3_MOTOR_2.command_id, V3_MOTOR_2.command(FOREIGN, 0.0)), 500.0, 2.0), V3Rig,
        steps_from=2.1, outcomes=("foreign_command",), energy_limit=2.0),
)
MESSAGES = (
    FaultCase("clock set back an hour", set_clock(-3600.0), ExternalClockRig, None, outcomes=HELD),
    FaultCase("clock set ahead an hour", set_clock(3600.0), ExternalClockRig, None, outcomes=HELD),
    FaultCase("second publisher of joint states", publish(JointState, STATES, states_at([1.0] * 4))),
    FaultCase("second publisher of the tilt", publish(Vector3Stamped, TILT, tilt(1.0))),
    FaultCase("second publisher of the trunk's orientation", publish(Imu, TRUNK_IMU, trunk_imu(0.6, 0.8))),
    FaultCase("second publisher of efforts", publish(JointState, EFFORTS, lambda rig: rig.probe.effort_commands[-1]),
        TwoLaunchersRig, outcomes=("second_commander",)),
)
PROCESSES = (
    FaultCase("processors overloaded", overload_processors, limit=None),
    FaultCase("imu frozen", send_signal("imu", STOP), limit=PROCESS_REACTION, clear=send_signal("imu", CONTINUE)),
    FaultCase("compensator killed", send_signal("compensator", KILL), limit=PROCESS_REACTION),
    FaultCase("compensator killed, the rest runs on", send_signal("compensator", KILL), TwoLaunchersRig,
        ends_rig=True, outcomes=("command_stale",)),
    FaultCase("can_bridge frozen", send_signal("can_bridge", STOP), limit=PROCESS_REACTION),
    FaultCase("can_bridge terminated", send_signal("can_bridge", signal.SIGTERM), limit=PROCESS_REACTION),
    FaultCase("can_bridge: SIGHUP", send_signal("can_bridge", HANG_UP), limit=PROCESS_REACTION),
    FaultCase("activate, abandoned while can_bridge deactivates", activate_while_deactivating,
        outcomes=("disabled", "inactive", "stopped"), ends_rig=True),
    FaultCase("launcher killed", lambda rig: rig.launcher.kill(), LauncherRig, PROCESS_REACTION),
    FaultCase("launcher interrupted", lambda rig: rig.launcher.send_signal(signal.SIGINT), LauncherRig,
        PROCESS_REACTION),
    FaultCase("launcher's terminal closed", lambda rig: rig.launcher.send_signal(HANG_UP), LauncherRig,
        PROCESS_REACTION),
)
WATCHDOG = (
    FaultCase("watchdog frozen", signal_watchdog(STOP), limit=0.6, clear=signal_watchdog(CONTINUE),
        outcomes=("watchdog_dead",), ends_rig=True),
    FaultCase("watchdog killed", signal_watchdog(KILL), limit=PROCESS_REACTION, outcomes=("watchdog_dead",),
        ends_rig=True),
    FaultCase("can_bridge and watchdog frozen for 1 s",
        in_turn(signal_bridge_and_watchdog(STOP), pause(1.0), signal_bridge_and_watchdog(CONTINUE)),
        limit=1.0 + PROCESS_REACTION, ends_rig=True),
    FaultCase("can_bridge and watchdog killed", signal_bridge_and_watchdog(KILL), limit=RECOVERY),
    # Motors that were cut off for so long drop, under full damping, what has faded meanwhile: no frame tells before.
    FaultCase("motors silent for long, then the next can_bridge", start_with_silent_motors, HandedOverRig, limit=None,
        unreached=ALL_JOINTS, steps_from=math.inf, afterwards=next_bridge_let_it_down, ends_rig=True),
    FaultCase("can_bridge killed", KILL_BRIDGE, limit=PROCESS_REACTION),
    FaultCase("can_bridge killed while let down", KILL_BRIDGE, limit=PROCESS_REACTION, stage="letting down"),
    FaultCase("can_bridge killed while proving", KILL_BRIDGE, SignCheckRig, PROCESS_REACTION, "proving signs"),
    FaultCase("can_bridge killed and started again at once", in_turn(KILL_BRIDGE, start_second_bridge("/right")),
        limit=PROCESS_REACTION, afterwards=has_refused),
    FaultCase("can_bridge killed, its watchdog frozen for 1 s", kill_bridge_with_frozen_watchdog(1.0),
        limit=1.0 + PROCESS_REACTION),
    FaultCase("can_bridge killed, the launcher frozen",
        in_turn(lambda rig: rig.launcher.send_signal(STOP), KILL_BRIDGE), LauncherRig, PROCESS_REACTION,
        clear=lambda rig: rig.launcher.send_signal(CONTINUE)),
    FaultCase("can_bridge of the right of two arms killed", KILL_BRIDGE, BothArmsRig, PROCESS_REACTION),
    FaultCase("V3 boards: can_bridge killed", KILL_BRIDGE, V3Rig, PROCESS_REACTION),
    FaultCase("two buses: can_bridge killed", KILL_BRIDGE, TwoBusRig, PROCESS_REACTION),
    FaultCase("seven Damiao joints: can_bridge killed", KILL_BRIDGE, SevenRig, PROCESS_REACTION),
)
# fmt: on
CASES = (*BUS, *MESSAGES, *PROCESSES, *WATCHDOG)
