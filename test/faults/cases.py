"""The fault matrix: each fault that is injected while the arm is carried, and how soon the arm must be let down."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import JointState

from ..support.load import start_frames, start_spin
from .rigs import CommandedRig, ExternalClockRig, LauncherRig, Rig, TwoLaunchersRig

REACTION = 0.10  # s from a fault to damping or EXIT on the bus,
PROCESS_REACTION = 0.15  # or where another process must first notice that one has died or frozen
STATES, EFFORTS, TILT = "/right/joint_states", "/right/effort_commands", "/imu/pitch_yaw"
FRAME_RATE = 3000  # random frames per second beside our 2,000: what two cores can receive in five Python processes

Action = Callable[[Any], object]  # on a rig of the case's type


@dataclass(frozen=True)
class FaultCase:
    """One fault. inject(rig) causes it; clear(rig) ends it where the rig is used again.

    limit: s until the arm must be let down, None where it may stay carried, because the fault is refused or ignored.
    in_tests: whether the tests run it too. ends_rig: whether the rig is spent although its nodes run on.
    """

    name: str
    inject: Action
    rig: type[Rig] = Rig
    limit: float | None = REACTION
    clear: Action = lambda rig: None
    in_tests: bool = False
    ends_rig: bool = False


def send_signal(node: str, number: int) -> Action:
    return lambda rig: rig.process(node).send_signal(number)


def simulator(**values: object) -> Action:
    """Set parameters of the simulator."""
    return lambda rig: rig.probe.set_parameters("simulator", **values)


def publish(message_type: type, topic: str, make_message: Callable[[Rig], object]) -> Action:
    """Publish the message for half a second, from a publisher that does not belong to the arm."""

    def inject(rig: Rig) -> None:
        publisher = rig.probe.node.create_publisher(message_type, topic, 1)
        rig.probe.wait_until(lambda: publisher.get_subscription_count() > 0)
        for _ in range(50):  # a single message may be overwritten by the next regular one before it is read
            publisher.publish(make_message(rig))
            time.sleep(0.01)

    return inject


def states_at(position: list[float]) -> Callable[[Rig], JointState]:
    """Joint states with this `position` in rad, otherwise like the arm's newest."""

    def make_message(rig: Rig) -> JointState:
        newest = rig.probe.joint_states[-1]
        return JointState(header=newest.header, name=newest.name, position=position)

    return make_message


def tilt(pitch: float) -> Callable[[Rig], Vector3Stamped]:
    def make_message(rig: Rig) -> Vector3Stamped:
        message = Vector3Stamped()
        message.vector.y = pitch
        return message

    return make_message


def random_frames(count: int, ids: Iterable[int]) -> Action:
    def inject(rig: Rig) -> None:
        sender = start_frames(rig.nodes[0].bus, count, FRAME_RATE, ids)
        rig.probe.wait_until(lambda: sender.poll() is not None, 2 * count / FRAME_RATE + 30.0)
        assert sender.returncode == 0

    return inject


def overload_processors(rig: Rig) -> None:
    """Start four busy processes for each of two processors, for 3 s."""
    for process in [start_spin(3.0) for _ in range(8)]:
        process.wait()


def set_impossible_parameters(rig: Rig) -> None:
    bad = ({"robot__mass": [-1.0] * 4}, {"robot__mass": [math.nan] * 4}, {"gain": [1.0] * 3}, {"mode": 7}, {"law": ""})
    for values in bad:
        assert not rig.probe.set_parameters("compensator", **values).successful


def kill_watchdog(rig: Rig) -> None:
    bridge = rig.process("can_bridge").pid
    children = Path(f"/proc/{bridge}/task/{bridge}/children").read_text()
    os.kill(int(children.split()[0]), signal.SIGKILL)


def change_message(change: Callable[[JointState], object]) -> Action:
    return lambda rig: setattr(rig, "change_message", change)


def shift_clock(seconds: float) -> Action:
    return lambda rig: setattr(rig, "clock_offset", seconds)


def shift_stamp(seconds: int) -> Action:
    def change(message: JointState) -> None:
        message.header.stamp.sec += seconds

    return change_message(change)


def second_effort(value: float) -> Action:
    return change_message(lambda message: message.effort.__setitem__(1, value))


