# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The fault matrix: each fault, when it occurs, and how soon the arm must be let down."""

from __future__ import annotations

import math
import signal

import numpy as np
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import Imu, JointState

from exo_gravity.core.motors.frames import EXIT, SET_ZERO

from .actions import (
    CONNECT,
    CUT_OFF,
    END_SILENCE,
    ERROR,
    FOREIGN,
    JUMP,
    NO_ERROR,
    NO_JUMP,
    RESTART,
    RESTARTED,
    SHORT_RESTART,
    SILENCE,
    at_struck,
    commanding,
    deactivate,
    enable,
    foreign_frames,
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
    refused_on_the_wrong_angle,
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
    wearer,
)
from .bus_cases import OWNERSHIP, SUPPLY, TWO_BUSES, V3_BOARDS
from .command_cases import CLOCK, EFFORT_COMMANDS, MONITOR, RIDES
from .fault_case import ALL_JOINTS, PROCESS_REACTION, RECOVERY, FaultCase
from .other_arm_cases import OTHER_ARMS
from .outer_loop_cases import LEASES, OUTER_LOOP
from .person_cases import CONNECTIONS, FIRMWARE, REQUESTS
from .rig import Rig
from .rigs import (
    BothArmsRig,
    BowRig,
    FailingStepRig,
    HighFrictionRig,
    LauncherRig,
    LeastFrictionRig,
    LowFrictionRig,
    SignCheckRig,
    TwoLaunchersRig,
    WallRig,
    WearerRig,
)
from .wearer_cases import ACTIVE_WEARER, LOAD_CHANGES

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


def not_thrown_back(records: np.ndarray) -> str:
    """Return what is wrong if the elbow leaves the wall faster than a fifth of its speed into the wall.

    In virtual time, after this push, it leaves at 0.02 of that speed; at 0.30 where the wall has no damping.
    """
    velocity = records["velocity"][:, 3]
    inward = int(np.argmax(velocity))
    into, back = float(velocity[inward]), float(-velocity[inward:].min())
    if into < 1.0:
        return f"the push reached only {into:.1f} rad/s"
    return f"thrown back at {back:.1f} after {into:.1f} rad/s" if back > 0.2 * into else ""


