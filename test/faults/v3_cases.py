"""Rows of the fault matrix with V3 boards: they reply to nothing, send their state by themselves, and have no ENTER."""

from __future__ import annotations

import signal

from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.core.motors.specs import MOTORS
from exo_gravity.core.motors.wire_formats import MIT_V3

from .actions import enable, in_turn, pause, send_signal
from .device_faults import CONNECT, CUT_OFF, END_SILENCE, ERROR, NO_ERROR, SILENCE
from .fault_case import ALL_JOINTS, PROCESS_REACTION, FaultCase
from .frames import foreign_frames
from .rigs import V3Rig

MOTOR_2 = JointMotor(MIT_V3.ranged(MOTORS["AK80-9"]), 2, direction=-1, wire_format=MIT_V3)
EXIT_ID, EXIT = MOTOR_2.exit[-1]

# fmt: off
V3_BOARDS = (
    FaultCase("V3 boards: arm disabled", enable(False), V3Rig, outcomes=("disabled",)),
    FaultCase("V3 boards: motor 2 cut off from the bus", CUT_OFF, V3Rig, clear=CONNECT, unreached=(1,),
        outcomes=("motor_silent",)),
    FaultCase("V3 boards: bus silent for 3 s", in_turn(SILENCE, pause(3.0), END_SILENCE), V3Rig,
        unreached=ALL_JOINTS),
    FaultCase("V3 boards: motor 2 reports an error", ERROR, V3Rig, clear=NO_ERROR, outcomes=("motor_error",)),
    FaultCase("V3 boards: foreign exit of motor 2, once", foreign_frames(EXIT, frame_id=EXIT_ID), V3Rig,
        steps_from=0.05, outcomes=("foreign_command", "torque_not_delivered")),
    FaultCase("V3 boards: foreign 6 Nm to motor 2, 500 a second for 2 s",
        foreign_frames(MOTOR_2.command(-6.0, 0.0), 500.0, 2.0, MOTOR_2.command_id), V3Rig, steps_from=2.1,
        outcomes=("foreign_command",), work_limit=2.0),
    FaultCase("V3 boards: compensator killed", send_signal("compensator", signal.SIGKILL), V3Rig, PROCESS_REACTION),
    FaultCase("V3 boards: can_bridge killed", send_signal("can_bridge", signal.SIGKILL), V3Rig, PROCESS_REACTION),
)
# fmt: on
