# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows of the fault matrix whose subject is a process, a signal, a lock or a message: with real processes."""

from __future__ import annotations

import math
import signal

from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import Imu, JointState

from .actions import (
    ERROR,
    NO_ERROR,
    deactivate,
    has_refused,
    in_turn,
    kill_bridge_with_frozen_watchdog,
    let_step_fail,
    overload_processors,
    pause,
    publish,
    random_frames,
    raw_imu,
    record_on_a_full_disk,
    send_signal,
    set_contradicting_parameters,
    set_impossible_parameters,
    signal_bridge_and_watchdog,
    signal_watchdog,
    simulator,
    start_second_bridge,
    states_at,
    tilt,
    trunk_imu,
)
from .bus_cases import OWNERSHIP, TWO_BUSES, V3_BOARDS
from .command_cases import CLOCK, EFFORT_COMMANDS
from .fault_case import PROCESS_REACTION, RECOVERY, FaultCase
from .person_cases import REQUESTS
from .rig import Rig
from .rigs import (
    BothArmsRig,
    BowRig,
    FailingStepRig,
    LauncherRig,
    LeastFrictionRig,
    SignCheckRig,
    TwoLaunchersRig,
    WearerRig,
    variant,
)

STATES, EFFORTS, TILT, RAW_IMU = "/right/joint_states", "/right/effort_commands", "/imu/pitch_yaw", "/imu/data_raw"
TRUNK_IMU = "/imu/data"
HELD = ("active",)
OFF = ("disabled", "stopped", "inactive")
KILL, STOP, CONTINUE, TERMINATE, INTERRUPT = (
    signal.SIGKILL,
    signal.SIGSTOP,
    signal.SIGCONT,
    signal.SIGTERM,
    signal.SIGINT,
)


def left_arm_is_carried(rig: BothArmsRig) -> None:
    assert rig.left.state == "active", f"the left arm is {rig.left.state}"