def push_elbow(rig: Rig) -> None:
    wearer(rig, [{"push": [0.0, 0.0, 0.0, 0.5], "over": 0.2}, {"hold": 600.0}])


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
MOTORS = (
    FaultCase("arm disabled", enable(False), outcomes=OFF),
    # Reached again so late, a motor drops what it held at the first command, under full damping: its motion is judged.
    FaultCase("motor 2 cut off from the bus", CUT_OFF, clear=CONNECT, unreached=(1,), steps_from=math.inf,
        outcomes=("motor_silent",)),
    # The joint falls onto its mechanical stop: for 2 ms the other motors' damping opposes an impact of 3 to 5 rad/s.
    FaultCase("motor 2 without power", simulator(fault__unplugged=at_struck(True)), clear=RESTARTED,
        unpowered=ALL_JOINTS, steps_from=0.05, damping_limit=math.inf, outcomes=("motor_silent",)),
    FaultCase("motor 2 restarts in 30 ms", RESTART, clear=RESTARTED, steps_from=0.3,
        outcomes=("torque_not_delivered", "motor_silent")),
    FaultCase("bus silent until the arm is given up", SILENCE, clear=END_SILENCE, unreached=ALL_JOINTS,
        steps_from=math.inf, outcomes=("motor_silent",)),
    FaultCase("bus silent for 3 s", in_turn(SILENCE, pause(3.0), END_SILENCE), unreached=ALL_JOINTS,
        outcomes=("motor_silent",)),
    FaultCase("motor 2 reports an error", ERROR, clear=NO_ERROR, outcomes=("motor_error",)),
    FaultCase("motor 2 at 95 degC", simulator(fault__temperature=[30.0, 95.0, 30.0, 30.0]),
        clear=simulator(fault__temperature=[30.0] * 4), outcomes=("over_temperature",)),
    FaultCase("joint 2 jumps by a motor turn, then clear and enable", JUMP, afterwards=refused_on_the_wrong_angle,
        clear=lambda rig: None, outcomes=("position_jump", "over_speed")),
    FaultCase("foreign EXIT to motor 2, once", foreign_frames(EXIT), steps_from=0.05,
        outcomes=("foreign_command", "torque_not_delivered")),
    FaultCase("foreign SET_ZERO to motor 2, once", foreign_frames(SET_ZERO), unreached=(1,), steps_from=0.05,
        ends_rig=True),
    FaultCase("foreign 6 Nm to motor 2, 500 a second for 2 s", foreign_frames(commanding(FOREIGN), 500.0, 2.0),
        steps_from=2.1, outcomes=("foreign_command",), energy_limit=2.0),  # the foreign torque does work until opposed
    FaultCase("foreign zero commands to motor 2, 500 a second for 2 s",
        foreign_frames(commanding(0.0), 500.0, 2.0), steps_from=2.1, outcomes=("foreign_command",)),
    FaultCase("second publisher of joint states", publish(JointState, STATES, states_at([1.0] * 4))),
    FaultCase("second publisher of the tilt", publish(Vector3Stamped, TILT, tilt(1.0))),
    FaultCase("second publisher of the trunk's orientation", publish(Imu, TRUNK_IMU, trunk_imu(0.6, 0.8))),
    FaultCase("second publisher of the raw IMU", publish(Imu, RAW_IMU, raw_imu), limit=0.3),
)
DESCENT = (
    FaultCase("enabled again while let down", enable(True), stage="letting down", outcomes=OFF),
    FaultCase("motor 2 cut off for 2 s while let down", in_turn(CUT_OFF, pause(2.0), CONNECT), stage="letting down"),
    # While it is without power the arm falls freely: 0.3 rad/s in 15 ms, on top of the descent's speed.
    FaultCase("motor 2 restarts in 15 ms while let down", SHORT_RESTART, stage="letting down", clear=RESTARTED,
        steps_from=0.3),
    FaultCase("foreign EXIT to motor 2 while let down", foreign_frames(EXIT), stage="letting down", steps_from=0.05),
    FaultCase("can_bridge killed while let down", send_signal("can_bridge", KILL), limit=PROCESS_REACTION,
        stage="letting down"),
)
START = (
    FaultCase("motor 2 reports an error while checking", ERROR, SignCheckRig, stage="checking", clear=NO_ERROR,
        outcomes=("motor_error",)),
    FaultCase("motor 2 cut off while checking", CUT_OFF, SignCheckRig, stage="checking", clear=CONNECT,
        outcomes=("checking",)),
    FaultCase("motor 2 cut off while proving", CUT_OFF, SignCheckRig, stage="proving signs", clear=CONNECT,
        unreached=(1,), outcomes=("motor_silent",)),
    FaultCase("joint 2 jumps by a motor turn while proving", JUMP, SignCheckRig, stage="proving signs", clear=NO_JUMP,
        outcomes=("position_jump", "over_speed")),
    FaultCase("foreign EXIT to motor 2 while proving", foreign_frames(EXIT), SignCheckRig, stage="proving signs",
        steps_from=0.05),
    # A hanging arm needs hardly any torque, so that none is missed.
    FaultCase("motor 2 restarts while ramping in", RESTART, SignCheckRig, None, "ramping in", clear=RESTARTED,
        steps_from=0.3, outcomes=("active", "ramping in", "torque_not_delivered")),
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
    FaultCase("compensator frozen, the rest runs on", send_signal("compensator", STOP), TwoLaunchersRig,
        clear=send_signal("compensator", CONTINUE), outcomes=("command_stale",)),
    FaultCase("compensator killed, the rest runs on", send_signal("compensator", KILL), TwoLaunchersRig,
        ends_rig=True, outcomes=("command_stale",)),
    FaultCase("compensator's step raises an exception", let_step_fail("raise"), FailingStepRig, ends_rig=True,
        outcomes=("command_stale",)),
    FaultCase("compensator's step never returns", let_step_fail("sleep"), FailingStepRig, ends_rig=True,
        outcomes=("command_stale",)),
    FaultCase("launcher killed", lambda rig: rig.launcher.kill(), LauncherRig, PROCESS_REACTION),
    FaultCase("launcher interrupted", lambda rig: rig.launcher.send_signal(INTERRUPT), LauncherRig, PROCESS_REACTION),
    FaultCase("can_bridge killed, the launcher frozen",
        in_turn(lambda rig: rig.launcher.send_signal(STOP), send_signal("can_bridge", KILL)), LauncherRig,
        PROCESS_REACTION, clear=lambda rig: rig.launcher.send_signal(CONTINUE)),
)
ARMS = (
    FaultCase("arm disabled, friction 0.01 Nm", enable(False), LeastFrictionRig, outcomes=OFF),
    FaultCase("can_bridge killed, friction 0.01 Nm", send_signal("can_bridge", KILL), LeastFrictionRig,
        PROCESS_REACTION),
    FaultCase("arm disabled, friction 0.05 Nm", enable(False), LowFrictionRig, outcomes=OFF),
    FaultCase("arm disabled, friction 0.5 Nm", enable(False), HighFrictionRig, outcomes=OFF),
    FaultCase("trunk bows past 90 degrees", in_turn(simulator(trunk__pitch=1.9), pause(4.5)), BowRig, None,
        outcomes=HELD, clear=in_turn(simulator(trunk__pitch=0.1), pause(4.0))),
    FaultCase("elbow pushed into the soft wall", push_elbow, WallRig, None, speed_limit=5.0, check=not_thrown_back),
    FaultCase("arm disabled, Zero-G, 75 kg", enable(False), WearerRig, outcomes=OFF),
    FaultCase("motor 2 reports an error, Zero-G, 75 kg", ERROR, WearerRig, clear=NO_ERROR, outcomes=("motor_error",)),
    FaultCase("can_bridge killed, Zero-G, 75 kg", send_signal("can_bridge", KILL), WearerRig, PROCESS_REACTION),
    FaultCase("motor 2 of the right of two arms reports an error", ERROR, BothArmsRig, clear=NO_ERROR,
        afterwards=left_arm_is_carried, outcomes=("motor_error",)),
    FaultCase("can_bridge of the right of two arms killed", send_signal("can_bridge", KILL), BothArmsRig,
        PROCESS_REACTION),
)
# fmt: on
CASES = (
    *(*HELD_ROWS, *MOTORS, *DESCENT, *START, *PROCESSES, *EFFORT_COMMANDS, *OUTER_LOOP, *CLOCK, *ARMS, *V3_BOARDS),
    *(*RIDES, *OWNERSHIP, *LEASES, *LOAD_CHANGES, *ACTIVE_WEARER, *SUPPLY, *MONITOR, *TWO_BUSES),
    *(*REQUESTS, *CONNECTIONS, *FIRMWARE, *OTHER_ARMS),
)