HOUR, DAY = 3600, 86400  # s
PROCESSES = (
    FaultCase("compensator killed", send_signal("compensator", signal.SIGKILL), limit=PROCESS_REACTION),
    FaultCase("second publisher of efforts", publish(JointState, EFFORTS, lambda rig: rig.probe.effort_commands[-1]),
        TwoLaunchersRig, in_tests=True),
    FaultCase("compensator frozen, the rest runs on", send_signal("compensator", signal.SIGSTOP), TwoLaunchersRig,
        clear=send_signal("compensator", signal.SIGCONT), in_tests=True),
    FaultCase("compensator killed, the rest runs on", send_signal("compensator", signal.SIGKILL), TwoLaunchersRig,
        ends_rig=True),
    FaultCase("can_bridge killed", send_signal("can_bridge", signal.SIGKILL), limit=PROCESS_REACTION, in_tests=True),
    FaultCase("can_bridge frozen", send_signal("can_bridge", signal.SIGSTOP), limit=PROCESS_REACTION),
    FaultCase("can_bridge terminated", send_signal("can_bridge", signal.SIGTERM), limit=PROCESS_REACTION),
    FaultCase("watchdog killed", kill_watchdog, limit=PROCESS_REACTION),
    FaultCase("launcher killed", lambda rig: rig.launcher.kill(), LauncherRig, PROCESS_REACTION),
    FaultCase("launcher interrupted", lambda rig: rig.launcher.send_signal(signal.SIGINT), LauncherRig,
        PROCESS_REACTION),
    FaultCase("imu killed", send_signal("imu", signal.SIGKILL), limit=PROCESS_REACTION),
    FaultCase("imu frozen", send_signal("imu", signal.SIGSTOP), limit=PROCESS_REACTION,
        clear=send_signal("imu", signal.SIGCONT)),
)  # fmt: skip
MOTORS = (
    FaultCase("one motor silent", simulator(fault__unplugged=[False, False, True, False]),
        clear=simulator(fault__unplugged=[False] * 4)),
    FaultCase("whole bus silent", simulator(fault__bus_silent=True), clear=simulator(fault__bus_silent=False)),
    FaultCase("motor reports an error", simulator(fault__error=[0, 0, 5, 0]), clear=simulator(fault__error=[0] * 4)),
    FaultCase("motor at 95 degC", simulator(fault__temperature=[30.0, 95.0, 30.0, 30.0]),
        clear=simulator(fault__temperature=[30.0] * 4)),
)  # fmt: skip
INPUTS = (
    FaultCase("second publisher of joint states", publish(JointState, STATES, states_at([1.0] * 4))),
    FaultCase("NaN joint states", publish(JointState, STATES, states_at([math.nan] * 4)), limit=None),
    FaultCase("second publisher of the tilt", publish(Vector3Stamped, TILT, tilt(1.0))),
    FaultCase("NaN tilt", publish(Vector3Stamped, TILT, tilt(math.nan)), limit=None),
    FaultCase("impossible parameters", set_impossible_parameters, limit=None),
    FaultCase("100,000 random frames", random_frames(100_000, (0, *range(5, 2048))), limit=None),  # 1-4: the motors
    FaultCase("foreign frames, 3,000 a second", random_frames(15_000, range(0x100, 0x200)), limit=None),
    FaultCase("processors overloaded", overload_processors, limit=None),
)
EFFORT_COMMANDS = (
    FaultCase("effort NaN", second_effort(math.nan), CommandedRig, in_tests=True),
    FaultCase("effort infinite", second_effort(math.inf), CommandedRig),
    FaultCase("effort of 1e308 Nm", second_effort(1e308), CommandedRig),
    FaultCase("three efforts", change_message(lambda message: message.effort.pop()), CommandedRig),
    FaultCase("a wrong name", change_message(lambda message: message.name.__setitem__(3, "left_knee")), CommandedRig),
    FaultCase("a name twice", change_message(lambda message: message.name.__setitem__(3, message.name[2])),
        CommandedRig),
    FaultCase("no names", change_message(lambda message: setattr(message, "name", [])), CommandedRig),
    FaultCase("no efforts", change_message(lambda message: setattr(message, "effort", [])), CommandedRig),
    FaultCase("stamps an hour old", shift_stamp(-HOUR), CommandedRig),
    FaultCase("stamps a day ahead", shift_stamp(DAY), CommandedRig),
)  # fmt: skip
CLOCK = (
    FaultCase("clock set back an hour", shift_clock(-HOUR), ExternalClockRig, None),
    FaultCase("clock set ahead an hour", shift_clock(HOUR), ExternalClockRig, None),
)
CASES = (*PROCESSES, *MOTORS, *INPUTS, *EFFORT_COMMANDS, *CLOCK)