# fmt: off
HELD_ROWS = (
    FaultCase("NaN joint states", publish(JointState, STATES, states_at([math.nan] * 4)), limit=None),
    FaultCase("NaN tilt", publish(Vector3Stamped, TILT, tilt(math.nan)), limit=None),
    FaultCase("NaN orientation of the trunk", publish(Imu, TRUNK_IMU, trunk_imu(math.nan, 1.0)), limit=None),
    FaultCase("impossible parameters", set_impossible_parameters, limit=None, outcomes=HELD),
    FaultCase("parameters that contradict each other", set_contradicting_parameters, limit=None, outcomes=HELD),
    FaultCase("second can_bridge on the bus", start_second_bridge("/second"), limit=None, outcomes=HELD,
        afterwards=has_refused),
    FaultCase("disk full for the recorder", record_on_a_full_disk, limit=None, outcomes=HELD),
    FaultCase("30,000 random frames", random_frames(30_000, (0, *range(5, 2048))), limit=None),  # 1-4: the motors
    FaultCase("foreign frames, 3,000 a second", random_frames(15_000, range(0x100, 0x200)), limit=None),
    FaultCase("processors overloaded", overload_processors, limit=None),
)
MESSAGES = (
    FaultCase("second publisher of joint states", publish(JointState, STATES, states_at([1.0] * 4))),
    FaultCase("second publisher of the tilt", publish(Vector3Stamped, TILT, tilt(1.0))),
    FaultCase("second publisher of the trunk's orientation", publish(Imu, TRUNK_IMU, trunk_imu(0.6, 0.8))),
    FaultCase("second publisher of the raw IMU", publish(Imu, RAW_IMU, raw_imu), limit=0.3),
)
DESCENT = (
    FaultCase("can_bridge killed while let down", send_signal("can_bridge", KILL), limit=PROCESS_REACTION,
        stage="letting down"),
)
START = (
    FaultCase("imu frozen while ramping in", send_signal("imu", STOP), SignCheckRig, PROCESS_REACTION, "ramping in",
        clear=send_signal("imu", CONTINUE)),
    FaultCase("can_bridge killed while proving", send_signal("can_bridge", KILL), SignCheckRig, PROCESS_REACTION,
        "proving signs"),
    FaultCase("can_bridge killed while ramping in", send_signal("can_bridge", KILL), SignCheckRig, PROCESS_REACTION,
        "ramping in"),
)
PROCESSES = (
    FaultCase("imu frozen", send_signal("imu", STOP), limit=PROCESS_REACTION, clear=send_signal("imu", CONTINUE)),
    FaultCase("can_bridge deactivated", deactivate, outcomes=OFF, ends_rig=True),
    FaultCase("watchdog frozen", signal_watchdog(STOP), limit=0.6, clear=signal_watchdog(CONTINUE),
        outcomes=("watchdog_dead",), ends_rig=True),
    FaultCase("watchdog killed", signal_watchdog(KILL), limit=PROCESS_REACTION, outcomes=("watchdog_dead",),
        ends_rig=True),
    FaultCase("can_bridge and watchdog frozen for 1 s",
        in_turn(signal_bridge_and_watchdog(STOP), pause(1.0), signal_bridge_and_watchdog(CONTINUE)),
        limit=1.0 + PROCESS_REACTION, ends_rig=True),
    FaultCase("compensator killed", send_signal("compensator", KILL), limit=PROCESS_REACTION),
    FaultCase("imu killed", send_signal("imu", KILL), limit=PROCESS_REACTION),
    FaultCase("can_bridge killed", send_signal("can_bridge", KILL), limit=PROCESS_REACTION),
    FaultCase("can_bridge killed and started again at once",
        in_turn(send_signal("can_bridge", KILL), start_second_bridge("/right")), limit=PROCESS_REACTION,
        afterwards=has_refused),
    FaultCase("can_bridge frozen", send_signal("can_bridge", STOP), limit=PROCESS_REACTION),
    FaultCase("can_bridge terminated", send_signal("can_bridge", TERMINATE), limit=PROCESS_REACTION),
    FaultCase("can_bridge killed, its watchdog frozen for 1 s", kill_bridge_with_frozen_watchdog(1.0),
        limit=1.0 + PROCESS_REACTION),
    FaultCase("can_bridge and watchdog killed", signal_bridge_and_watchdog(KILL), limit=RECOVERY),
    FaultCase("second publisher of efforts", publish(JointState, EFFORTS, lambda rig: rig.probe.effort_commands[-1]),
        TwoLaunchersRig, outcomes=("second_commander",)),
    FaultCase("compensator killed, the rest runs on", send_signal("compensator", KILL), TwoLaunchersRig,
        ends_rig=True, outcomes=("command_stale",)),
    FaultCase("compensator's step never returns", let_step_fail("sleep"), FailingStepRig, ends_rig=True,
        outcomes=("command_stale",)),
    FaultCase("launcher killed", lambda rig: rig.launcher.kill(), LauncherRig, PROCESS_REACTION),
    FaultCase("launcher interrupted", lambda rig: rig.launcher.send_signal(INTERRUPT), LauncherRig, PROCESS_REACTION),
    FaultCase("can_bridge killed, the launcher frozen",
        in_turn(lambda rig: rig.launcher.send_signal(STOP), send_signal("can_bridge", KILL)), LauncherRig,
        PROCESS_REACTION, clear=lambda rig: rig.launcher.send_signal(CONTINUE)),
)
ARMS = (
    FaultCase("can_bridge killed, friction 0.01 Nm", send_signal("can_bridge", KILL), LeastFrictionRig,
        PROCESS_REACTION),
    FaultCase("trunk bows past 90 degrees", in_turn(simulator(trunk__pitch=1.9), pause(4.5)), BowRig, None,
        outcomes=HELD, clear=in_turn(simulator(trunk__pitch=0.1), pause(4.0))),
    FaultCase("can_bridge killed, Zero-G, 75 kg", send_signal("can_bridge", KILL), WearerRig, PROCESS_REACTION),
    FaultCase("motor 2 of the right of two arms reports an error", ERROR, BothArmsRig, clear=NO_ERROR,
        afterwards=left_arm_is_carried, outcomes=("motor_error",)),
    FaultCase("can_bridge of the right of two arms killed", send_signal("can_bridge", KILL), BothArmsRig,
        PROCESS_REACTION),
)
OTHER_ARMS = (  # one strong motor with a high gear; Damiao motors on CAN FD
    FaultCase("elbow, AK80-64: can_bridge killed", send_signal("can_bridge", KILL),
        variant(Rig, base="elbow.yaml", pose=(1.3,), struck=0), PROCESS_REACTION),
    FaultCase("seven Damiao joints: can_bridge killed", send_signal("can_bridge", KILL),
        variant(Rig, base="seven_joints.yaml", pose=(0.3, 1.1, 0.0, 0.4, 0.1, 0.1, -0.1)), PROCESS_REACTION),
)
# fmt: on
CASES = (
    *(*HELD_ROWS, *MESSAGES, *DESCENT, *START, *PROCESSES, *EFFORT_COMMANDS, *CLOCK, *ARMS, *V3_BOARDS),
    *(*OWNERSHIP, *TWO_BUSES, *REQUESTS, *OTHER_ARMS),
)
